"""A compressible neo-Hookean solid, which carries its deformation gradient F, as functions of a particle."""

from functools import cache
from typing import no_type_check

import warp as wp

from ... import cpp
from ...runtime import precision
from .kernels import Response, law_struct


@cache
@no_type_check
def response(name: str) -> Response:
    """Return the functions of one precision.

    F' = (I + dt C) F, tau = mu (F' F'^T - I) + lam log(det F') I.
    """
    real, mat33, Law = precision(name).real, precision(name).mat33, law_struct(name, "mu", "lam")
    module = cpp.module(f"gradscape.elastic.{name}")

    @wp.func(module=module)
    def respond(law: Law, F: mat33, C: mat33):
        f = F + law.dt * C * F
        identity = wp.identity(n=3, dtype=real)
        return f, law.mu * (f * wp.transpose(f) - identity) + law.lam * wp.log(wp.determinant(f)) * identity

    @wp.func(module=module)
    def turn_back(
        law: Law, F: mat33, C: mat33, strain: int, adj_F_new: mat33, weight: real, adj_a: mat33, carried: mat33
    ):
        advance = wp.identity(n=3, dtype=real) + law.dt * C
        f = advance * F
        g = weight * adj_a  # the adjoint of tau
        adj_f = adj_F_new + law.mu * (g + wp.transpose(g)) * f + law.lam * wp.trace(g) * wp.transpose(wp.inverse(f))
        return wp.transpose(advance) * adj_f, carried + law.dt * adj_f * wp.transpose(F)

    return Response(module, Law, mat33, respond, turn_back)
