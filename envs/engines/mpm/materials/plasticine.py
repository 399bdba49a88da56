"""A fixed-corotated solid with von Mises plasticity, which carries its elastic deformation gradient F.

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
from .kernels import Response, law_struct

# ---- Singular value decomposition of deformation gradients, as a Warp function.

SWEEPS = 8  # at most; three or four reach round-off
ROUND_OFF = {"float32": 1e-7, "float64": 1e-16}
TINY = 1e-20  # keeps what has vanished from being divided by


@cache
@no_type_check
def svd(name: str) -> Any:
    """Return the function F -> (U, s, V), F = U diag(s) V^T with rotations U and V; the last of s has det F's sign.

    Jacobi rotations (Golub and Van Loan 2013, section 8.5) diagonalise F^T F, fewer the more diagonal it is: an
    undeformed body costs none. Gram and Schmidt make U a rotation however flat or thin F is. (Warp's svd3 costs more,
    and in float32 reconstructs a strain of 0.1 with an error of up to 1e-3.)
    """
    types = precision(name)
    real, vec3, mat33 = types.real, types.vec3, types.mat33
    module = f"gradscape.decomposition.{name}"
    round_off = wp.constant(real(ROUND_OFF[name]))

    @wp.func(module=module)
    def rotation(app: real, aqq: real, apq: real):
        """Return (c, s, t): cosine, sine and tangent of the rotation that annihilates a_pq."""
        twice, gap = real(2.0) * apq, aqq - app
        span = wp.abs(gap) + wp.sqrt(gap * gap + twice * twice)
        t = wp.where(gap < real(0.0), -twice, twice) / wp.max(span, real(TINY))
        c = real(1.0) / wp.sqrt(t * t + real(1.0))
        return c, t * c, t

    @wp.func(module=module)
    def column(a: mat33, k: int):
        return vec3(a[0, k], a[1, k], a[2, k])

    @wp.func(module=module)
    def unit(v: vec3, least: real, instead: vec3) -> vec3:
        length = wp.length(v)
        if length <= least:
            return instead
        return v / length

    @wp.func(module=module)
    def normal_to(u: vec3) -> vec3:
        """Return a unit vector at a right angle to u."""
        if wp.abs(u[0]) < real(0.6):
            return wp.normalize(wp.cross(u, vec3(real(1.0), real(0.0), real(0.0))))
        return wp.normalize(wp.cross(u, vec3(real(0.0), real(1.0), real(0.0))))

    @wp.func(module=module)
    def eigenvectors(a00: real, a11: real, a22: real, a01: real, a02: real, a12: real) -> mat33:
        v0 = vec3(real(1.0), real(0.0), real(0.0))
        v1 = vec3(real(0.0), real(1.0), real(0.0))
        v2 = vec3(real(0.0), real(0.0), real(1.0))
        bound = round_off * round_off * (a00 + a11 + a22) * (a00 + a11 + a22)
        sweep = int(0)  # noqa: UP018, RUF046 -- what a loop changes must be a variable to Warp
        while sweep < SWEEPS and a01 * a01 + a02 * a02 + a12 * a12 > bound:
            sweep += 1
            c, s, t = rotation(a00, a11, a01)
            a00 -= t * a01
            a11 += t * a01
            k = a02
            a02 = c * k - s * a12
            a12 = s * k + c * a12
            v = v0
            v0 = c * v - s * v1
            v1 = s * v + c * v1
            c, s, t = rotation(a00, a22, a02)  # a01 is 0 now
            a00 -= t * a02
            a22 += t * a02
            a01 = -s * a12
            a12 = c * a12
            v = v0
            v0 = c * v - s * v2
            v2 = s * v + c * v2
            c, s, t = rotation(a11, a22, a12)  # a02 is 0 now
            a11 -= t * a12
            a22 += t * a12
            a02 = s * a01
            a01 = c * a01
            a12 = real(0.0)
            v = v1
            v1 = c * v - s * v2
            v2 = s * v + c * v2
        return wp.matrix_from_cols(v0, v1, v2)

    @wp.func(module=module)
    def decompose(F: mat33):
        x, y, z = column(F, 0), column(F, 1), column(F, 2)
        V = eigenvectors(wp.dot(x, x), wp.dot(y, y), wp.dot(z, z), wp.dot(x, y), wp.dot(x, z), wp.dot(y, z))
        v0, v1, v2 = column(V, 0), column(V, 1), column(V, 2)
        s0, s1, s2 = wp.length(F * v0), wp.length(F * v1), wp.length(F * v2)
        if s0 < s1 and s0 < s2:  # the smallest goes last, its sign after the cross product's
            v = v0
            v0 = v1
            v1 = v2
            v2 = v
        elif s1 < s2:
            v = v1
            v1 = v0
            v0 = v2
            v2 = v
        if wp.length(F * v0) < wp.length(F * v1):
            v = v0
            v0 = v1
            v1 = -v
        u0 = unit(F * v0, real(TINY), vec3(real(1.0), real(0.0), real(0.0)))
        u1 = F * v1
        u1 = unit(u1 - wp.dot(u0, u1) * u0, round_off * wp.dot(u0, F * v0), normal_to(u0))
        u2 = wp.cross(u0, u1)
        s = vec3(wp.dot(u0, F * v0), wp.dot(u1, F * v1), wp.dot(u2, F * v2))
        return wp.matrix_from_cols(u0, u1, u2), s, wp.matrix_from_cols(v0, v1, v2)

    return decompose


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
        trial: mat33, strain: Decomposed, mu: real, lam: real, kappa: real, adj_F_new: mat33, weight: real, adj_a: mat33
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
def response(name: str) -> Response:
    """Return the functions of one precision, by decompositions."""
    found: Response = response_of(name, responses(name), cpp.module(f"gradscape.plasticine.{name}"))
    return found


@no_type_check
def response_of(name: str, found: Any, module: str) -> Response:
    """Return a material of these `responses` as functions of a particle."""
    real, mat33, Law = precision(name).real, precision(name).mat33, law_struct(name, "mu", "lam", "kappa")
    Strain, strain_of, respond_to, turn_trial_back = found.Strain, found.strain, found.respond, found.turn_back

    @wp.func(module=module)
    def advance(law: Law, C: mat33) -> mat33:
        return wp.identity(n=3, dtype=real) + law.dt * C

    @wp.func(module=module)
    def respond(law: Law, F: mat33, C: mat33):
        trial = F + law.dt * C * F
        return respond_to(trial, strain_of(trial), law.mu, law.lam, law.kappa)

    @wp.func(module=module)
    def strain(law: Law, F: mat33, C: mat33):
        return strain_of(advance(law, C) * F)

    @wp.func(module=module)
    def stress(law: Law, F: mat33, C: mat33, strain: Strain) -> mat33:
        _, tau = respond_to(advance(law, C) * F, strain, law.mu, law.lam, law.kappa)
        return tau

    @wp.func(module=module)
    def turn_back(
        law: Law, F: mat33, C: mat33, strain: Strain, adj_F_new: mat33, weight: real, adj_a: mat33, carried: mat33
    ):
        step = advance(law, C)
        adj_trial = turn_trial_back(step * F, strain, law.mu, law.lam, law.kappa, adj_F_new, weight, adj_a)
        return wp.transpose(step) * adj_trial, carried + law.dt * adj_trial * wp.transpose(F)

    return Response(module, Law, mat33, respond, turn_back, strain, stress, Strain)


def constants_of_rows(name: str) -> tuple[float, ...]:
    """Return what the kernels of a CPU take of the above."""
    return SMALLEST, ROUNDED, ROUND_OFF[name], TINY, SWEEPS


# ---- Plasticine in float32 on a GPU: by series in its strain, without a decomposition where that is small.
#
# With J = det F, s = J^(1/3) and exp(d) the stretch that changes shape alone, so that F F^T = s^2 exp(2 d),
#
#     d = atanh(z),  z = X (X + 2)^-1,  X = F F^T / s^2 - 1,  |d| = sqrt(d:d + 1e-8),  c = min(1, kappa / |d|),
#     F' = exp((c - 1) d) F,  tau = 2 mu (W^2 - W) + lam J (J - 1),  W = s exp(c d).
#
# As d has no trace, d^3 = q d + r with q = d:d / 2 and r = det d. So exp(t d) is a sum of 1, d and d^2, whose factors
# are series in q and r. The differential of d is that of a logarithm,
#
#     dd = 1/2 (ad / sinh ad)[exp(-d) d(F F^T / s^2) exp(-d)],  ad[Y] = d Y - Y d,
#     x / sinh x = 1 - x^2 / 6 + 7 x^4 / 360 - ...
#
# (Higham 2008, Functions of matrices, chapters 10 and 11.) Nothing here is divided by differences of singular values.
# Plasticine that yields is never far from its yield surface, where strains are 0.05 at most. Where X is larger than
# NEAR, or F almost flat, they decompose F as `responses` do.

NEAR = 0.2  # Frobenius norm of X up to which series are as exact as float32 is


@cache
def response_by_series(name: str) -> Response:
    """Return the functions of one precision, by series."""
    found: Response = response_of(name, series(name), cpp.module(f"gradscape.plasticine.series.{name}"))
    return found


@cache
@no_type_check
def series(name: str) -> SimpleNamespace:
    """Return the functions `strain, respond, turn_back` of one precision, as `responses` does."""
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
