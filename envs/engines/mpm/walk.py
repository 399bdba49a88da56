"""How a warp of a GPU walks along the cells of its segments, and adds up what their particles give to nodes.

Nine lanes take the particles of a segment one after the other. Each holds the sums of three of the 27 nodes around the
present cell, a row along z. Where the next cell begins, the lowest nine are written down, beside each other, since a
cache takes whole sectors much faster than parts of them, and the others become lower by one. Planes below those of a
stretch, which another walk leaves, are not written.

A lane works out what one particle gives to all nine rows, and puts it into memory that the warp shares, where each lane
reads what concerns its own row, since reading there is what limits a scatter. No more than nine particles of a segment
are there at once: the cache has what shared memory leaves of the same storage.
"""

from functools import cache, partial
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ..launches import BLOCK
from ..runtime import precision
from .cells import SEGMENT
from .layout import in_precision
from .stencil import lattice, stencil

PLANES = SEGMENT + 2  # of nodes that the cells of a segment touch
PARTS = 9 * PLANES  # numbers of four parts that a segment leaves

# A lane's group and row. Eight lanes read shared memory at once, and of one particle by this numbering.
GROUP, ROW = "(lane < 24 ? lane / 8 : lane - 24)", "(lane < 24 ? lane % 8 : 8)"
EMIT = """
        {
            if (now >= (span & 255)) *out = low;
            out += 9, ++now;
            low = middle, middle = high, high = Four{};
        }
"""
OPEN = """
#if !defined(__CUDA_ARCH__)
    for (int i = 9 * (span & 255); i < 9 * (span >> 8 & 255); ++i) wp::index(parts, e, at + i) = wp::vec_t<4, REAL>();
#endif
    wp::vec_t<13, REAL> state;
    state[12] = REAL(span >> 16);
    return state;
"""
WALK = """
    REAL w[3][3];
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) {
        const REAL f = p.f[axis], half = REAL(0.5), one = REAL(1.0), more = REAL(1.5);
        w[axis][0] = half * (f - more) * (f - more);
        w[axis][1] = REAL(0.75) - (f - one) * (f - one);
        w[axis][2] = half * (f - half) * (f - half);
    }
#if defined(__CUDA_ARCH__)
    FOUR
    struct alignas(2 * sizeof(REAL)) Two { REAL a, b; };
    struct alignas(16) Weights { REAL low, middle, high; int cell; };
    struct Particle { KIND rows[9]; STAGED Weights weights; };
    __shared__ Particle stage[WARPS][3][9];
    const int lane = threadIdx.x & 31, group = GROUP, row = ROW;
    Particle *staged = stage[threadIdx.x >> 5][lane < 27 ? group : 0];
    __syncwarp();
    if (lane < 27) {
        Particle &to = staged[row];
#pragma unroll
        for (int i = 0; i < 3; ++i)
#pragma unroll
            for (int j = 0; j < 3; ++j) to.rows[3 * i + j] = GIVEN;
        PACKED
        to.weights = {w[2][0], w[2][1], w[2][2], p.cell};
    }
    __syncwarp();
    Four low{state[0], state[1], state[2], state[3]};
    Four middle{state[4], state[5], state[6], state[7]};
    Four high{state[8], state[9], state[10], state[11]};
    int now = (int)state[12];
    Four *out = (Four *)&wp::index(parts, e, at + 9 * now) + row;
    for (int t = 0; t < count; ++t) {
        const KIND b = staged[t].rows[row];
        const Weights z = staged[t].weights;
#pragma unroll 1
        while (now < z.cell) EMIT
        ADDED
    }
    wp::vec_t<13, REAL> left;
    left[0] = low.a, left[1] = low.b, left[2] = low.c, left[3] = low.d;
    left[4] = middle.a, left[5] = middle.b, left[6] = middle.c, left[7] = middle.d;
    left[8] = high.a, left[9] = high.b, left[10] = high.c, left[11] = high.d;
    left[12] = REAL(now);
    return left;
#else
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k) {
                if (p.cell + k < (span & 255) || p.cell + k >= (span >> 8 & 255)) continue;
                const REAL weight = w[0][i] * w[1][j] * w[2][k];
                wp::vec_t<4, REAL> &sum = wp::index(parts, e, at + 9 * (p.cell + k) + 3 * i + j);
                for (int d = 0; d < 3; ++d) {
                    const REAL *a = p.a.data[d], move = REAL(i) * a[0] + REAL(j) * a[1] + REAL(k) * a[2];
                    sum[d] += weight * (p.q[d] + move);
                }
                sum[3] += weight * p.mass;
            }
    return state;
#endif
"""
# What is staged of a particle whose gift to nodes has a slope and mass, and of one without.
SLOPING = {
    "KIND": "Four",
    "STAGED": "Four slope;",
    "GIVEN": """Four{
                p.q[0] + REAL(i) * p.a.data[0][0] + REAL(j) * p.a.data[0][1],
                p.q[1] + REAL(i) * p.a.data[1][0] + REAL(j) * p.a.data[1][1],
                p.q[2] + REAL(i) * p.a.data[2][0] + REAL(j) * p.a.data[2][1], w[0][i] * w[1][j]}""",
    "PACKED": "to.slope = {p.a.data[0][2], p.a.data[1][2], p.a.data[2][2], p.mass};",
    "ADDED": """
        const Four a = staged[t].slope;
        const REAL w0 = b.d * z.low, w1 = b.d * z.middle, w2 = b.d * z.high;
        REAL qa = b.a, qb = b.b, qc = b.c;
        low.a += w0 * qa, low.b += w0 * qb, low.c += w0 * qc, low.d += w0 * a.d;
        qa += a.a, qb += a.b, qc += a.c;
        middle.a += w1 * qa, middle.b += w1 * qb, middle.c += w1 * qc, middle.d += w1 * a.d;
        qa += a.a, qb += a.b, qc += a.c;
        high.a += w2 * qa, high.b += w2 * qb, high.c += w2 * qc, high.d += w2 * a.d;
""",
}
LEVEL = {
    "KIND": "Two",
    "STAGED": "",
    "GIVEN": "Two{w[0][i] * w[1][j] * p.q[0], w[0][i] * w[1][j] * p.q[1]}",
    "PACKED": "",
    "ADDED": """
        low.a += z.low * b.a, low.b += z.low * b.b;
        middle.a += z.middle * b.a, middle.b += z.middle * b.b;
        high.a += z.high * b.a, high.b += z.high * b.b;
""",
}
CLOSE = """
#if defined(__CUDA_ARCH__)
    FOUR
    const int lane = threadIdx.x & 31, row = ROW;
    Four low{state[0], state[1], state[2], state[3]};
    Four middle{state[4], state[5], state[6], state[7]};
    Four high{state[8], state[9], state[10], state[11]};
    int now = (int)state[12];
    Four *out = (Four *)&wp::index(parts, e, at + 9 * now) + row;
#pragma unroll 1
    while (now < (span >> 8 & 255)) EMIT
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


def fill(code: str, name: str, **more: str) -> str:
    """Put what a precision decides, and other constants, into C++."""
    words = more | {
        "EMIT": EMIT,
        "PARTS": PARTS,
        "SEGMENT": SEGMENT,
        "WARPS": BLOCK // 32,
        "GROUP": GROUP,
        "ROW": ROW,
    }
    for word, value in words.items():
        code = code.replace(word, str(value))
    return in_precision(code, name)


@cache
@no_type_check
def lane_numbers() -> SimpleNamespace:
    """Return the functions `group` and `row` of a lane of a warp: its segment, none from three on, and its nodes."""

    @wp.func_native(f"return {GROUP};")
    def group(lane: int) -> int: ...

    @wp.func_native(f"return {ROW};")
    def row(lane: int) -> int: ...

    return SimpleNamespace(group=group, row=row)


@cache
@no_type_check
def walker(name: str, *, sloping: bool) -> SimpleNamespace:
    """Return the functions `at_nodes, most, open, walk, close` of one precision.

    `at_nodes` says what a particle gives to its nodes, as a `Given`, whose a, mass and third q must be 0 unless it is
    `sloping`. A warp's lanes call the others together: `most` for the greatest of their counts, `open` before they walk
    along their segment, whose parts begin at `at`, `close` after it. `walk` adds the next `count` particles of each
    group to its parts, of which a lane knows that of its row. `span` is what `Lists` has of planes and the first cell.
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
    def walk(parts: wp.array2d[vec4], e: int, at: int, span: int, count: int, p: Given, state: State) -> State: ...

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
