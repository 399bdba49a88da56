"""Kernels of a compressible neo-Hookean solid, which carries its deformation gradient F."""

from functools import cache
from typing import no_type_check

import warp as wp

from ... import cpp
from ...runtime import precision
from ..stencil import layout
from .adjoints import MaterialKernels


@cache
@no_type_check
def kernels(name: str) -> MaterialKernels:
    """Return the kernels.

    F' = (I + dt C) F, tau = mu (F' F'^T - I) + lam log(det F') I.
    """
    types = precision(name)
    real, mat33 = types.real, types.mat33
    module = cpp.module(f"gradscape.elastic.{name}")
    read_matrix, write_matrix = layout(name).read_matrix, layout(name).write_matrix

    @wp.func(module=module)
    def stretch(dt: real, F: mat33, C: mat33) -> mat33:
        return F + dt * C * F

    @wp.func(module=module)
    def affine_momentum(
        first: int,
        dt: real,
        scale: real,
        mu: real,
        lam: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        e: int,
        p: int,
    ) -> mat33:
        c = read_matrix(C, e, first + p)
        f = stretch(dt, read_matrix(F, e, p), c)
        identity = wp.identity(n=3, dtype=real)
        tau = mu * (f * wp.transpose(f) - identity) + lam * wp.log(wp.determinant(f)) * identity
        return scale * volume[e, first + p] * tau + mass[e, first + p] * c

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
        a = affine_momentum(first, dt, scale, mu, lam, mass, volume, F, C, e, p)
        write_matrix(F_new, e, p, stretch(dt, read_matrix(F, e, p), read_matrix(C, e, first + p)))
        write_matrix(A, e, first + p, a)

    @wp.func(module=module)
    def turn_back(
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
        adj_a: mat33,
        adj_F: wp.array2d[mat33],
        adj_C: wp.array2d[mat33],
        e: int,
        p: int,
    ):
        identity = wp.identity(n=3, dtype=real)
        advance = identity + dt * read_matrix(C, e, first + p)
        before = read_matrix(F, e, p)
        f = advance * before
        g = (scale * volume[e, first + p]) * adj_a  # the adjoint of tau
        adj_f = (
            read_matrix(adj_F_new, e, p)
            + mu * (g + wp.transpose(g)) * f
            + lam * wp.trace(g) * wp.transpose(wp.inverse(f))
        )
        write_matrix(adj_F, e, p, wp.transpose(advance) * adj_f)
        write_matrix(adj_C, e, first + p, mass[e, first + p] * adj_a + dt * adj_f * wp.transpose(before))

    return MaterialKernels(update, turn_back, affine_momentum)
