"""Kernels of a compressible neo-Hookean solid, which carries its deformation gradient F."""

from functools import cache
from typing import no_type_check

import warp as wp

from ... import cpp
from ...runtime import precision
from ..stencil import layout
from .adjoints import MaterialKernels, law_struct


@cache
@no_type_check
def kernels(name: str) -> MaterialKernels:
    """Return the kernels.

    F' = (I + dt C) F, tau = mu (F' F'^T - I) + lam log(det F') I.
    """
    types = precision(name)
    real, mat33, (Reals, _, _, Matrices) = types.real, types.mat33, types.rows
    Law = law_struct(name, "mu", "lam")
    module = cpp.module(f"gradscape.elastic.{name}")
    read_matrix, write_matrix = layout(name).read_matrix, layout(name).write_matrix

    @wp.func(module=module)
    def stretch(dt: real, F: mat33, C: mat33) -> mat33:
        return F + dt * C * F

    @wp.func(module=module)
    def affine_momentum(law: Law, mass: Reals, volume: Reals, F: Matrices, C: Matrices, e: int, p: int) -> mat33:
        c = read_matrix(C, e, law.first + p)
        f = stretch(law.dt, read_matrix(F, e, p), c)
        identity = wp.identity(n=3, dtype=real)
        tau = law.mu * (f * wp.transpose(f) - identity) + law.lam * wp.log(wp.determinant(f)) * identity
        return law.scale * volume[e, law.first + p] * tau + mass[e, law.first + p] * c

    @wp.kernel(module=module, enable_backward=False)
    def update(law: Law, mass: Reals, volume: Reals, F: Matrices, C: Matrices, F_new: Matrices, A: Matrices):
        e, p = wp.tid()
        a = affine_momentum(law, mass, volume, F, C, e, p)
        write_matrix(F_new, e, p, stretch(law.dt, read_matrix(F, e, p), read_matrix(C, e, law.first + p)))
        write_matrix(A, e, law.first + p, a)

    @wp.func(module=module)
    def turn_back(
        law: Law,
        mass: Reals,
        volume: Reals,
        F: Matrices,
        C: Matrices,
        adj_F_new: Matrices,
        adj_a: mat33,
        adj_F: Matrices,
        adj_C: Matrices,
        e: int,
        p: int,
    ):
        identity = wp.identity(n=3, dtype=real)
        advance = identity + law.dt * read_matrix(C, e, law.first + p)
        before = read_matrix(F, e, p)
        f = advance * before
        g = (law.scale * volume[e, law.first + p]) * adj_a  # the adjoint of tau
        adj_f = (
            read_matrix(adj_F_new, e, p)
            + law.mu * (g + wp.transpose(g)) * f
            + law.lam * wp.trace(g) * wp.transpose(wp.inverse(f))
        )
        write_matrix(adj_F, e, p, wp.transpose(advance) * adj_f)
        write_matrix(adj_C, e, law.first + p, mass[e, law.first + p] * adj_a + law.dt * adj_f * wp.transpose(before))

    return MaterialKernels(update, turn_back, affine_momentum)
