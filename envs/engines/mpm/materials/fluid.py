"""Kernels of a viscous, weakly compressible fluid, which carries its volume ratio J.

What a smoothed fluid bears of tension is less than 0.1 % of its bulk modulus, and holds no free surface: a heavy cube
that is half in sinks as far where J stays below 1. What held it were walls without images (`mirrors`), and that a solid
stops syrup a good half cell before it, so that it displaced more than itself. Both are mended. A cube 670 kg/m^3
heavier than syrup of 20 Pa s, or as much lighter, in a tank 0.2 m wide and 0.15 m deep (`benchmarks/drag.py`), in cells
of 12.5 mm:

    tried                          speed in the   drift of a     top of a cube    height of syrup
                                   middle         neutral one    half in, 1.5 s   after 3 s
    neither (model 1)              23.4 mm/s      7.5 mm/s       141 mm           -6.1 %
    J below 1 (TORN = 1)           the same       the same       141 mm           -6.1 %
    walls half a cell off nodes    13 mm/s        -0.6 mm/s      not measured     none
    walls that reflect             20.7 mm/s      0.0 mm/s       150 mm           none
    smoothed at each substep, too  1 mm/s more    the same       not measured     none
    cube's particles half a cell   30.8 mm/s      11 mm/s        122 mm           -6.7 %
      inside its faces
    both                           28.3 mm/s      2.0 mm/s       137 mm           -0.2 %
    both, in cells of 8.3 mm       30.8 mm/s      1.3 mm/s       130 mm           -0.2 %
    known                          33.7 mm/s      0                               0

Syrup that stands 0.15 m deep falls by 9 mm in 3 s where it loses 6 %, so that the cube of model 1 stood out of it.
Volume that is hard to change still adds drag: at half the speed of sound a cube sinks an eighth faster in cells of 12.5
mm, at twice it a fifth slower.
"""

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
