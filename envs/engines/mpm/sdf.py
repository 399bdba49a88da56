"""Signed distances of tools and walls, with their normals, as Warp functions.

A shape's function takes a point [m] in the shape's own frame and returns (outward unit normal, distance [m]) as a
4-vector; the distance is negative inside.
"""

from functools import cache
from typing import Any, no_type_check

import warp as wp

from ..runtime import precision

TINY = 1e-12  # added under square roots [m^2], so that an axis or a centre has a gradient


@cache
@no_type_check
def bowl(name: str) -> Any:
    """Return the distance to an open half-sphere shell, its rim in the plane y = 0, its opening upwards."""
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    ring = torus(name)

    @wp.func(module=f"gradscape.sdf.{name}", name=f"bowl_{name}")
    def distance(p: vec3, radius: real, half_thickness: real) -> vec4:
        if p[1] < real(0.0):
            length = wp.sqrt(wp.dot(p, p) + real(TINY))
            gap = length - radius
            side = wp.where(gap < real(0.0), real(-1.0), real(1.0)) / length
            return vec4(side * p[0], side * p[1], side * p[2], wp.abs(gap) - half_thickness)
        return ring(p, radius, half_thickness)

    return distance


@cache
@no_type_check
def rod(name: str) -> Any:
    """Return the distance to an upright capsule that stands on the origin."""
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    ball = sphere(name)

    @wp.func(module=f"gradscape.sdf.{name}", name=f"rod_{name}")
    def distance(p: vec3, height: real, radius: real) -> vec4:
        return ball(vec3(p[0], p[1] - wp.clamp(p[1], real(0.0), height), p[2]), radius)

    return distance


@cache
@no_type_check
def sphere(name: str) -> Any:
    """Return the distance to a ball around the origin."""
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4

    @wp.func(module=f"gradscape.sdf.{name}", name=f"sphere_{name}")
    def distance(p: vec3, radius: real) -> vec4:
        length = wp.sqrt(wp.dot(p, p) + real(TINY))
        return vec4(p[0] / length, p[1] / length, p[2] / length, length - radius)

    return distance


@cache
@no_type_check
def capsule(name: str) -> Any:
    """Return the distance to a capsule whose middle is the origin, its axis a unit vector."""
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    ball = sphere(name)

    @wp.func(module=f"gradscape.sdf.{name}", name=f"capsule_{name}")
    def distance(p: vec3, axis: vec3, half_length: real, radius: real) -> vec4:
        along = wp.clamp(wp.dot(p, axis), -half_length, half_length)
        return ball(p - along * axis, radius)

    return distance


@cache
@no_type_check
def torus(name: str) -> Any:
    """Return the distance to a torus around the y axis: the radius of its ring, and of its tube."""
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4

    @wp.func(module=f"gradscape.sdf.{name}", name=f"torus_{name}")
    def distance(p: vec3, ring: real, tube: real) -> vec4:
        axial = wp.sqrt(p[0] * p[0] + p[2] * p[2] + real(TINY))
        gap = axial - ring
        length = wp.sqrt(gap * gap + p[1] * p[1] + real(TINY))
        outward = gap / (length * axial)
        return vec4(outward * p[0], p[1] / length, outward * p[2], length - tube)

    return distance


@cache
@no_type_check
def cylinder(name: str) -> Any:
    """Return the distance to a solid upright cylinder whose middle is the origin."""
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4

    @wp.func(module=f"gradscape.sdf.{name}", name=f"cylinder_{name}")
    def distance(p: vec3, radius: real, half_height: real) -> vec4:
        axial = wp.sqrt(p[0] * p[0] + p[2] * p[2] + real(TINY))
        side = wp.where(p[1] < real(0.0), real(-1.0), real(1.0))
        out = axial - radius
        over = wp.abs(p[1]) - half_height
        if out > real(0.0) and over > real(0.0):  # nearest to an edge
            length = wp.sqrt(out * out + over * over + real(TINY))
            outward = out / (length * axial)
            return vec4(outward * p[0], side * over / length, outward * p[2], length)
        if out > over:
            return vec4(p[0] / axial, real(0.0), p[2] / axial, out)
        return vec4(real(0.0), side, real(0.0), over)

    return distance
