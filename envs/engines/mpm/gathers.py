"""What particles gather from their nodes, for a GPU, as functions.

The formulas are those of `transfers`, summed along z first, then y, then x: fewer operations, and fewer numbers under
way.
"""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from .. import cpp
from ..runtime import precision
from .layout import layout
from .stencil import lattice, stencil


@cache
@no_type_check
def gatherers(name: str) -> SimpleNamespace:
    """Return the functions `gather, gather_with_mass, from_base` of one precision.

    `from_base(x, base, lattice)` is where x is from node `base`, in cells.
    """
    types = precision(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    Lattice, Sums = lattice(name), wp.types.matrix((5, 3), real)

    def declare(with_mass: bool):
        @cpp.func_native(called="gather_sums", template=[str(with_mass).lower()])
        def gather(
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

        return gather

    @wp.func(module=f"gradscape.gathers.{name}")
    def from_base(x: vec3, base: wp.vec3i, lattice: Lattice):
        return (x - lattice.origin) * lattice.inv_dx - vec3(real(base[0]), real(base[1]), real(base[2]))

    return SimpleNamespace(gather=declare(False), gather_with_mass=declare(True), from_base=from_base)


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
        sums = gather(lattice, starts, grid_v, e, base - lattice.first, f, q, a, real(0.0))
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
