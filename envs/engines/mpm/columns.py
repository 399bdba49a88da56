"""Scatters without atomic adds, for a GPU: threads walk columns of cells, and nodes add up what columns give them.

Particles are listed by cell (`cells`). Nine lanes of a warp take the particles of SEGMENT cells along z, one after the
other; each holds the sums of three of the 27 nodes around the present cell, a row along z. Where the next cell begins,
the lowest nine are written down, beside each other, since a cache takes whole sectors much faster than parts of them,
and the others become lower by one. A segment so leaves up to SEGMENT + 2 planes of nine numbers of four parts, and each
node then adds up those of the nine columns that it is part of. Every sum has one order, which depends on nothing but an
environment's own particles: neither on its place in a batch, nor on the box of nodes, nor on chance.
"""

from dataclasses import dataclass
from functools import cache, partial
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ..launches import BLOCK, blocks
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
            out[9 * now++] = low;
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
    struct alignas(16) Weights { REAL low, middle, high; int cell; };
    struct Particle { STAGED Weights weights; };
    __shared__ Particle stage[WARPS][3 * ROUND];
    const int lane = threadIdx.x & 31, row = lane % 9, i = row / 3, j = row % 3;
    const REAL oi = REAL(i), oj = REAL(j), half = REAL(0.5), one = REAL(1.0), more = REAL(1.5), three = REAL(0.75);
    const auto pack = [&](const auto &p) {
        const REAL u = p.f[2] - more, v = p.f[2] - one, w = p.f[2] - half;
        return Particle{PACKED {half * u * u, three - v * v, half * w * w, p.cell}};
    };
    Particle *staged = stage[threadIdx.x >> 5] + lane / 9 * ROUND;
    __syncwarp();
    if (lane < 27) staged[row] = pack(first), staged[row + 9] = pack(second);
    __syncwarp();
    const REAL ui = i == 1 ? three : REAL(0.0), si = i == 1 ? -one : half, mi = more - half * oi;
    const REAL uj = j == 1 ? three : REAL(0.0), sj = j == 1 ? -one : half, mj = more - half * oj;
    Four low{state[0], state[1], state[2], state[3]};
    Four middle{state[4], state[5], state[6], state[7]};
    Four high{state[8], state[9], state[10], state[11]};
    Four *out = (Four *)&wp::index(parts, e, at) + row;
    int now = (int)state[12];
    for (int t = 0; t < count; ++t) {
        const Particle given = staged[t];
        const Weights w = given.weights;
#pragma unroll 1
        while (now < w.cell) EMIT
        const REAL tx = FIRST - mi, ty = SECOND - mj;
        const REAL wij = (ui + si * tx * tx) * (uj + sj * ty * ty);
        const REAL w0 = wij * w.low, w1 = wij * w.middle, w2 = wij * w.high;
        ADDED
    }
    wp::vec_t<13, REAL> left;
    left[0] = low.a, left[1] = low.b, left[2] = low.c, left[3] = low.d;
    left[4] = middle.a, left[5] = middle.b, left[6] = middle.c, left[7] = middle.d;
    left[8] = high.a, left[9] = high.b, left[10] = high.c, left[11] = high.d;
    left[12] = REAL(now);
    return left;
#else
    for (int n = 0; n < count; ++n) {
        const auto &p = n ? second : first;
        REAL w[3][3];
        for (int axis = 0; axis < 3; ++axis) {
            const REAL g = p.f[axis], half = REAL(0.5);
            w[axis][0] = half * (g - REAL(1.5)) * (g - REAL(1.5));
            w[axis][1] = REAL(0.75) - (g - REAL(1.0)) * (g - REAL(1.0));
            w[axis][2] = half * (g - half) * (g - half);
        }
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                for (int k = 0; k < 3; ++k) {
                    const REAL weight = w[0][i] * w[1][j] * w[2][k];
                    wp::vec_t<4, REAL> &sum = wp::index(parts, e, at + 9 * (p.cell + k) + 3 * i + j);
                    for (int d = 0; d < 3; ++d) {
                        const REAL *a = p.a.data[d], move = REAL(i) * a[0] + REAL(j) * a[1] + REAL(k) * a[2];
                        sum[d] += weight * (p.q[d] + move);
                    }
                    sum[3] += weight * p.mass;
                }
    }
    return state;
#endif
"""
# What is staged of a particle whose gift to nodes has a slope and mass, and of one without.
SLOPING = {
    "STAGED": "Four q, x, y, z;",
    "PACKED": """
            {p.q[0], p.q[1], p.q[2], p.mass},
            {p.a.data[0][0], p.a.data[1][0], p.a.data[2][0], p.f[0]},
            {p.a.data[0][1], p.a.data[1][1], p.a.data[2][1], p.f[1]},
            {p.a.data[0][2], p.a.data[1][2], p.a.data[2][2], REAL(0.0)},
""",
    "FIRST": "given.x.d",
    "SECOND": "given.y.d",
    "ADDED": """
        const Four b = given.q, x = given.x, y = given.y, z = given.z;
        REAL qa = b.a + oi * x.a + oj * y.a, qb = b.b + oi * x.b + oj * y.b, qc = b.c + oi * x.c + oj * y.c;
        low.a += w0 * qa, low.b += w0 * qb, low.c += w0 * qc, low.d += w0 * b.d;
        qa += z.a, qb += z.b, qc += z.c;
        middle.a += w1 * qa, middle.b += w1 * qb, middle.c += w1 * qc, middle.d += w1 * b.d;
        qa += z.a, qb += z.b, qc += z.c;
        high.a += w2 * qa, high.b += w2 * qb, high.c += w2 * qc, high.d += w2 * b.d;
""",
}
LEVEL = {
    "STAGED": "Four q;",
    "PACKED": "{p.q[0], p.q[1], p.f[0], p.f[1]},",
    "FIRST": "given.q.c",
    "SECOND": "given.q.d",
    "ADDED": """
        low.a += w0 * given.q.a, low.b += w0 * given.q.b;
        middle.a += w1 * given.q.a, middle.b += w1 * given.q.b;
        high.a += w2 * given.q.a, high.b += w2 * given.q.b;
""",
}
CLOSE = """
#if defined(__CUDA_ARCH__)
    FOUR
    const int row = (threadIdx.x & 31) % 9;
    Four low{state[0], state[1], state[2], state[3]};
    Four middle{state[4], state[5], state[6], state[7]};
    Four high{state[8], state[9], state[10], state[11]};
    Four *out = (Four *)&wp::index(parts, e, at) + row;
    int now = (int)state[12];
#pragma unroll 1
    while (now < span >> 8) EMIT
#endif
"""
MOST = """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
    return __reduce_max_sync(0xffffffffu, count);
#elif defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step /= 2) count = max(count, __shfl_xor_sync(0xffffffffu, count, step));
    return count;
#else
    return count;
#endif
"""
ADD_UP = """
    FOUR
    const int nz = lattice.nz, ny = lattice.ny, z = lattice.first[2] + i % nz, y = i / nz % ny, x = i / nz / ny;
    const int bottom = lattice.first[2] / SEGMENT, depth = (lattice.first[2] + nz - 1) / SEGMENT - bottom + 1;
    const int segment = z / SEGMENT - bottom, plane = z % SEGMENT;
    const bool both = plane < 2 && segment > 0;
    const int *row = &wp::index(planes, e, 0);
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
        const Four a = lower[c] >> at & 1 ? given[(here - 1) * PARTS + 9 * at + c] : none;
        const Four b = upper[c] >> plane & 1 ? given[here * PARTS + 9 * plane + c] : none;
        low.a += a.a, low.b += a.b, low.c += a.c, low.d += a.d;
        high.a += b.a, high.b += b.b, high.c += b.c, high.d += b.d;
    }
    return wp::vec_t<4, REAL>(low.a + high.a, low.b + high.b, low.c + high.c, low.d + high.d);
"""


def fill(code: str, name: str, **more: str) -> str:
    """Put what a precision decides, and other constants, into C++."""
    words = more | {
        "EMIT": EMIT,
        "PARTS": PARTS,
        "SEGMENT": SEGMENT,
        "WARPS": BLOCK // 32,
        "ROUND": 18,
    }
    for word, value in words.items():
        code = code.replace(word, str(value))
    return in_precision(code, name)


@cache
@no_type_check
def walker(name: str, *, sloping: bool = True) -> SimpleNamespace:
    """Return the functions `at_nodes, most, open, walk, close` of one precision.

    `at_nodes` says what a particle gives to its nodes, as a `Given`, whose a, mass and third q must be 0 unless it is
    `sloping`. A warp's lanes call the others together: `most` for the greatest of their counts, `open` before their
    segment, whose parts begin at `at`, `close` after it. `walk` adds the next `count` particles of each group to its
    parts. A lane knows two of them, as far apart in the list as a group has lanes.
    """
    types = precision(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    State = wp.types.vector(13, real)
    Lattice, base_node = lattice(name), stencil(name).base_node

    @partial(wp.struct, module=f"gradscape.given.{name}")
    class Given:
        """A particle's cell in its segment, where it is from its base node, and what node i gets of it.

        That is w_i (q + a i), i counted from the base node, and w_i mass.
        """

        cell: int
        f: vec3
        mass: real
        q: vec3
        a: mat33

    @wp.func_native(MOST)
    def most(count: int) -> int: ...

    @wp.func_native(fill(OPEN, name))
    def open_segment(parts: wp.array2d[vec4], e: int, at: int, span: int) -> State: ...

    @wp.func_native(fill(WALK, name, **(SLOPING if sloping else LEVEL)))
    def walk(
        parts: wp.array2d[vec4], e: int, at: int, count: int, first: Given, second: Given, state: State
    ) -> State: ...

    @wp.func_native(fill(CLOSE, name))
    def close_segment(parts: wp.array2d[vec4], e: int, at: int, span: int, state: State): ...

    @wp.func(module=f"gradscape.given.{name}")
    def at_nodes(lattice: Lattice, x: vec3):
        """Return what a particle there gives to its nodes: nothing as yet."""
        given = Given()
        s = (x - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        given.cell = base[2] % SEGMENT
        given.f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        return given

    return SimpleNamespace(at_nodes=at_nodes, most=most, open=open_segment, walk=walk, close=close_segment)


@cache
@no_type_check
def segment_taker(team: Team):
    """Return the function that says of a thread's segment (number, first place, count, span), none if it has none."""
    lanes, groups, size = team.lanes, team.groups, team.size

    @wp.func(module=f"gradscape.columns.{lanes}")
    def take_segment(e: int, t: int, full: wp.array[wp.int32], segments: wp.array2d[wp.vec4i]):
        group = t % lanes / size
        i = t / lanes * groups + group
        mine = segments[e, wp.min(i, segments.shape[1] - 1)]  # does not wait for how many there are
        if group >= groups or i >= full[e]:
            return wp.vec4i(0, 0, 0, 0)
        return mine

    return take_segment


@cache
@no_type_check
def node_sum(name: str):
    """Return the function (lattice, planes, parts, e, i) that adds up what the parts say of node i, in one order."""
    Lattice, vec4 = lattice(name), precision(name).vec4

    @wp.func_native(fill(ADD_UP, name))
    def add_up_node(
        lattice: Lattice, planes: wp.array2d[wp.int32], parts: wp.array2d[vec4], e: int, i: int
    ) -> vec4: ...

    return add_up_node


@cache
@no_type_check
def column_kernels(name: str, team: Team) -> SimpleNamespace:
    """Return the kernels `p2g, adjoint_g2p` of one precision, over [environment, thread of a `team`].

    They are the scatters of `transfers`, up to the parts of sums that nodes then add up (`grid`).
    """
    types = precision(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    Lattice, steps = lattice(name), walker(name)
    module = f"gradscape.columns.{name}.{team.lanes}"
    take_segment, most = segment_taker(team), steps.most
    at_nodes, open_segment, walk, close_segment = steps.at_nodes, steps.open, steps.walk, steps.close
    lanes, groups, size = team.lanes, team.groups, team.size
    lies = layout(name)
    read_number, read_vector, read_matrix = lies.read_number, lies.read_vector, lies.read_matrix

    @wp.func(module=module)
    def momentum(
        lattice: Lattice,
        mass: wp.array2d[real],
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
        A: wp.array2d[mat33],
        e: int,
        p: int,
    ):
        given = at_nodes(lattice, read_vector(x, e, p))
        given.mass = read_number(mass, e, p)
        given.a = read_matrix(A, e, p) * (real(1.0) / lattice.inv_dx)
        given.q = given.mass * read_vector(v, e, p) - given.a * given.f
        return given

    @wp.func(module=module)
    def velocity_adjoint(
        lattice: Lattice,
        dt: real,
        x: wp.array2d[vec3],
        adj_x_new: wp.array2d[vec3],
        adj_v_new: wp.array2d[vec3],
        adj_C_new: wp.array2d[mat33],
        e: int,
        p: int,
    ):
        given = at_nodes(lattice, read_vector(x, e, p))
        given.a = (real(4.0) * lattice.inv_dx) * read_matrix(adj_C_new, e, p)
        given.q = read_vector(adj_v_new, e, p) + dt * read_vector(adj_x_new, e, p) - given.a * given.f
        return given

    @wp.kernel(module=module, enable_backward=False, grid_stride=False, launch_bounds=blocks(name))
    def p2g(
        lattice: Lattice,
        order: wp.array2d[wp.int32],
        full: wp.array[wp.int32],
        segments: wp.array2d[wp.vec4i],
        mass: wp.array2d[real],
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
        A: wp.array2d[mat33],
        parts: wp.array2d[vec4],
    ):
        """Scatter momentum m v + A (x_i - x) and mass."""
        e, t = wp.tid()
        mine = take_segment(e, t, full, segments)
        if t / lanes * groups >= full[e]:
            return
        at, begin, count, span = mine[0] * PARTS, mine[1], mine[2], mine[3]
        state = open_segment(parts, e, at, span)
        last = begin + wp.max(count - 1, 0)
        place = begin + t % lanes % size
        for i in range(0, most(count), 2 * size):
            first = momentum(lattice, mass, x, v, A, e, order[e, wp.min(place + i, last)])
            second = momentum(lattice, mass, x, v, A, e, order[e, wp.min(place + i + size, last)])
            state = walk(parts, e, at, wp.min(2 * size, count - i), first, second, state)
        close_segment(parts, e, at, span, state)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False, launch_bounds=blocks(name))
    def adjoint_g2p(
        lattice: Lattice,
        order: wp.array2d[wp.int32],
        full: wp.array[wp.int32],
        segments: wp.array2d[wp.vec4i],
        dt: real,
        x: wp.array2d[vec3],
        adj_x_new: wp.array2d[vec3],
        adj_v_new: wp.array2d[vec3],
        adj_C_new: wp.array2d[mat33],
        parts: wp.array2d[vec4],
    ):
        """Scatter the adjoints of the velocities that g2p gathered."""
        e, t = wp.tid()
        mine = take_segment(e, t, full, segments)
        if t / lanes * groups >= full[e]:
            return
        at, begin, count, span = mine[0] * PARTS, mine[1], mine[2], mine[3]
        state = open_segment(parts, e, at, span)
        last = begin + wp.max(count - 1, 0)
        place = begin + t % lanes % size
        for i in range(0, most(count), 2 * size):
            first = velocity_adjoint(
                lattice, dt, x, adj_x_new, adj_v_new, adj_C_new, e, order[e, wp.min(place + i, last)]
            )
            second = velocity_adjoint(
                lattice, dt, x, adj_x_new, adj_v_new, adj_C_new, e, order[e, wp.min(place + i + size, last)]
            )
            state = walk(parts, e, at, wp.min(2 * size, count - i), first, second, state)
        close_segment(parts, e, at, span, state)

    return SimpleNamespace(p2g=p2g, adjoint_g2p=adjoint_g2p)
