"""How a warp of a GPU walks along the cells of its segments, and adds up what their particles give to nodes.

Nine lanes take the particles of a segment one after the other. Each holds the sums of three of the 27 nodes around the
present cell, a row along z. Where the next cell begins, the lowest nine are written down, beside each other, since a
cache takes whole sectors much faster than parts of them, and the others become lower by one.
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
