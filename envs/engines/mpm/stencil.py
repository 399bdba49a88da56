"""The 27 nodes around a particle, and their weights: quadratic B-splines (Steffen et al. 2008), as Warp functions."""

from functools import cache, partial
from types import SimpleNamespace
from typing import no_type_check

import torch
import warp as wp

from .. import cpp
from ..runtime import Ints, precision

# ---- How arrays lie in memory, and how they are read and written: wide reads on a GPU, Warp's own on a CPU.
#
# A matrix of each particle lies as Warp has it on a CPU. On a GPU an environment's row holds the first numbers of all
# matrices, then the second ones, and so on: neighbouring threads then read what lies side by side, where the
# numbers of a matrix would be read 36 bytes apart. `to_rows` brings a tensor of matrices into that order. The four
# numbers of a node are read and written as one. `native/layout.h` does so.


@cache
@no_type_check
def layout(name: str) -> SimpleNamespace:
    """Return the functions that read and write a number, a matrix or a node, and that reads a vector."""
    types = precision(name)
    real, vec3, mat33, vec4 = types.real, types.vec3, types.mat33, types.vec4
    Reals, Vectors, Nodes, Matrices = types.rows

    @cpp.func_native(adjoint="adj_read_element")
    def read_matrix(values: Matrices, e: int, p: int) -> mat33: ...

    @cpp.func_native(adjoint="adj_write_matrix")
    def write_matrix(values: Matrices, e: int, p: int, value: mat33): ...

    @cpp.func_native(adjoint="adj_read_element")
    def read_node(grid: Nodes, e: int, i: int) -> vec4: ...

    @cpp.func_native()
    def write_node(grid: Nodes, e: int, i: int, value: vec4): ...

    @cpp.func_native(called="read_element", adjoint="adj_read_element")
    def read_number(values: Reals, e: int, i: int) -> real: ...

    @wp.func(module=f"gradscape.layout.{name}")
    def write_number(values: Reals, e: int, i: int, value: real):
        values[e, i] = value

    @cpp.func_native(called="read_element", adjoint="adj_read_element")
    def read_vector(values: Vectors, e: int, i: int) -> vec3: ...

    return SimpleNamespace(
        read_number=read_number,
        write_number=write_number,
        read_vector=read_vector,
        read_matrix=read_matrix,
        write_matrix=write_matrix,
        read_node=read_node,
        write_node=write_node,
    )


def to_rows(values: torch.Tensor, device: str) -> torch.Tensor:
    """Return what is to be copied into an array [environment, particle], whose rows are all `values`: (particle, *)."""
    if device == "cpu" or values.ndim == 1:
        return values
    return values.flatten(1).T.contiguous().view(values.shape)


@cache
@no_type_check
def lattice(name: str) -> type:
    """Return the struct that places a grid, in one precision."""
    types = precision(name)
    real, vec3 = types.real, types.vec3

    @partial(wp.struct, module=f"gradscape.lattice.{name}")
    class Lattice:
        """Place the grid: node (0, 0, 0) at `origin` [m], spacing 1/`inv_dx` [m].

        Arrays hold `nx, ny, nz` nodes from node `first` on. As long as they cover what a particle reads and writes, it
        does not depend on them, to the last bit. Walls that reflect are `below` and `above` along each
        axis, in halves of a cell from node (0, 0, 0); 0 says that there is none.
        """

        origin: vec3
        inv_dx: real
        first: wp.vec3i
        nx: int
        ny: int
        nz: int
        below: wp.vec3i
        above: wp.vec3i

    return Lattice


@cache
@no_type_check
def particles(name: str) -> type:
    """Return the struct of particles' places, velocities and affine velocities, or of the adjoints of these."""
    _, Vectors, _, Matrices = precision(name).rows

    @partial(wp.struct, module=f"gradscape.particles.{name}")
    class Particles:
        """x [m], v [m/s] and C [1/s], [environment, particle]."""

        x: Vectors
        v: Vectors
        C: Matrices

    return Particles


@cache
@no_type_check
def stencil(name: str) -> SimpleNamespace:
    """Return the functions `base_node, weights, weight_slopes` of one precision.

    A particle at s, counted in cells from the grid's origin, meets three nodes along each axis, from its base node on:
    with f = s - base, their weights are `weights(f)`, and `weight_slopes(f)` the derivatives of these.
    """
    types = precision(name)
    real, vec3 = types.real, types.vec3
    Lattice, module = lattice(name), f"gradscape.stencil.{name}"

    @cpp.func_native(called="lowest_node")
    def lowest(s: real) -> int: ...

    @wp.func(module=module)
    def base_node(s: vec3, lattice: Lattice):
        # Clamped, so that a particle out of the grid (its episode is reported as escaped) touches no foreign memory.
        return wp.vec3i(
            wp.clamp(lowest(s[0]), lattice.first[0], lattice.first[0] + lattice.nx - 3),
            wp.clamp(lowest(s[1]), lattice.first[1], lattice.first[1] + lattice.ny - 3),
            wp.clamp(lowest(s[2]), lattice.first[2], lattice.first[2] + lattice.nz - 3),
        )

    @wp.func(module=module)
    def weights(f: real):
        return vec3(
            real(0.5) * (real(1.5) - f) * (real(1.5) - f),
            real(0.75) - (f - real(1.0)) * (f - real(1.0)),
            real(0.5) * (f - real(0.5)) * (f - real(0.5)),
        )

    @wp.func(module=module)
    def weight_slopes(f: real):
        return vec3(f - real(1.5), real(2.0) - real(2.0) * f, f - real(0.5))

    return SimpleNamespace(base_node=base_node, weights=weights, weight_slopes=weight_slopes)


# ---- What particles gather from their nodes, for a GPU, as functions.
#
# The formulas are those of `transfers`, summed along z first, then y, then x: fewer operations, and fewer numbers under
# way.


@cache
@no_type_check
def gatherers(name: str) -> SimpleNamespace:
    """Return the functions `gather, gather_with_mass, from_base` of one precision.

    `from_base(x, base, lattice)` is where x is from node `base`, in cells.
    """
    types = precision(name)
    real, vec3, mat33, Nodes = types.real, types.vec3, types.mat33, types.rows[2]
    Lattice, Sums = lattice(name), wp.types.matrix((5, 3), real)

    def declare(with_mass: bool):
        @cpp.func_native(called="gather_sums", template=[str(with_mass).lower()])
        def gather(
            lattice: Lattice,
            starts: Ints,
            grid: Nodes,
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
    real, mat33, (Reals, Vectors, Nodes, _) = types.real, types.mat33, types.rows
    Lattice, Particles, base_node = lattice(name), particles(name), stencil(name).base_node
    module = f"gradscape.gathers.{name}"
    gather, gather_with_mass, from_base = sums_of.gather, sums_of.gather_with_mass, sums_of.from_base
    read_number, read_vector, read_matrix = lies.read_number, lies.read_vector, lies.read_matrix

    @wp.func(module=module)
    def g2p(lattice: Lattice, starts: Ints, dt: real, x: Vectors, grid_v: Nodes, adj_new: Particles, e: int, p: int):
        here = read_vector(x, e, p)
        base = base_node((here - lattice.origin) * lattice.inv_dx, lattice)
        f = from_base(here, base, lattice)
        a = (real(4.0) * lattice.inv_dx) * read_matrix(adj_new.C, e, p)
        adj = read_vector(adj_new.x, e, p)
        q = read_vector(adj_new.v, e, p) + dt * adj - a * f
        sums = gather(lattice, starts, grid_v, e, base - lattice.first, f, q, a, real(0.0))
        return adj + lattice.inv_dx * (sums[4] - wp.transpose(a) * sums[0])

    @wp.func(module=module)
    def p2g(
        lattice: Lattice,
        starts: Ints,
        mass: Reals,
        x: Vectors,
        v: Vectors,
        momentum: mat33,
        adj_grid_m: Nodes,
        adj_v: Vectors,
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
