"""A viscous, weakly compressible fluid, which carries its volume ratio J, as functions of a particle.

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

from functools import cache
from typing import no_type_check

import warp as wp

from ... import cpp
from ...runtime import precision
from .kernels import Response, law_struct

TORN = 1.04  # volume ratio at which a fluid tears


@cache
@no_type_check
def response(name: str) -> Response:
    """Return the functions of one precision.

    J' = min(exp(dt tr C) J, TORN), tau = K log J' I + J' mu (C + C^T - 2/3 tr C I).
    """
    real, mat33, Law = precision(name).real, precision(name).mat33, law_struct(name, "bulk", "viscosity")
    module = cpp.module(f"gradscape.fluid.{name}")

    @wp.func(module=module)
    def shear(C: mat33) -> mat33:
        return C + wp.transpose(C) - (real(2.0) / real(3.0)) * wp.trace(C) * wp.identity(n=3, dtype=real)

    @wp.func(module=module)
    def respond(law: Law, J: real, C: mat33):
        j = wp.min(wp.exp(law.dt * wp.trace(C)) * J, real(TORN))
        return j, law.bulk * wp.log(j) * wp.identity(n=3, dtype=real) + j * law.viscosity * shear(C)

    @wp.func(module=module)
    def turn_back(
        law: Law, J: real, C: mat33, strain: int, adj_J_new: real, weight: real, adj_a: mat33, carried: mat33
    ):
        growth = wp.exp(law.dt * wp.trace(C))
        j = wp.min(growth * J, real(TORN))
        g = weight * adj_a  # the adjoint of tau
        adj_j = adj_J_new + law.bulk * wp.trace(g) / j + law.viscosity * wp.ddot(g, shear(C))
        if growth * J > real(TORN):
            adj_j = real(0.0)
        dilation = law.dt * j * adj_j * wp.identity(n=3, dtype=real)
        return growth * adj_j, carried + j * law.viscosity * shear(g) + dilation

    return Response(module, Law, real, respond, turn_back)
