"""The 27 nodes around a particle, and their weights: quadratic B-splines (Steffen et al. 2008), as Warp functions."""

from functools import cache, partial
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from .. import cpp
from ..runtime import precision


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
        does not depend on them, to the last bit.
        """

        origin: vec3
        inv_dx: real
        first: wp.vec3i
        nx: int
        ny: int
        nz: int

    return Lattice


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
