"""Scatters without atomic adds, for a GPU: threads walk columns of cells, and nodes add up what columns give them.

Particles are listed by cell (`cells`). Nine lanes of a warp take the particles of SEGMENT cells along z, one after the
other; each holds the sums of three of the 27 nodes around the present cell, a row along z. Where the next cell begins,
the lowest nine are written down and the others become lower by one. A segment so leaves 9 rows of up to SEGMENT + 2
numbers of four parts, and each node then adds up those of the nine columns that it is part of. Every sum has one order,
which depends on nothing but an environment's own particles: neither on its place in a batch, nor on the box of nodes,
nor on chance.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ..launches import BLOCK
from ..runtime import precision
from .cells import SEGMENT, segments
from .layout import in_precision, layout
from .model import Box
from .stencil import lattice, stencil

PLANES = SEGMENT + 2  # of nodes that the cells of a segment touch
PARTS = 9 * PLANES  # numbers of four parts that a segment leaves


@dataclass(frozen=True)
class Team:
    """How threads share segments: `groups` of them, a segment each, of `size` lanes, in a warp of so many `lanes`."""

    lanes: int
    groups: int
    size: int

    def threads(self, box: Box) -> int:
        """Return how many threads a box of nodes takes."""
        return -(-segments(box) // self.groups) * self.lanes


GPU_TEAM, CPU_TEAM = Team(32, 3, 9), Team(1, 1, 1)  # on a CPU a thread has a segment

EMIT = """
        {
            *(Four *)&wp::index(parts, e, at + row * PLANES + now) = low;
            low = middle, middle = high, high = Four{};
        }
"""
OPEN = """
#if !defined(__CUDA_ARCH__)
    for (int i = 0; i < PARTS; ++i) wp::index(parts, e, at + i) = wp::vec_t<4, REAL>();
#endif
    wp::vec_t<13, REAL> state;
    state[12] = REAL(span & 255);
    return state;
"""
WALK = """
#if defined(__CUDA_ARCH__)
    FOUR
    __shared__ Four stage[WARPS][32][5];
    const int lane = threadIdx.x & 31, row = lane % 9, i = row / 3, j = row % 3;
    Four (*rows)[5] = stage[threadIdx.x >> 5];
    __syncwarp();
    rows[lane][0] = Four{q[0], q[1], q[2], mass};
    rows[lane][1] = Four{a.data[0][0], a.data[1][0], a.data[2][0], f[0]};
    rows[lane][2] = Four{a.data[0][1], a.data[1][1], a.data[2][1], f[1]};
    rows[lane][3] = Four{a.data[0][2], a.data[1][2], a.data[2][2], f[2]};
    rows[lane][4].a = REAL(cell);
    __syncwarp();
    const REAL oi = REAL(i), oj = REAL(j), half = REAL(0.5), one = REAL(1.0), more = REAL(1.5), three = REAL(0.75);
    const REAL ui = i == 1 ? three : REAL(0.0), si = i == 1 ? -one : half, mi = more - half * oi;
    const REAL uj = j == 1 ? three : REAL(0.0), sj = j == 1 ? -one : half, mj = more - half * oj;
    Four low{state[0], state[1], state[2], state[3]};
    Four middle{state[4], state[5], state[6], state[7]};
    Four high{state[8], state[9], state[10], state[11]};
    int now = (int)state[12];
    for (int t = 0; t < count; ++t) {
        const Four *given = rows[lane - row + t];
        const Four b = given[0], x = given[1], y = given[2], z = given[3];
        const int here = (int)given[4].a;
        for (; now < here; ++now) EMIT
        const REAL tx = x.d - mi, ty = y.d - mj, u = z.d - more, v = z.d - one, w = z.d - half;
        const REAL wij = (ui + si * tx * tx) * (uj + sj * ty * ty);
        const REAL w0 = wij * (half * u * u), w1 = wij * (three - v * v), w2 = wij * (half * w * w);
        REAL qa = b.a + oi * x.a + oj * y.a, qb = b.b + oi * x.b + oj * y.b, qc = b.c + oi * x.c + oj * y.c;
        low.a += w0 * qa, low.b += w0 * qb, low.c += w0 * qc, low.d += w0 * b.d;
        qa += z.a, qb += z.b, qc += z.c;
        middle.a += w1 * qa, middle.b += w1 * qb, middle.c += w1 * qc, middle.d += w1 * b.d;
        qa += z.a, qb += z.b, qc += z.c;
        high.a += w2 * qa, high.b += w2 * qb, high.c += w2 * qc, high.d += w2 * b.d;
    }
    wp::vec_t<13, REAL> left;
    left[0] = low.a, left[1] = low.b, left[2] = low.c, left[3] = low.d;
    left[4] = middle.a, left[5] = middle.b, left[6] = middle.c, left[7] = middle.d;
    left[8] = high.a, left[9] = high.b, left[10] = high.c, left[11] = high.d;
    left[12] = REAL(now);
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
                for (int d = 0; d < 3; ++d) {
                    const REAL move = REAL(i) * a.data[d][0] + REAL(j) * a.data[d][1] + REAL(k) * a.data[d][2];
                    sum[d] += weight * (q[d] + move);
                }
                sum[3] += weight * mass;
            }
    return state;
#endif
"""
CLOSE = """
#if defined(__CUDA_ARCH__)
    FOUR
    const int row = (threadIdx.x & 31) % 9;
    Four low{state[0], state[1], state[2], state[3]};
    Four middle{state[4], state[5], state[6], state[7]};
    Four high{state[8], state[9], state[10], state[11]};
    for (int now = (int)state[12]; now < span >> 8; ++now) EMIT
#endif
"""
MOST = """
#if defined(__CUDA_ARCH__)
    return __reduce_max_sync(0xffffffffu, count);
#else
    return count;
#endif
"""
ADD_UP = """
    FOUR
    const int nz = grid.nz, ny = grid.ny, z = grid.first[2] + i % nz, y = i / nz % ny, x = i / nz / ny;
    const int bottom = grid.first[2] / SEGMENT, depth = (grid.first[2] + nz - 1) / SEGMENT - bottom + 1;
    const int segment = z / SEGMENT - bottom, plane = z % SEGMENT;
    const bool both = plane < 2 && segment > 0;
    const int *row = &wp::index(spans, e, 0);
    const Four *given = (const Four *)&wp::index(parts, e, 0);
    int lower[9], upper[9];
#pragma unroll
    for (int c = 0; c < 9; ++c) {
        const bool there = x >= c / 3 && y >= c % 3;
        const int here = ((x - c / 3) * ny + y - c % 3) * depth + segment;
        lower[c] = there && both ? row[here - 1] : 0;
        upper[c] = there ? row[here] : 0;
    }
    Four low{}, high{};
#pragma unroll
    for (int c = 0; c < 9; ++c) {
        const int here = ((x - c / 3) * ny + y - c % 3) * depth + segment, at = plane + SEGMENT;
        const Four none{};
        const bool is_low = at >= (lower[c] & 255) && at < lower[c] >> 8;
        const bool is_high = plane >= (upper[c] & 255) && plane < upper[c] >> 8;
        const Four a = is_low ? given[(here - 1) * PARTS + c * PLANES + at] : none;
        const Four b = is_high ? given[here * PARTS + c * PLANES + plane] : none;
        low.a += a.a, low.b += a.b, low.c += a.c, low.d += a.d;
        high.a += b.a, high.b += b.b, high.c += b.c, high.d += b.d;
    }
    return wp::vec_t<4, REAL>(low.a + high.a, low.b + high.b, low.c + high.c, low.d + high.d);
"""


def fill(code: str, name: str) -> str:
    """Put what a precision decides, and other constants, into C++."""
    words = {"EMIT": EMIT, "PLANES": PLANES, "PARTS": PARTS, "SEGMENT": SEGMENT, "WARPS": BLOCK // 32}
    for word, value in words.items():
        code = code.replace(word, str(value))
    return in_precision(code, name)


@cache
@no_type_check
def walker(name: str) -> SimpleNamespace:
    """Return the functions `most, open, walk, close` of one precision.

    A warp's lanes call all of them, together: `most` for the greatest of their counts, `open` before their segment,
    whose parts begin at `at`, `close` after it. `walk` adds the next `count` particles of each group to its parts. A
    lane knows one of them: its cell in the segment, where it is from its base node, `f`, its mass, and the q and a of
    what it gives node i, w_i (q + a i), and w_i mass.
    """
    types = precision(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    State = wp.types.vector(13, real)

    @wp.func_native(MOST)
    def most(count: int) -> int: ...

    @wp.func_native(fill(OPEN, name))
    def open_segment(parts: wp.array2d[vec4], e: int, at: int, span: int) -> State: ...

    @wp.func_native(fill(WALK, name))
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

    @wp.func_native(fill(CLOSE, name))
    def close_segment(parts: wp.array2d[vec4], e: int, at: int, span: int, state: State): ...

    return SimpleNamespace(most=most, open=open_segment, walk=walk, close=close_segment)


@cache
@no_type_check
def segment_taker(team: Team):
    """Return the function that says of a thread's segment (number, span, first place, count), none if it has none."""
    lanes, groups, size = team.lanes, team.groups, team.size

    @wp.func(module=f"gradscape.columns.{lanes}")
    def take_segment(
        e: int,
        t: int,
        full: int,
        which: wp.array2d[wp.int32],
        first: wp.array2d[wp.int32],
        end: wp.array2d[wp.int32],
        spans: wp.array2d[wp.int32],
    ):
        group = t % lanes / size
        i = t / lanes * groups + group
        if group >= groups or i >= full:
            return wp.vec4i(0, 0, 0, 0)
        return wp.vec4i(which[e, i], spans[e, which[e, i]], first[e, i], end[e, i] - first[e, i])

    return take_segment


@cache
@no_type_check
def node_sum(name: str):
    """Return the function (lattice, spans, parts, e, i) that adds up what the parts say of node i, in one order."""
    Lattice, vec4 = lattice(name), precision(name).vec4

    @wp.func_native(fill(ADD_UP, name))
    def add_up_node(grid: Lattice, spans: wp.array2d[wp.int32], parts: wp.array2d[vec4], e: int, i: int) -> vec4: ...

    return add_up_node


@cache
@no_type_check
def column_kernels(name: str, team: Team) -> SimpleNamespace:
    """Return the kernels `p2g, adjoint_g2p, add_up` of one precision for threads in a `team`.

    The first two are the scatters of `transfers`, over [environment, thread of the team]; `add_up`, over [environment,
    node], takes their parts to the nodes.
    """
    types = precision(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    Lattice, base_node, steps = lattice(name), stencil(name).base_node, walker(name)
    add_up_node, module = node_sum(name), f"gradscape.columns.{name}.{team.lanes}"
    take_segment, most = segment_taker(team), steps.most
    open_segment, walk, close_segment = steps.open, steps.walk, steps.close
    lanes, groups, size = team.lanes, team.groups, team.size
    read_matrix, write_node = layout(name).read_matrix, layout(name).write_node

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def p2g(
        lattice: Lattice,
        order: wp.array2d[wp.int32],
        full: wp.array[wp.int32],
        which: wp.array2d[wp.int32],
        first: wp.array2d[wp.int32],
        end: wp.array2d[wp.int32],
        spans: wp.array2d[wp.int32],
        mass: wp.array2d[real],
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
        A: wp.array2d[mat33],
        parts: wp.array2d[vec4],
    ):
        """Scatter momentum m v + A (x_i - x) and mass."""
        e, t = wp.tid()
        if t / lanes * groups >= full[e]:
            return
        mine = take_segment(e, t, full[e], which, first, end, spans)
        at, span, begin, count = mine[0] * PARTS, mine[1], mine[2], mine[3]
        state = open_segment(parts, e, at, span)
        following = order[e, begin + wp.min(t % lanes % size, wp.max(count - 1, 0))]
        for i in range(0, most(count), size):
            p = following
            following = order[e, begin + wp.min(i + size + t % lanes % size, wp.max(count - 1, 0))]
            s = (x[e, p] - lattice.origin) * lattice.inv_dx
            base = base_node(s, lattice)
            f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
            m = mass[e, p]
            a = read_matrix(A, e, p) * (real(1.0) / lattice.inv_dx)
            q = m * v[e, p] - a * f
            state = walk(parts, e, at, wp.min(size, count - i), base[2] % SEGMENT, f, m, q, a, state)
        close_segment(parts, e, at, span, state)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def adjoint_g2p(
        lattice: Lattice,
        order: wp.array2d[wp.int32],
        full: wp.array[wp.int32],
        which: wp.array2d[wp.int32],
        first: wp.array2d[wp.int32],
        end: wp.array2d[wp.int32],
        spans: wp.array2d[wp.int32],
        dt: real,
        x: wp.array2d[vec3],
        adj_x_new: wp.array2d[vec3],
        adj_v_new: wp.array2d[vec3],
        adj_C_new: wp.array2d[mat33],
        parts: wp.array2d[vec4],
    ):
        """Scatter the adjoints of the velocities that g2p gathered."""
        e, t = wp.tid()
        if t / lanes * groups >= full[e]:
            return
        mine = take_segment(e, t, full[e], which, first, end, spans)
        at, span, begin, count = mine[0] * PARTS, mine[1], mine[2], mine[3]
        state = open_segment(parts, e, at, span)
        following = order[e, begin + wp.min(t % lanes % size, wp.max(count - 1, 0))]
        for i in range(0, most(count), size):
            p = following
            following = order[e, begin + wp.min(i + size + t % lanes % size, wp.max(count - 1, 0))]
            s = (x[e, p] - lattice.origin) * lattice.inv_dx
            base = base_node(s, lattice)
            f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
            c = (real(4.0) * lattice.inv_dx) * read_matrix(adj_C_new, e, p)
            q = adj_v_new[e, p] + dt * adj_x_new[e, p] - c * f
            state = walk(parts, e, at, wp.min(size, count - i), base[2] % SEGMENT, f, real(0.0), q, c, state)
        close_segment(parts, e, at, span, state)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def add_up(lattice: Lattice, spans: wp.array2d[wp.int32], parts: wp.array2d[vec4], grid: wp.array2d[vec4]):
        e, i = wp.tid()
        write_node(grid, e, i, add_up_node(lattice, spans, parts, e, i))

    return SimpleNamespace(p2g=p2g, adjoint_g2p=adjoint_g2p, add_up=add_up)
