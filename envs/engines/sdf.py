"""Signed distances of tools and walls, with their normals, as Warp functions.

A shape's function takes a point [m] in the shape's own frame and returns (outward unit normal, distance [m]) as a
4-vector; the distance is negative inside.
"""

from functools import cache
from typing import Any, no_type_check

import warp as wp

from .runtime import precision

TINY = 1e-12  # added under square roots [m^2], so that an axis or a centre has a gradient


@cache
@no_type_check
def bowl(name: str) -> Any:
    """Return the distance to an open half-sphere shell, its rim in the plane y = 0, its opening upwards."""
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4

    @wp.func(module=f"gradscape.sdf.{name}", name=f"bowl_{name}")
    def distance(p: vec3, radius: real, half_thickness: real) -> vec4:
        if p[1] < real(0.0):
            length = wp.sqrt(wp.dot(p, p) + real(TINY))
            gap = length - radius
            side = wp.where(gap < real(0.0), real(-1.0), real(1.0)) / length
            return vec4(side * p[0], side * p[1], side * p[2], wp.abs(gap) - half_thickness)
        axial = wp.sqrt(p[0] * p[0] + p[2] * p[2] + real(TINY))
        gap = axial - radius
        length = wp.sqrt(gap * gap + p[1] * p[1] + real(TINY))
        outward = gap / (length * axial)
        return vec4(outward * p[0], p[1] / length, outward * p[2], length - half_thickness)

    return distance


@cache
@no_type_check
def rod(name: str) -> Any:
    """Return the distance to an upright capsule that stands on the origin."""
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4

    @wp.func(module=f"gradscape.sdf.{name}", name=f"rod_{name}")
    def distance(p: vec3, height: real, radius: real) -> vec4:
        y = p[1] - wp.clamp(p[1], real(0.0), height)
        length = wp.sqrt(p[0] * p[0] + y * y + p[2] * p[2] + real(TINY))
        return vec4(p[0] / length, y / length, p[2] / length, length - radius)

    return distance
