"""Kernels of a fixed-corotated solid with von Mises plasticity, which carries its elastic deformation gradient F.

The trial deformation (I + dt C) F = U diag(s) V^T returns to the yield surface in log strain e = log s:

    d = e - mean(e),  |d| = sqrt(d.d + 1e-8),  e' = e where |d| <= kappa, else mean(e) + kappa d / |d|,
    f = exp(e'),  F' = U diag(f) V^T,  tau = U diag(2 mu f (f - 1) + lam J (J - 1)) U^T,  J = f_0 f_1 f_2.

F' and tau are isotropic functions of the trial: with P = U^T dF V, the entries i, j and j, i of their differentials
depend on those of P only, through the divided differences of f over s. None of these is singular where singular values
are equal, as they are in every undeformed body. (The differential of the SVD itself is, which is why simulators that
clamp its 1/(s_i^2 - s_j^2) get the gradient of undeformed and of symmetrically yielding bodies wrong.)
"""

from functools import cache, partial
from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from ... import cpp
from ...runtime import precision
from ..layout import layout
from .adjoints import MaterialKernels
from .decomposition import ROUND_OFF, SWEEPS, TINY, svd

SMALLEST = 0.05  # singular values below count as this; what is pressed flatter has lost its shape
ROUNDED = 1e-8  # added to |d|^2, so that an undeformed body has a gradient


@cache
@no_type_check
def responses(name: str) -> SimpleNamespace:
    """Return the functions `strain, respond, turn_back` of one precision.

    `strain` says of a trial deformation gradient what the others take of it besides. `respond` takes the trial, its
    strain, mu, lam and kappa, and returns F' and tau. `turn_back` takes them, the adjoint of F', and a weight and a
    matrix whose product is the adjoint of tau; it returns the trial's.
    """
    types = precision(name)
    real, vec3, mat33 = types.real, types.vec3, types.mat33
    module = f"gradscape.plasticine.{name}"
    decompose = svd(name)
    one = wp.constant(vec3(1.0, 1.0, 1.0))
    tiny = wp.constant(real(1e-12))

    @partial(wp.struct, module=module)
    class Decomposed:
        """A trial U diag(s) V^T."""

        U: mat33
        s: vec3
        V: mat33

    @wp.func(module=module)
    def strain(trial: mat33):
        found = Decomposed()
        U, s, V = decompose(trial)
        found.U = U
        found.s = s
        found.V = V
        return found

    @wp.func(module=module)
    def log_strain(s: vec3) -> vec3:
        least = real(SMALLEST)
        return vec3(wp.log(wp.max(s[0], least)), wp.log(wp.max(s[1], least)), wp.log(wp.max(s[2], least)))

    @wp.func(module=module)
    def mean(e: vec3) -> vec3:
        third = (e[0] + e[1] + e[2]) / real(3.0)
        return vec3(third, third, third)

    @wp.func(module=module)
    def size(d: vec3) -> real:
        return wp.sqrt(wp.dot(d, d) + real(ROUNDED))

    @wp.func(module=module)
    def map_to_yield(s: vec3, kappa: real) -> vec3:
        """Return f, the singular values after the return map."""
        e = log_strain(s)
        d = e - mean(e)
        n = size(d)
        if n <= kappa:
            return s
        k = mean(e) + (kappa / n) * d
        return vec3(wp.exp(k[0]), wp.exp(k[1]), wp.exp(k[2]))

    @wp.func(module=module)
    def shrink(a: real, b: real) -> real:
        """Return the divided difference (e^a - e^b) / (a - b)."""
        h = real(0.5) * (a - b)
        ratio = real(1.0) + h * h / real(6.0) * (real(1.0) + h * h / real(20.0))
        if wp.abs(h) > real(0.1):
            ratio = wp.sinh(h) / h
        return wp.exp(real(0.5) * (a + b)) * ratio

    @wp.func(module=module)
    def slope(si: real, sj: real, ei: real, ej: real) -> real:
        """Return the divided difference of log(max(s, SMALLEST)) over s."""
        least = real(SMALLEST)
        if si > least and sj > least:
            return real(1.0) / shrink(ei, ej)
        if si <= least and sj <= least:
            return real(0.0)
        return (ei - ej) / (si - sj)

    @wp.func(module=module)
    def steep(s: real) -> real:
        """Return the derivative of log(max(s, SMALLEST))."""
        return wp.where(s > real(SMALLEST), real(1.0) / s, real(0.0))

    @wp.func(module=module)
    def pair(G: mat33, T: mat33, a: real, mu: real, f: vec3, s: vec3, i: int, j: int):
        """Return the adjoints of P_ij and P_ji from those of U^T F' V and U^T tau U."""
        total = wp.max(s[i] + s[j], tiny)
        b = (f[i] + f[j]) / total
        bend = real(2.0) * mu * (f[i] + f[j] - real(1.0)) * a * (T[i, j] + T[j, i]) / total
        even, odd = real(0.5) * (a + b), real(0.5) * (a - b)
        return even * G[i, j] + odd * G[j, i] + bend * s[j], even * G[j, i] + odd * G[i, j] + bend * s[i]

    @wp.func(module=module)
    def respond(trial: mat33, strain: Decomposed, mu: real, lam: real, kappa: real):
        U, s, V = strain.U, strain.s, strain.V
        f = map_to_yield(s, kappa)
        J = f[0] * f[1] * f[2]
        t = real(2.0) * mu * wp.cw_mul(f, f - one) + lam * J * (J - real(1.0)) * one
        return U * wp.diag(f) * wp.transpose(V), U * wp.diag(t) * wp.transpose(U)

    @wp.func(module=module)
    def turn_back(
        trial: mat33,
        strain: Decomposed,
        mu: real,
        lam: real,
        kappa: real,
        adj_F_new: mat33,
        weight: real,
        adj_a: mat33,
    ) -> mat33:
        U, s, V = strain.U, strain.s, strain.V
        e = log_strain(s)
        d = e - mean(e)
        length = size(d)
        f = s
        a = one  # divided differences of f over s: 01, 02, 12
        c = real(1.0)
        if length > kappa:
            c = kappa / length
            k = mean(e) + c * d
            f = vec3(wp.exp(k[0]), wp.exp(k[1]), wp.exp(k[2]))
            a01 = c * shrink(k[0], k[1]) * slope(s[0], s[1], e[0], e[1])
            a02 = c * shrink(k[0], k[2]) * slope(s[0], s[2], e[0], e[2])
            a12 = c * shrink(k[1], k[2]) * slope(s[1], s[2], e[1], e[2])
            a = vec3(a01, a02, a12)
        J = f[0] * f[1] * f[2]
        G = wp.transpose(U) * adj_F_new * V
        T = weight * (wp.transpose(U) * adj_a * U)
        g = vec3(G[0, 0], G[1, 1], G[2, 2])  # the adjoint of f
        g += real(2.0) * mu * wp.cw_mul(vec3(T[0, 0], T[1, 1], T[2, 2]), f + f - one)
        g += lam * (J + J - real(1.0)) * wp.trace(T) * vec3(f[1] * f[2], f[0] * f[2], f[0] * f[1])
        if length > kappa:
            h = wp.cw_mul(g, f)  # the adjoint of log f, then of e
            h = mean(h) + c * (h - mean(h)) - (c * wp.dot(d, h) / (length * length)) * d
            g = vec3(h[0] * steep(s[0]), h[1] * steep(s[1]), h[2] * steep(s[2]))
        p01, p10 = pair(G, T, a[0], mu, f, s, 0, 1)
        p02, p20 = pair(G, T, a[1], mu, f, s, 0, 2)
        p12, p21 = pair(G, T, a[2], mu, f, s, 1, 2)
        P = mat33(g[0], p01, p02, p10, g[1], p12, p20, p21, g[2])
        return U * P * wp.transpose(V)

    return SimpleNamespace(strain=strain, Strain=Decomposed, respond=respond, turn_back=turn_back)


@cache
def kernels(name: str) -> MaterialKernels:
    """Return the kernels of a GPU."""
    found: MaterialKernels = kernels_of(name, responses(name), cpp.module(f"gradscape.plasticine.{name}"))
    return found


@no_type_check
def kernels_of(name: str, found: Any, module: str) -> MaterialKernels:
    """Return the kernels of a material of these `responses`."""
    types = precision(name)
    real, mat33 = types.real, types.mat33
    Strain, strain_of, respond, respond_back = found.Strain, found.strain, found.respond, found.turn_back
    read_matrix, write_matrix = layout(name).read_matrix, layout(name).write_matrix

    @wp.func(module=module)
    def strain(first: int, dt: real, F: wp.array2d[mat33], C: wp.array2d[mat33], n: int, p: int):
        return strain_of((wp.identity(n=3, dtype=real) + dt * read_matrix(C, n, first + p)) * read_matrix(F, n, p))

    @wp.func(module=module)
    def affine_momentum(
        first: int,
        dt: real,
        scale: real,
        mu: real,
        lam: real,
        kappa: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        strain: Strain,
        n: int,
        p: int,
    ) -> mat33:
        c = read_matrix(C, n, first + p)
        advance = wp.identity(n=3, dtype=real) + dt * c
        _, stress = respond(advance * read_matrix(F, n, p), strain, mu, lam, kappa)
        return scale * volume[n, first + p] * stress + mass[n, first + p] * c

    @wp.kernel(module=module, enable_backward=False)
    def update(
        first: int,
        dt: real,
        scale: real,
        mu: real,
        lam: real,
        kappa: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        F_new: wp.array2d[mat33],
        A: wp.array2d[mat33],
    ):
        e, p = wp.tid()
        c, before = read_matrix(C, e, first + p), read_matrix(F, e, p)
        trial = before + dt * c * before
        after, stress = respond(trial, strain_of(trial), mu, lam, kappa)
        write_matrix(F_new, e, p, after)
        write_matrix(A, e, first + p, scale * volume[e, first + p] * stress + mass[e, first + p] * c)

    @wp.func(module=module)
    def turn_back(
        first: int,
        dt: real,
        scale: real,
        mu: real,
        lam: real,
        kappa: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        strain: Strain,
        adj_F_new: wp.array2d[mat33],
        adj_a: mat33,
        adj_F: wp.array2d[mat33],
        adj_C: wp.array2d[mat33],
        n: int,
        p: int,
    ):
        advance = wp.identity(n=3, dtype=real) + dt * read_matrix(C, n, first + p)
        before = read_matrix(F, n, p)
        weight, adj_after = scale * volume[n, first + p], read_matrix(adj_F_new, n, p)
        adj_trial = respond_back(advance * before, strain, mu, lam, kappa, adj_after, weight, adj_a)
        write_matrix(adj_F, n, p, wp.transpose(advance) * adj_trial)
        adj_c = mass[n, first + p] * adj_a + dt * adj_trial * wp.transpose(before)
        write_matrix(adj_C, n, first + p, adj_c)

    return MaterialKernels(update, turn_back, affine_momentum, strain)


@cache
@no_type_check
def kernels_in_rows(name: str) -> tuple[Any, Any]:
    """Return (update, adjoint) of one precision for a CPU, in C++: eight particles at a time (`native/materials.h`)."""
    types = precision(name)
    real, mat33 = types.real, types.mat33
    module, constants = f"gradscape.plasticine.{name}.rows", [SMALLEST, ROUNDED, ROUND_OFF[name], TINY, SWEEPS]

    @cpp.kernel_in_rows(module, called="plasticine_update", constants=constants)
    def update(
        first: int,
        dt: real,
        scale: real,
        mu: real,
        lam: real,
        kappa: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        F_new: wp.array2d[mat33],
        A: wp.array2d[mat33],
    ): ...

    @cpp.kernel_in_rows(module, called="plasticine_adjoint", constants=constants)
    def adjoint(
        first: int,
        dt: real,
        scale: real,
        mu: real,
        lam: real,
        kappa: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        adj_F_new: wp.array2d[mat33],
        adj_A: wp.array2d[mat33],
        adj_F: wp.array2d[mat33],
        adj_C: wp.array2d[mat33],
    ): ...

    return update, adjoint
