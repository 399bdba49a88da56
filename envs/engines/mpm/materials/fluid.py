"""Kernels of a viscous, weakly compressible fluid, which carries its volume ratio J."""

from functools import cache, partial
from typing import Any, no_type_check

import warp as wp

from ... import cpp
from ...runtime import precision
from ..stencil import layout
from .adjoints import MaterialKernels

TORN = 1.04  # volume ratio at which a fluid tears


@cache
@no_type_check
def kernels(name: str) -> MaterialKernels:
    """Return the kernels of a GPU.

    J' = min(exp(dt tr C) J, TORN), tau = K log J' I + J' mu (C + C^T - 2/3 tr C I).
    """
    types = precision(name)
    real, mat33 = types.real, types.mat33
    module = cpp.module(f"gradscape.fluid.{name}")
    read_matrix, write_matrix = layout(name).read_matrix, layout(name).write_matrix

    @wp.func(module=module)
    def shear(C: mat33) -> mat33:
        return C + wp.transpose(C) - (real(2.0) / real(3.0)) * wp.trace(C) * wp.identity(n=3, dtype=real)

    @wp.func(module=module)
    def grow(dt: real, J: real, C: mat33) -> real:
        return wp.min(wp.exp(dt * wp.trace(C)) * J, real(TORN))

    @wp.func(module=module)
    def affine_momentum(
        first: int,
        dt: real,
        scale: real,
        bulk: real,
        viscosity: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        J: wp.array2d[real],
        C: wp.array2d[mat33],
        e: int,
        p: int,
    ) -> mat33:
        c = read_matrix(C, e, first + p)
        j = grow(dt, J[e, p], c)
        tau = bulk * wp.log(j) * wp.identity(n=3, dtype=real) + j * viscosity * shear(c)
        return scale * volume[e, first + p] * tau + mass[e, first + p] * c

    @wp.kernel(module=module, enable_backward=False)
    def update(
        first: int,
        dt: real,
        scale: real,
        bulk: real,
        viscosity: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        J: wp.array2d[real],
        C: wp.array2d[mat33],
        J_new: wp.array2d[real],
        A: wp.array2d[mat33],
    ):
        e, p = wp.tid()
        a = affine_momentum(first, dt, scale, bulk, viscosity, mass, volume, J, C, e, p)
        J_new[e, p] = grow(dt, J[e, p], read_matrix(C, e, first + p))
        write_matrix(A, e, first + p, a)

    @wp.func(module=module)
    def turn_back(
        first: int,
        dt: real,
        scale: real,
        bulk: real,
        viscosity: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        J: wp.array2d[real],
        C: wp.array2d[mat33],
        adj_J_new: wp.array2d[real],
        adj_a: mat33,
        adj_J: wp.array2d[real],
        adj_C: wp.array2d[mat33],
        e: int,
        p: int,
    ):
        c = read_matrix(C, e, first + p)
        growth = wp.exp(dt * wp.trace(c))
        j = wp.min(growth * J[e, p], real(TORN))
        g = (scale * volume[e, first + p]) * adj_a  # the adjoint of tau
        adj_j = adj_J_new[e, p] + bulk * wp.trace(g) / j + viscosity * wp.ddot(g, shear(c))
        if growth * J[e, p] > real(TORN):
            adj_j = real(0.0)
        adj_J[e, p] = growth * adj_j
        dilation = dt * j * adj_j * wp.identity(n=3, dtype=real)
        write_matrix(adj_C, e, first + p, mass[e, first + p] * adj_a + j * viscosity * shear(g) + dilation)

    return MaterialKernels(update, turn_back, affine_momentum)


@cache
@no_type_check
def kernels_in_rows(name: str) -> tuple[Any, Any]:
    """Return (update, adjoint) of one precision for a CPU, in C++: eight particles at a time (`native/materials.h`)."""
    types = precision(name)
    real, numbers, matrices = types.real, wp.array2d[types.real], wp.array2d[types.mat33]
    declare = partial(cpp.kernel_in_rows, f"gradscape.fluid.{name}.rows")
    shared = {"first": int} | dict.fromkeys(("dt", "scale", "bulk", "viscosity"), real)
    shared |= {"mass": numbers, "volume": numbers, "J": numbers, "C": matrices}
    update = declare("fluid_update", TORN, **shared, J_new=numbers, A=matrices)
    adjoints = {"adj_J_new": numbers, "adj_A": matrices, "adj_J": numbers, "adj_C": matrices}
    adjoint = declare("fluid_adjoint", TORN, **shared, **adjoints)
    return update, adjoint
