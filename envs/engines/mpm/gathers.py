"""What particles gather from their nodes, for a GPU, as functions.

The formulas are those of `transfers`, summed along z first, then y, then x: fewer operations, and fewer numbers under
way.
"""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ..runtime import precision
from .layout import in_precision, layout
from .stencil import lattice, stencil

# Sums over the nodes of a particle, which is at `f` from its corner, node (0, 0, 0): of w v, w i v, w j v, w k v, v
# being a node's first three numbers and w its weight, and of the slopes of w, times what the node is given of v: its
# product with q + a (i, j, k), and MASS. Sums that are not wanted a compiler leaves out.
GATHER = """
    FOUR
    struct Vec {
        REAL x, y, z;
        Vec operator+(const Vec &b) const { return Vec{x + b.x, y + b.y, z + b.z}; }
        Vec operator*(REAL s) const { return Vec{x * s, y * s, z * s}; }
        REAL dot(const Vec &b) const { return x * b.x + y * b.y + z * b.z; }
    };
    const REAL half = REAL(0.5), one = REAL(1.0), more = REAL(1.5), two = REAL(2.0);
    REAL w[3][3], d[3][3];
    for (int axis = 0; axis < 3; ++axis) {
        const REAL low = f[axis] - more, middle = f[axis] - one, high = f[axis] - half;
        w[axis][0] = half * low * low, w[axis][1] = REAL(0.75) - middle * middle, w[axis][2] = half * high * high;
        d[axis][0] = low, d[axis][1] = -two * middle, d[axis][2] = high;
    }
    const auto column = [&](int k) { return Vec{a.data[0][k], a.data[1][k], a.data[2][k]}; };
    const Vec ax = column(0), ay = column(1), az = column(2);
    const Four *nodes = (const Four *)&wp::index(grid, e, 0);
    const int *start = &wp::index(starts, e, corner[0] * lattice.ny + corner[1]), last = grid.shape[1] - 3;
    Vec s{}, si{}, sj{}, sk{}, slope{};
#pragma unroll
    for (int i = 0; i < 3; ++i, start += lattice.ny) {
        const REAL wi = w[0][i];
        const Vec first{q[0], q[1], q[2]}, qi = i ? first + ax * REAL(i) : first;
        Vec r{}, rj{}, rk{}, change{};
#pragma unroll
        for (int j = 0; j < 3; ++j) {
            const int at = wp::min(wp::max(start[j] + corner[2], 0), last);  // of a particle that is nowhere, too
            const Four n0 = nodes[at], n1 = nodes[at + 1], n2 = nodes[at + 2];
            const Vec v0{n0.a, n0.b, n0.c}, v1{n1.a, n1.b, n1.c}, v2{n2.a, n2.b, n2.c};
            const REAL wj = w[1][j];
            const Vec w1 = v1 * w[2][1], w2 = v2 * w[2][2], wv = v0 * w[2][0] + w1 + w2;
            const Vec q0 = j ? qi + ay * REAL(j) : qi, q1 = q0 + az, q2 = q1 + az;
            r = r + wv * wj, rk = rk + (w1 + w2 * two) * wj;
            if (j) rj = rj + wv * (wj * REAL(j));
            const REAL t0 = q0.dot(v0)MASS(0), t1 = q1.dot(v1)MASS(1), t2 = q2.dot(v2)MASS(2);
            const REAL t = w[2][0] * t0 + w[2][1] * t1 + w[2][2] * t2;
            const REAL u = d[2][0] * t0 + d[2][1] * t1 + d[2][2] * t2;
            change = change + Vec{wj * t, d[1][j] * t, wj * u};
        }
        s = s + r * wi, sj = sj + rj * wi, sk = sk + rk * wi;
        if (i) si = si + r * (wi * REAL(i));
        slope = slope + Vec{d[0][i] * change.x, wi * change.y, wi * change.z};
    }
    wp::mat_t<5, 3, REAL> sums;
    const Vec rows[] = {s, si, sj, sk, slope};
    for (int row = 0; row < 5; ++row)
        sums.data[row][0] = rows[row].x, sums.data[row][1] = rows[row].y, sums.data[row][2] = rows[row].z;
    return sums;
"""


def with_mass(code: str, mass: str) -> str:
    """Say what is added to a product of nodes NUMBER."""
    for number in "012":
        code = code.replace(f"MASS({number})", mass.replace("NUMBER", number))
    return code


@cache
@no_type_check
def gatherers(name: str) -> SimpleNamespace:
    """Return the functions `gather, gather_with_mass, from_base` of one precision.

    `from_base(x, base, lattice)` is where x is from node `base`, in cells.
    """
    types = precision(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    Lattice, Sums = lattice(name), wp.types.matrix((5, 3), real)

    @wp.func_native(in_precision(with_mass(GATHER, ""), name))
    def gather(
        lattice: Lattice,
        starts: wp.array2d[wp.int32],
        grid: wp.array2d[vec4],
        e: int,
        corner: wp.vec3i,
        f: vec3,
        q: vec3,
        a: mat33,
    ) -> Sums: ...

    @wp.func_native(in_precision(with_mass(GATHER, " + mass * nNUMBER.d"), name))
    def gather_with_mass(
        lattice: Lattice,
        starts: wp.array2d[wp.int32],
        grid: wp.array2d[vec4],
        e: int,
        corner: wp.vec3i,
        f: vec3,
        q: vec3,
        a: mat33,
        mass: real,
    ) -> Sums: ...

    @wp.func(module=f"gradscape.gathers.{name}")
    def from_base(x: vec3, base: wp.vec3i, lattice: Lattice):
        return (x - lattice.origin) * lattice.inv_dx - vec3(real(base[0]), real(base[1]), real(base[2]))

    return SimpleNamespace(gather=gather, gather_with_mass=gather_with_mass, from_base=from_base)


@cache
@no_type_check
def adjoint_gatherers(name: str) -> SimpleNamespace:
    """Return the functions that gather adjoints: `g2p` returns that of x, `p2g` those of A and x, and sets that of v.

    `p2g` takes a particle's affine `momentum` A as a matrix. The adjoint of x is the sum of both.
    """
    types, lies, sums_of = precision(name), layout(name), gatherers(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    Lattice, base_node, module = lattice(name), stencil(name).base_node, f"gradscape.gathers.{name}"
    gather, gather_with_mass, from_base = sums_of.gather, sums_of.gather_with_mass, sums_of.from_base
    read_number, read_vector, read_matrix = lies.read_number, lies.read_vector, lies.read_matrix

    @wp.func(module=module)
    def g2p(
        lattice: Lattice,
        starts: wp.array2d[wp.int32],
        dt: real,
        x: wp.array2d[vec3],
        grid_v: wp.array2d[vec4],
        adj_x_new: wp.array2d[vec3],
        adj_v_new: wp.array2d[vec3],
        adj_C_new: wp.array2d[mat33],
        e: int,
        p: int,
    ):
        here = read_vector(x, e, p)
        base = base_node((here - lattice.origin) * lattice.inv_dx, lattice)
        f = from_base(here, base, lattice)
        a = (real(4.0) * lattice.inv_dx) * read_matrix(adj_C_new, e, p)
        adj = read_vector(adj_x_new, e, p)
        q = read_vector(adj_v_new, e, p) + dt * adj - a * f
        sums = gather(lattice, starts, grid_v, e, base - lattice.first, f, q, a)
        return adj + lattice.inv_dx * (sums[4] - wp.transpose(a) * sums[0])

    @wp.func(module=module)
    def p2g(
        lattice: Lattice,
        starts: wp.array2d[wp.int32],
        mass: wp.array2d[real],
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
        momentum: mat33,
        adj_grid_m: wp.array2d[vec4],
        adj_v: wp.array2d[vec3],
        e: int,
        p: int,
    ):
        here = read_vector(x, e, p)
        base = base_node((here - lattice.origin) * lattice.inv_dx, lattice)
        f = from_base(here, base, lattice)
        m = read_number(mass, e, p)
        dx = real(1.0) / lattice.inv_dx
        a = momentum * dx
        q = m * read_vector(v, e, p) - a * f
        sums = gather_with_mass(lattice, starts, adj_grid_m, e, base - lattice.first, f, q, a, m)
        h = sums[0]
        adj_v[e, p] = m * h
        adj_A = dx * wp.matrix_from_cols(sums[1] - f[0] * h, sums[2] - f[1] * h, sums[3] - f[2] * h)
        return adj_A, lattice.inv_dx * (sums[4] - wp.transpose(a) * h)

    return SimpleNamespace(g2p=g2p, p2g=p2g)
