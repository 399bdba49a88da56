"""Kernels of `plasticine` in float32 for a GPU: by series in its strain, without a decomposition where that is small.

With J = det F, s = J^(1/3) and exp(d) the stretch that changes shape alone, so that F F^T = s^2 exp(2 d),

    d = atanh(z),  z = X (X + 2)^-1,  X = F F^T / s^2 - 1,  |d| = sqrt(d:d + 1e-8),  c = min(1, kappa / |d|),
    F' = exp((c - 1) d) F,  tau = 2 mu (W^2 - W) + lam J (J - 1),  W = s exp(c d).

As d has no trace, d^3 = q d + r with q = d:d / 2 and r = det d. So exp(t d) is a sum of 1, d and d^2, whose factors are
series in q and r. The differential of d is that of a logarithm,

    dd = 1/2 (ad / sinh ad)[exp(-d) d(F F^T / s^2) exp(-d)],  ad[Y] = d Y - Y d,
    x / sinh x = 1 - x^2 / 6 + 7 x^4 / 360 - ...

(Higham 2008, Functions of matrices, chapters 10 and 11.) Nothing here is divided by differences of singular values.
Plasticine that yields is never far from its yield surface, where strains are 0.05 at most. Where X is larger than NEAR,
or F almost flat, the kernels decompose F as `plasticine` does.
"""

from functools import cache, partial
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ... import cpp
from ...runtime import precision
from .adjoints import MaterialKernels
from .plasticine import ROUNDED, SMALLEST, kernels_of, responses

NEAR = 0.2  # Frobenius norm of X up to which series are as exact as float32 is


@cache
def kernels(name: str) -> MaterialKernels:
    """Return the kernels."""
    found: MaterialKernels = kernels_of(name, series(name), cpp.module(f"gradscape.plasticine.series.{name}"))
    return found


@cache
@no_type_check
def series(name: str) -> SimpleNamespace:
    """Return the functions `strain, respond, turn_back` of one precision, as `plasticine.responses` does."""
    types, decomposed = precision(name), responses(name)
    real, vec3, mat33 = types.real, types.vec3, types.mat33
    decompose, respond_far, turn_back_far = decomposed.strain, decomposed.respond, decomposed.turn_back
    module = f"gradscape.plasticine.series.{name}"

    @partial(wp.struct, module=module)
    class Strain:
        """What changes a trial's shape, d, and its size, s, and whether series are exact."""

        d: mat33
        s: real
        near: bool

    @wp.func(module=module)
    def symmetric(xx: real, yy: real, zz: real, xy: real, xz: real, yz: real) -> mat33:
        return mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)

    @wp.func(module=module)
    def unit(a: real) -> mat33:
        """Return a times the unit matrix."""
        return symmetric(a, a, a, real(0.0), real(0.0), real(0.0))

    @wp.func(module=module)
    def dot(a: mat33, b: mat33, i: int, j: int) -> real:
        """Return the product of row i of a and row j of b."""
        return a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]

    @wp.func(module=module)
    def mixed(a: mat33, b: mat33) -> mat33:
        """Return a b^T where that is symmetric."""
        return symmetric(
            dot(a, b, 0, 0), dot(a, b, 1, 1), dot(a, b, 2, 2), dot(a, b, 0, 1), dot(a, b, 0, 2), dot(a, b, 1, 2)
        )

    @wp.func(module=module)
    def even(a: mat33) -> mat33:
        """Return a + a^T."""
        return symmetric(
            a[0, 0] + a[0, 0],
            a[1, 1] + a[1, 1],
            a[2, 2] + a[2, 2],
            a[0, 1] + a[1, 0],
            a[0, 2] + a[2, 0],
            a[1, 2] + a[2, 1],
        )

    @wp.func(module=module)
    def inverse(a: mat33) -> mat33:
        """Return the inverse of a symmetric matrix."""
        xx, yy, zz = (
            a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2],
            a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2],
            a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1],
        )
        xy, xz, yz = (
            a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2],
            a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1],
            a[0, 1] * a[0, 2] - a[1, 2] * a[0, 0],
        )
        factor = real(1.0) / (a[0, 0] * xx + a[0, 1] * xy + a[0, 2] * xz)
        return factor * symmetric(xx, yy, zz, xy, xz, yz)

    @wp.func(module=module)
    def strain(F: mat33):
        found = Strain()
        J = wp.determinant(F)
        s = wp.cbrt(J)
        X = (real(1.0) / (s * s)) * mixed(F, F) - unit(real(1.0))
        found.s = s
        found.near = s > real(2.0 * SMALLEST) and wp.ddot(X, X) < real(NEAR * NEAR)
        z = mixed(X, inverse(X + unit(real(2.0))))
        w = mixed(z, z)
        rest = unit(real(1.0 / 3.0)) + mixed(w, unit(real(0.2)) + real(1.0 / 7.0) * w)
        found.d = z + mixed(z, mixed(w, rest))
        return found

    @wp.func(module=module)
    def exponential(t: real, q: real, r: real) -> vec3:
        """Return the factors of 1, d, d^2 in exp(t d)."""
        t2 = t * t
        u, v = t2 * q, t2 * t * r
        a0 = real(1.0) + v * (real(1.0 / 6.0) + u * real(1.0 / 120.0))
        a1 = real(1.0) + u * (real(1.0 / 6.0) + u * real(1.0 / 120.0)) + v * real(1.0 / 24.0)
        a2 = real(0.5) + u * (real(1.0 / 24.0) + u * real(1.0 / 720.0)) + v * real(1.0 / 120.0)
        return vec3(a0, t * a1, t2 * a2)

    @wp.func(module=module)
    def over_q(t: real, q: real, r: real, at: vec3) -> real:
        """Return the derivative over q of exp(t d), whose factors are given the adjoints `at`."""
        t2 = t * t
        u, v = t2 * q, t2 * t * r
        slopes = v * real(1.0 / 120.0) * at[0] + t * (real(1.0 / 6.0) + u * real(1.0 / 60.0)) * at[1]
        return t2 * (slopes + t2 * (real(1.0 / 24.0) + u * real(1.0 / 360.0)) * at[2])

    @wp.func(module=module)
    def over_r(t: real, q: real, at: vec3) -> real:
        """Return the derivative over r."""
        t2 = t * t
        slopes = (real(1.0 / 6.0) + t2 * q * real(1.0 / 120.0)) * at[0]
        return t * t2 * (slopes + t * real(1.0 / 24.0) * at[1] + t2 * real(1.0 / 120.0) * at[2])

    @wp.func(module=module)
    def over_t(factors: vec3, q: real, r: real, at: vec3) -> real:
        """Return the derivative over t: exp(t d) d."""
        return factors[0] * at[1] + factors[1] * at[2] + factors[2] * (q * at[1] + r * at[0])

    @wp.func(module=module)
    def fill(factors: vec3, d: mat33, d2: mat33) -> mat33:
        return unit(factors[0]) + factors[1] * d + factors[2] * d2

    @wp.func(module=module)
    def yielded(q: real, kappa: real):
        """Return (1 / |d|, c)."""
        short = real(1.0) / wp.sqrt(q + q + real(ROUNDED))
        return short, wp.min(real(1.0), kappa * short)

    @wp.func(module=module)
    def respond(trial: mat33, strain: Strain, mu: real, lam: real, kappa: real):
        d, s = strain.d, strain.s
        if not strain.near:
            return respond_far(trial, decompose(trial), mu, lam, kappa)
        d2 = mixed(d, d)
        q, r = real(0.5) * wp.trace(d2), wp.determinant(d)
        _, c = yielded(q, kappa)
        J = s * s * s
        factors = real(2.0) * mu * s * (s * exponential(c + c, q, r) - exponential(c, q, r))
        stress = fill(factors, d, d2) + unit(lam * J * (J - real(1.0)))
        return fill(exponential(c - real(1.0), q, r), d, d2) * trial, stress

    @wp.func(module=module)
    def twice(d: mat33, Y: mat33) -> mat33:
        """Return ad ad Y. ad Y has the three entries k above its diagonal, and their opposites below it."""
        x, y, z = d[1, 1] - d[2, 2], d[0, 0] - d[2, 2], d[0, 0] - d[1, 1]
        k01 = z * Y[0, 1] - d[0, 1] * (Y[0, 0] - Y[1, 1]) + d[0, 2] * Y[1, 2] - d[1, 2] * Y[0, 2]
        k02 = y * Y[0, 2] - d[0, 2] * (Y[0, 0] - Y[2, 2]) + d[0, 1] * Y[1, 2] - d[1, 2] * Y[0, 1]
        k12 = x * Y[1, 2] - d[1, 2] * (Y[1, 1] - Y[2, 2]) + d[0, 1] * Y[0, 2] - d[0, 2] * Y[0, 1]
        xy, xz, yz = d[0, 1] * k01, d[0, 2] * k02, d[1, 2] * k12
        return symmetric(
            real(-2.0) * (xy + xz),
            real(2.0) * (xy - yz),
            real(2.0) * (xz + yz),
            z * k01 - d[0, 2] * k12 - d[1, 2] * k02,
            y * k02 + d[0, 1] * k12 - d[1, 2] * k01,
            x * k12 + d[0, 1] * k02 + d[0, 2] * k01,
        )

    @wp.func(module=module)
    def turn_back(
        trial: mat33, strain: Strain, mu: real, lam: real, kappa: real, adj_F_new: mat33, weight: real, adj_a: mat33
    ) -> mat33:
        d, s = strain.d, strain.s
        if not strain.near:
            return turn_back_far(trial, decompose(trial), mu, lam, kappa, adj_F_new, weight, adj_a)
        d2 = mixed(d, d)
        q, r = real(0.5) * wp.trace(d2), wp.determinant(d)
        short, c = yielded(q, kappa)
        J, shear = s * s * s, real(2.0) * mu * s
        T = (real(0.5) * weight) * even(adj_a)
        G = real(0.5) * even(adj_F_new * wp.transpose(trial))  # the adjoint of exp((c - 1) d)
        at_T = vec3(wp.trace(T), wp.ddot(T, d), wp.ddot(T, d2))
        at_G = vec3(wp.trace(G), wp.ddot(G, d), wp.ddot(G, d2))
        W, W2, M = exponential(c, q, r), exponential(c + c, q, r), exponential(c - real(1.0), q, r)
        factors = shear * (s * W2 - W)
        adj_q = shear * (s * over_q(c + c, q, r, at_T) - over_q(c, q, r, at_T)) + over_q(c - real(1.0), q, r, at_G)
        adj_r = shear * (s * over_r(c + c, q, at_T) - over_r(c, q, at_T)) + over_r(c - real(1.0), q, at_G)
        if c < real(1.0):
            adj_c = shear * (real(2.0) * s * over_t(W2, q, r, at_T) - over_t(W, q, r, at_T)) + over_t(M, q, r, at_G)
            adj_q -= adj_c * c * short * short
        adj_d = factors[1] * T + M[1] * G + adj_q * d + adj_r * (d2 - unit(q))
        adj_d += even(d * (factors[2] * T + M[2] * G))
        adj_d -= unit(wp.trace(adj_d) * real(1.0 / 3.0))
        adj_d -= real(1.0 / 6.0) * twice(d, adj_d - real(7.0 / 60.0) * twice(d, adj_d))
        volume = lam * (J + J - real(1.0)) * J * at_T[0]  # the adjoint of log J
        volume += shear * (real(2.0) * s * wp.dot(at_T, W2) - wp.dot(at_T, W)) * real(1.0 / 3.0)
        N = fill(exponential(real(-1.0), q, r), d, d2)
        shape = real(1.0) / (s * s) * mixed(N * (adj_d + unit(volume)), N)
        return fill(M, d, d2) * adj_F_new + shape * trial

    return SimpleNamespace(strain=strain, Strain=Strain, respond=respond, turn_back=turn_back)
