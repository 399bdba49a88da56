"""Contact by projection: rigid surfaces that take from vertices inside them the velocity into them.

A surface is a Warp function (its data, a position, its pose) -> unit normal and signed distance, negative inside. A
pose is (x [m], y [m], tilt about z [rad]).
"""

import math
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Protocol, no_type_check

import warp as wp

from ..runtime import fill_struct, precision


class Surface(Protocol):
    """What a solver asks of a surface."""

    def function(self, name: str) -> tuple[Any, Any]:
        """Return the Warp function of one precision, and the struct its data is in."""

    def data(self, name: str) -> Any:
        """Return the function's data."""


@dataclass(frozen=True)
class Floor:
    """The half-space below `height` [m], which does not move: its poses are zeros."""

    height: float = 0.0

    def function(self, name: str) -> tuple[Any, Any]:
        """Return the surface's Warp function and its struct."""
        distance, Data = _floor(name)
        return distance, Data

    def data(self, name: str) -> Any:
        """Return the function's data."""
        return fill_struct(self.function(name)[1](), self)


@dataclass(frozen=True)
class Pan:
    """A round pan: a flat bottom whose edge bends up smoothly, along an arc.

    `flat` is the radius of the bottom, `bend` that of the arc, `thickness` how deep below its surface the pan still is
    [m]; `sweep` is the arc's angle [rad], at most a right one. The pose is where the bottom's centre is.
    """

    flat: float
    bend: float
    sweep: float
    thickness: float

    @property
    def radius(self) -> float:
        """The rim's radius [m]."""
        return self.flat + self.bend * math.sin(self.sweep)

    def function(self, name: str) -> tuple[Any, Any]:
        """Return the surface's Warp function and its struct."""
        distance, Data = _pan(name)
        return distance, Data

    def data(self, name: str) -> Any:
        """Return the function's data."""
        return fill_struct(self.function(name)[1](), self)


@cache
@no_type_check
def _floor(name: str) -> tuple[Any, Any]:
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    module = f"gradscape.contact.{name}"

    @partial(wp.struct, module=module)
    class Level:
        """The fields of Floor."""

        height: real

    @wp.func(module=module, name=f"floor_{name}")
    def distance(floor: Level, p: vec3, pose: vec3) -> vec4:
        return vec4(real(0.0), real(1.0), real(0.0), p[1] - floor.height)

    return distance, Level


@cache
@no_type_check
def _pan(name: str) -> tuple[Any, Any]:
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    module = f"gradscape.contact.{name}"

    @partial(wp.struct, module=module)
    class Dish:
        """The fields of Pan."""

        flat: real
        bend: real
        sweep: real
        thickness: real

    @wp.func(module=module, name=f"edge_{name}")
    def edge(pan: Dish, out: real, height: real) -> vec3:
        """Return the normal (outwards, up) and the distance in a plane through the axis, `out` beyond the bottom."""
        up = pan.bend - height
        if wp.atan2(out, up) > pan.sweep:  # beside the rim there is nothing
            return vec3(real(0.0), real(1.0), pan.bend)
        reach = wp.sqrt(out * out + up * up)
        return vec3(-out / reach, up / reach, pan.bend - reach)

    @wp.func(module=module, name=f"pan_{name}")
    def distance(pan: Dish, p: vec3, pose: vec3) -> vec4:
        c, s = wp.cos(pose[2]), wp.sin(pose[2])
        dx, dy = p[0] - pose[0], p[1] - pose[1]
        x, y = c * dx + s * dy, c * dy - s * dx
        squared = x * x + p[2] * p[2]
        n = vec3(real(0.0), real(1.0), real(0.0))
        d = y
        if squared > pan.flat * pan.flat:
            r = wp.sqrt(squared)
            bent = edge(pan, r - pan.flat, y)
            n = vec3(bent[0] * x / r, bent[1], bent[0] * p[2] / r)
            d = bent[2]
        if d < -pan.thickness:  # what is under the pan has left it
            d = pan.thickness
        return vec4(c * n[0] - s * n[1], s * n[0] + c * n[1], n[2], d)

    return distance, Dish


@cache
@no_type_check
def contact_kernel(name: str, distance: Any, Data: Any) -> Any:
    """Return the kernel that takes the velocity into a surface from vertices inside it, and moves all vertices.

    Within a step the surface moves steadily from one pose to the next. `held` vertices stay where they are.
    """
    types = precision(name)
    real, vec3 = types.real, types.vec3
    module = f"gradscape.contact.{distance.key}"

    @wp.func(module=module)
    def material(p: vec3, pose: vec3, change: vec3, rate: real) -> vec3:
        """Return the velocity of the surface's material at a position."""
        spin = rate * change[2]
        return vec3(rate * change[0] - spin * (p[1] - pose[1]), rate * change[1] + spin * (p[0] - pose[0]), real(0.0))

    @wp.kernel(module=module)
    def touch(
        step: int,
        dt: real,
        data: Data,
        held: wp.array[bool],
        poses: wp.array2d[vec3],
        x: wp.array2d[vec3],
        pulled: wp.array2d[vec3],
        x_next: wp.array2d[vec3],
        v_next: wp.array2d[vec3],
    ):
        row, i = wp.tid()
        p, pose = x[row, i], poses[step, row]
        v = pulled[row, i] + vec3()  # a value: what is read from an array is a reference, which cannot be assigned to
        hit = distance(data, p, pose)
        if hit[3] < real(0.0):
            n = vec3(hit[0], hit[1], hit[2])
            body = material(p, pose, poses[step + 1, row] - pose, real(1.0) / dt)
            v = v - wp.min(wp.dot(v - body, n), real(0.0)) * n
        if held[i]:
            v = vec3(real(0.0), real(0.0), real(0.0))
        v_next[row, i] = v
        x_next[row, i] = p + dt * v

    return touch
