"""Singular value decomposition of deformation gradients, as a Warp function."""

from functools import cache
from typing import Any, no_type_check

import warp as wp

from ...runtime import precision

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
    def beside(u: vec3) -> vec3:
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
        u1 = unit(u1 - wp.dot(u0, u1) * u0, round_off * wp.dot(u0, F * v0), beside(u0))
        u2 = wp.cross(u0, u1)
        s = vec3(wp.dot(u0, F * v0), wp.dot(u1, F * v1), wp.dot(u2, F * v2))
        return wp.matrix_from_cols(u0, u1, u2), s, wp.matrix_from_cols(v0, v1, v2)

    return decompose
