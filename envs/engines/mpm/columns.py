"""Scatters without atomic adds, for a GPU: a warp walks a column of cells, and nodes add up what columns give them.

Particles are listed by cell (`cells`). A warp, 32 threads, takes the particles of SEGMENT cells along z one after the
other; 27 of its lanes hold the sums of the 27 nodes around the present cell, and where the next cell begins, the lowest
nine are written down and the others move on by one. A segment so leaves 9 rows of SEGMENT + 2 numbers of four parts,
and each node then adds up those of the nine columns that it is part of. Every sum has one order, which depends on
nothing but an environment's own particles: neither on its place in a batch, nor on the box of nodes, nor on chance.
"""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ..launches import BLOCK
from ..runtime import precision
from .cells import SEGMENT, cell_functions
from .stencil import lattice, stencil

PLANES = SEGMENT + 2  # of nodes that the cells of a segment touch
PARTS = 9 * PLANES  # numbers of four parts that a segment leaves

OPEN = """
#if !defined(__CUDA_ARCH__)
    for (int i = 0; i < PARTS; ++i) wp::index(parts, e, at + i) = wp::vec_t<4, REAL>();
#endif
"""
WALK = """
#if defined(__CUDA_ARCH__)
    struct __align__(16) Four { REAL a, b, c, d; };
    __shared__ Four stage[WARPS][32][5];
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31;
    Four (*rows)[5] = stage[threadIdx.x >> 5];
    __syncwarp();
    rows[lane][0] = Four{q[0], q[1], q[2], mass};
    rows[lane][1] = Four{a.data[0][0], a.data[1][0], a.data[2][0], f[0]};
    rows[lane][2] = Four{a.data[0][1], a.data[1][1], a.data[2][1], f[1]};
    rows[lane][3] = Four{a.data[0][2], a.data[1][2], a.data[2][2], f[2]};
    __syncwarp();
    const int i = lane / 9, j = lane / 3 % 3, k = lane % 3;
    const bool used = lane < 27;
    const REAL oi = REAL(i), oj = REAL(j), ok = REAL(k), half = REAL(0.5);
    const REAL ui = i == 1 ? REAL(0.75) : REAL(0.0), si = !used ? REAL(0.0) : i == 1 ? REAL(-1.0) : half;
    const REAL uj = j == 1 ? REAL(0.75) : REAL(0.0), sj = j == 1 ? REAL(-1.0) : half;
    const REAL uk = k == 1 ? REAL(0.75) : REAL(0.0), sk = k == 1 ? REAL(-1.0) : half;
    const REAL mi = REAL(1.5) - half * oi, mj = REAL(1.5) - half * oj, mk = REAL(1.5) - half * ok;
    REAL s0 = state[0], s1 = state[1], s2 = state[2], s3 = state[3];
    int now = (int)state[4];
    for (int t = 0; t < count; ++t) {
        for (const int next = __shfl_sync(all, cell, t); now < next; ++now) {
            if (used && k == 0)
                wp::index(parts, e, at + lane / 3 * PLANES + now) = wp::vec_t<4, REAL>(s0, s1, s2, s3);
            s0 = __shfl_down_sync(all, s0, 1);
            s1 = __shfl_down_sync(all, s1, 1);
            s2 = __shfl_down_sync(all, s2, 1);
            s3 = __shfl_down_sync(all, s3, 1);
            if (k == 2) s0 = s1 = s2 = s3 = REAL(0.0);
        }
        const Four b = rows[t][0], x = rows[t][1], y = rows[t][2], z = rows[t][3];
        const REAL tx = x.d - mi, ty = y.d - mj, tz = z.d - mk;
        const REAL w = (ui + si * tx * tx) * (uj + sj * ty * ty) * (uk + sk * tz * tz);
        s0 += w * (b.a + oi * x.a + oj * y.a + ok * z.a);
        s1 += w * (b.b + oi * x.b + oj * y.b + ok * z.b);
        s2 += w * (b.c + oi * x.c + oj * y.c + ok * z.c);
        s3 += w * b.d;
    }
    wp::vec_t<5, REAL> left;
    left[0] = s0, left[1] = s1, left[2] = s2, left[3] = s3, left[4] = REAL(now);
    return left;
#else
    REAL w[3][3];
    for (int axis = 0; axis < 3; ++axis) {
        const REAL g = f[axis], half = REAL(0.5);
        w[axis][0] = half * (g - REAL(1.5)) * (g - REAL(1.5));
        w[axis][1] = REAL(0.75) - (g - REAL(1.0)) * (g - REAL(1.0));
        w[axis][2] = half * (g - half) * (g - half);
    }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k) {
                const REAL weight = w[0][i] * w[1][j] * w[2][k];
                wp::vec_t<4, REAL> &sum = wp::index(parts, e, at + (3 * i + j) * PLANES + cell + k);
                for (int d = 0; d < 3; ++d)
                    sum[d] += weight * (q[d] + REAL(i) * a.data[d][0] + REAL(j) * a.data[d][1] + REAL(k) * a.data[d][2]);
                sum[3] += weight * mass;
            }
    return state;
#endif
"""
CLOSE = """
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31, k = lane % 3;
    REAL s0 = state[0], s1 = state[1], s2 = state[2], s3 = state[3];
    for (int now = (int)state[4]; now < PLANES; ++now) {
        if (lane < 27 && k == 0)
            wp::index(parts, e, at + lane / 3 * PLANES + now) = wp::vec_t<4, REAL>(s0, s1, s2, s3);
        s0 = __shfl_down_sync(all, s0, 1);
        s1 = __shfl_down_sync(all, s1, 1);
        s2 = __shfl_down_sync(all, s2, 1);
        s3 = __shfl_down_sync(all, s3, 1);
        if (k == 2) s0 = s1 = s2 = s3 = REAL(0.0);
    }
#endif
"""


@cache
@no_type_check
def walker(name: str) -> SimpleNamespace:
    """Return the functions `open, walk, close` and the type `State` of one precision.

    A warp's lanes call all three, together: `open` before their segment, whose parts begin at `at`, `close` after it.
    `walk` adds the next `count` particles to the parts, of each of which a lane knows the cell in the segment, where it
    is from its base node, `f`, its mass, and the q and a of what it gives node i: w_i (q + a i), and w_i mass. On a CPU
    a thread has a warp's work, one particle at a time.
    """
    types = precision(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    State = wp.types.vector(5, real)
    constants = {"PLANES": str(PLANES), "PARTS": str(PARTS), "WARPS": str(BLOCK // 32), "REAL": f"wp::{name}"}

    def fill(code: str) -> str:
        for word, value in constants.items():
            code = code.replace(word, value)
        return code

    @wp.func_native(fill(OPEN))
    def open_segment(parts: wp.array2d[vec4], e: int, at: int): ...

    @wp.func_native(fill(WALK))
    def walk(
        parts: wp.array2d[vec4],
        e: int,
        at: int,
        count: int,
        cell: int,
        f: vec3,
        mass: real,
        q: vec3,
        a: mat33,
        state: State,
    ) -> State: ...

    @wp.func_native(fill(CLOSE))
    def close_segment(parts: wp.array2d[vec4], e: int, at: int, state: State): ...

    return SimpleNamespace(open=open_segment, walk=walk, close=close_segment, State=State)


@cache
@no_type_check
def column_kernels(name: str) -> SimpleNamespace:
    """Return the kernels `p2g, adjoint_g2p, add_up` of one precision, and the function `add_up_node`.

    The first two are the scatters of `transfers`, over [environment, segment and lane]; `add_up`, over [environment,
    node], takes their parts to the nodes.
    """
    types = precision(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    Lattice, base_node, functions, steps = lattice(name), stencil(name).base_node, cell_functions(name), walker(name)
    column, module = functions.column, f"gradscape.columns.{name}"
    open_segment, walk, close_segment, State = steps.open, steps.walk, steps.close, steps.State

    @wp.kernel(module=module, enable_backward=False)
    def p2g(
        lattice: Lattice,
        lanes: int,
        order: wp.array2d[wp.int32],
        first: wp.array2d[wp.int32],
        end: wp.array2d[wp.int32],
        mass: wp.array2d[real],
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
        A: wp.array2d[mat33],
        parts: wp.array2d[vec4],
    ):
        """Scatter momentum m v + A (x_i - x) and mass."""
        e, t = wp.tid()
        last = end[e, t / lanes]
        if last == 0:
            return
        at = t / lanes * PARTS
        open_segment(parts, e, at)
        state = State()
        for i in range(first[e, t / lanes], last, lanes):
            p = order[e, wp.min(i + t % lanes, last - 1)]
            s = (x[e, p] - lattice.origin) * lattice.inv_dx
            base = base_node(s, lattice)
            f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
            m = mass[e, p]
            a = A[e, p] * (real(1.0) / lattice.inv_dx)
            q = m * v[e, p] - a * f
            state = walk(parts, e, at, wp.min(lanes, last - i), base[2] % SEGMENT, f, m, q, a, state)
        close_segment(parts, e, at, state)

    @wp.kernel(module=module, enable_backward=False)
    def adjoint_g2p(
        lattice: Lattice,
        lanes: int,
        order: wp.array2d[wp.int32],
        first: wp.array2d[wp.int32],
        end: wp.array2d[wp.int32],
        dt: real,
        x: wp.array2d[vec3],
        adj_x_new: wp.array2d[vec3],
        adj_v_new: wp.array2d[vec3],
        adj_C_new: wp.array2d[mat33],
        parts: wp.array2d[vec4],
    ):
        """Scatter the adjoints of the velocities that g2p gathered."""
        e, t = wp.tid()
        last = end[e, t / lanes]
        if last == 0:
            return
        at = t / lanes * PARTS
        open_segment(parts, e, at)
        state = State()
        for i in range(first[e, t / lanes], last, lanes):
            p = order[e, wp.min(i + t % lanes, last - 1)]
            s = (x[e, p] - lattice.origin) * lattice.inv_dx
            base = base_node(s, lattice)
            f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
            c = (real(4.0) * lattice.inv_dx) * adj_C_new[e, p]
            q = adj_v_new[e, p] + dt * adj_x_new[e, p] - c * f
            state = walk(parts, e, at, wp.min(lanes, last - i), base[2] % SEGMENT, f, real(0.0), q, c, state)
        close_segment(parts, e, at, state)

    @wp.func(module=module)
    def add_up_node(lattice: Lattice, end: wp.array2d[wp.int32], parts: wp.array2d[vec4], e: int, i: int) -> vec4:
        """Return what the parts say of a node, in one order of columns and segments."""
        x = i / (lattice.nz * lattice.ny)
        y = (i / lattice.nz) % lattice.ny
        z = lattice.first[2] + i % lattice.nz
        segment, plane = z / SEGMENT - lattice.first[2] / SEGMENT, z % SEGMENT
        total = vec4()
        for a in range(3):
            for b in range(3):
                if x >= a and y >= b:
                    here = column(lattice, x - a, y - b) + segment
                    row = (3 * a + b) * PLANES + plane
                    if plane < 2 and segment > 0:
                        if end[e, here - 1] > 0:
                            total += parts[e, (here - 1) * PARTS + row + SEGMENT]
                    if end[e, here] > 0:
                        total += parts[e, here * PARTS + row]
        return total

    @wp.kernel(module=module, enable_backward=False)
    def add_up(lattice: Lattice, end: wp.array2d[wp.int32], parts: wp.array2d[vec4], grid: wp.array2d[vec4]):
        e, i = wp.tid()
        grid[e, i] = add_up_node(lattice, end, parts, e, i)

    return SimpleNamespace(p2g=p2g, adjoint_g2p=adjoint_g2p, add_up=add_up, add_up_node=add_up_node)
