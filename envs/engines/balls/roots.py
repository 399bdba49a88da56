"""When a point on a parabola enters what a ball may meet: a half-plane in closed form, a disc by safe steps."""

from functools import cache
from typing import Any, NamedTuple, no_type_check

import warp as wp

from ..runtime import precision

NEVER = wp.constant(-1.0)
BEYOND = wp.constant(1e-3)  # below a plane by more than this [m], a point is on its other side, not touching
STEPS = wp.constant(200)  # towards a disc; ten are taken where the parabola does not graze it
ROUND = {"float32": 2e-5, "float64": 1e-12}  # squared distances, by that of touching, that rounding cannot tell from 0


class Roots(NamedTuple):
    """Warp functions that return a time, or NEVER."""

    plane: Any
    disc: Any


@cache
@no_type_check
def roots(name: str) -> Roots:
    """Return the functions of one precision."""
    types = precision(name)
    real, module = types.real, f"gradscape.roots.{name}"
    vec2 = wp.types.vector(2, real)
    touching, straight = ROUND[name], -1e3 * ROUND[name]

    @wp.func(module=module)
    def plane(h: real, u: real, a: real, least: real) -> real:
        """Return when h + u t + a t^2 / 2 falls below 0, faster than `least`."""
        square = u * u - real(2.0) * a * h
        if a >= real(0.0) and (u >= real(0.0) or square <= least * least):
            return real(NEVER)
        if h < real(-BEYOND) and (u <= real(0.0) or square <= least * least):
            return real(NEVER)
        root = wp.sqrt(wp.max(square, real(0.0)))
        if u < real(0.0):
            return real(2.0) * wp.max(h, real(0.0)) / (root - u)
        return (u + root) / -a

    @wp.func(module=module)
    def again(m: vec2, v: vec2, a: vec2) -> real:
        """Return when a parabola that leaves a circle along its tangent is back: f / t^2 is quadratic."""
        c2 = wp.dot(v, v) + wp.dot(m, a)
        c3 = wp.dot(v, a)
        c4 = real(0.25) * wp.dot(a, a)
        if c2 < real(straight) * wp.dot(v, v):
            return real(0.0)
        square = c3 * c3 - real(4.0) * c2 * c4
        if c3 >= real(0.0) or square <= real(0.0):
            return real(NEVER)
        return real(2.0) * c2 / (wp.sqrt(square) - c3)

    @wp.func(module=module)
    def disc(m: vec2, v: vec2, a: vec2, reach: real, soonest: real, least: real) -> real:
        """Return when, before `soonest`, |m + v t + a t^2 / 2| falls below `reach`, faster than `least`.

        f = d.d - reach^2 is nowhere below its tangent less bend t^2 / 2, where `bend` bounds -f'': a step to the root
        of that never passes the first root of f, and ends like Newton's.
        """
        small = real(touching) * reach * reach
        far = wp.length(m) + soonest * (wp.length(v) + soonest * wp.length(a))
        bend = real(2.0) * far * wp.length(a) + small
        graze = real(2.0) * reach * least
        t = real(0.0)
        if wp.dot(m, m) - reach * reach < small and wp.abs(wp.dot(m, v)) <= least * reach:
            return again(m, v, a)
        for _ in range(STEPS):
            d = m + t * v + (real(0.5) * t * t) * a
            f = wp.dot(d, d) - reach * reach
            slope = real(2.0) * wp.dot(d, v + t * a)
            if f <= small and slope < graze:
                u = v + t * a
                falls = wp.dot(u, u) + wp.dot(d, a) < real(straight) * wp.dot(u, u)
                if slope < -graze or falls:
                    return t
                if slope < real(0.0):
                    return real(NEVER)
            root = wp.sqrt(slope * slope + real(2.0) * bend * wp.max(f, real(0.0)))
            ahead = (slope + root) / bend
            if slope < real(0.0):
                ahead = real(2.0) * f / (root - slope)
            if slope < -graze and t + ahead == t:  # as near as numbers come
                return t
            t += ahead
            if t >= soonest:
                return real(NEVER)
        return real(NEVER)

    return Roots(plane, disc)
