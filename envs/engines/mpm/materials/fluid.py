"""Kernels of a viscous, weakly compressible fluid, which carries its volume ratio J."""

from functools import cache, partial
from typing import Any, no_type_check

import warp as wp

from ... import cpp
from ...runtime import precision
from ..stencil import layout
from .adjoints import MaterialKernels, law_struct

TORN = 1.04  # volume ratio at which a fluid tears


@cache
@no_type_check
def kernels(name: str) -> MaterialKernels:
    """Return the kernels of a GPU.

    J' = min(exp(dt tr C) J, TORN), tau = K log J' I + J' mu (C + C^T - 2/3 tr C I).
    """
    types = precision(name)
    real, mat33, (Reals, _, _, Matrices) = types.real, types.mat33, types.rows
    Law = law_struct(name, "bulk", "viscosity")
    module = cpp.module(f"gradscape.fluid.{name}")
    read_matrix, write_matrix = layout(name).read_matrix, layout(name).write_matrix

    @wp.func(module=module)
    def shear(C: mat33) -> mat33:
        return C + wp.transpose(C) - (real(2.0) / real(3.0)) * wp.trace(C) * wp.identity(n=3, dtype=real)

    @wp.func(module=module)
    def grow(dt: real, J: real, C: mat33) -> real:
        return wp.min(wp.exp(dt * wp.trace(C)) * J, real(TORN))

    @wp.func(module=module)
    def affine_momentum(law: Law, mass: Reals, volume: Reals, J: Reals, C: Matrices, e: int, p: int) -> mat33:
        c = read_matrix(C, e, law.first + p)
        j = grow(law.dt, J[e, p], c)
        tau = law.bulk * wp.log(j) * wp.identity(n=3, dtype=real) + j * law.viscosity * shear(c)
        return law.scale * volume[e, law.first + p] * tau + mass[e, law.first + p] * c

    @wp.kernel(module=module, enable_backward=False)
    def update(law: Law, mass: Reals, volume: Reals, J: Reals, C: Matrices, J_new: Reals, A: Matrices):
        e, p = wp.tid()
        a = affine_momentum(law, mass, volume, J, C, e, p)
        J_new[e, p] = grow(law.dt, J[e, p], read_matrix(C, e, law.first + p))
        write_matrix(A, e, law.first + p, a)

    @wp.func(module=module)
    def turn_back(
        law: Law,
        mass: Reals,
        volume: Reals,
        J: Reals,
        C: Matrices,
        adj_J_new: Reals,
        adj_a: mat33,
        adj_J: Reals,
        adj_C: Matrices,
        e: int,
        p: int,
    ):
        c = read_matrix(C, e, law.first + p)
        growth = wp.exp(law.dt * wp.trace(c))
        j = wp.min(growth * J[e, p], real(TORN))
        g = (law.scale * volume[e, law.first + p]) * adj_a  # the adjoint of tau
        adj_j = adj_J_new[e, p] + law.bulk * wp.trace(g) / j + law.viscosity * wp.ddot(g, shear(c))
        if growth * J[e, p] > real(TORN):
            adj_j = real(0.0)
        adj_J[e, p] = growth * adj_j
        dilation = law.dt * j * adj_j * wp.identity(n=3, dtype=real)
        write_matrix(adj_C, e, law.first + p, mass[e, law.first + p] * adj_a + j * law.viscosity * shear(g) + dilation)

    return MaterialKernels(update, turn_back, affine_momentum)


@cache
@no_type_check
def kernels_in_rows(name: str) -> tuple[Any, Any]:
    """Return (update, adjoint) of one precision for a CPU, in C++: eight particles at a time (`native/materials.h`)."""
    numbers, _, _, matrices = precision(name).rows
    declare = partial(cpp.kernel_in_rows, f"gradscape.fluid.{name}.rows")
    given = {"law": law_struct(name, "bulk", "viscosity"), "mass": numbers, "volume": numbers}
    given |= {"J": numbers, "C": matrices}
    adjoints = {"adj_J_new": numbers, "adj_A": matrices, "adj_J": numbers, "adj_C": matrices}
    update = declare("fluid_update", TORN, **given, J_new=numbers, A=matrices)
    return update, declare("fluid_adjoint", TORN, **given, **adjoints)
