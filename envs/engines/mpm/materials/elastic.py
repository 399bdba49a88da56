"""Kernels of a compressible neo-Hookean solid, which carries its deformation gradient F."""

from functools import cache
from typing import Any, no_type_check

import warp as wp

from ...runtime import precision


@cache
@no_type_check
def kernels(name: str) -> tuple[Any, Any]:
    """Return (update, adjoint): F' = (I + dt C) F, tau = mu (F' F'^T - I) + lam log(det F') I."""
    types = precision(name)
    real, mat33 = types.real, types.mat33
    module = f"gradscape.elastic.{name}"

    @wp.kernel(module=module, enable_backward=False)
    def update(
        first: int,
        dt: real,
        scale: real,
        mu: real,
        lam: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        F_new: wp.array2d[mat33],
        A: wp.array2d[mat33],
    ):
        e, p = wp.tid()
        c = C[e, first + p]
        f = F[e, p] + dt * c * F[e, p]
        identity = wp.identity(n=3, dtype=real)
        tau = mu * (f * wp.transpose(f) - identity) + lam * wp.log(wp.determinant(f)) * identity
        F_new[e, p] = f
        A[e, first + p] = scale * volume[e, first + p] * tau + mass[e, first + p] * c

    @wp.kernel(module=module, enable_backward=False)
    def adjoint(
        first: int,
        dt: real,
        scale: real,
        mu: real,
        lam: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        adj_F_new: wp.array2d[mat33],
        adj_A: wp.array2d[mat33],
        adj_F: wp.array2d[mat33],
        adj_C: wp.array2d[mat33],
    ):
        e, p = wp.tid()
        identity = wp.identity(n=3, dtype=real)
        advance = identity + dt * C[e, first + p]
        f = advance * F[e, p]
        g = (scale * volume[e, first + p]) * adj_A[e, first + p]  # the adjoint of tau
        adj_f = adj_F_new[e, p] + mu * (g + wp.transpose(g)) * f + lam * wp.trace(g) * wp.transpose(wp.inverse(f))
        adj_F[e, p] = wp.transpose(advance) * adj_f
        adj_C[e, first + p] = mass[e, first + p] * adj_A[e, first + p] + dt * adj_f * wp.transpose(F[e, p])

    return update, adjoint
