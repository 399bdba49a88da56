"""What grid velocities meet: moving tools and walls.

A boundary is a Warp function (its data, node position, velocity, environment, lane, tools, sums, control step, fraction
of it, 1 over its span) -> velocity. `tools` [environment, control step, slot] holds positions [m] at the ends of
control steps; in between a tool moves at constant velocity. A node looks whether a tool is near without an adjoint, and
reads where it is with one that is summed exactly (`exact`), in the `sums` of its `lane`. Sizes and frictions are data,
so that scenes with the same kind of boundary share its compiled kernel.
"""

from dataclasses import dataclass
from functools import cache, partial
from typing import Any, ClassVar, Protocol, no_type_check

import warp as wp

from ..runtime import fill_struct, precision
from .exact import tool_readers
from .sdf import bowl, rod


class Boundary(Protocol):
    """What a solver asks of a boundary; `walls` are what the headers call them."""

    walls: ClassVar[str]

    @property
    def slots(self) -> int:
        """Number of vectors per environment and control step in `tools`."""

    def function(self, name: str) -> tuple[Any, Any]:
        """Return the Warp function of one precision, and the struct its data is in."""

    def data(self, name: str, device: str) -> Any:
        """Return the function's data."""


@dataclass(frozen=True)
class Open:
    """No boundary at all."""

    slots: ClassVar[int] = 1
    walls: ClassVar[str] = "OpenWalls"

    def function(self, name: str) -> tuple[Any, Any]:
        """Return the boundary's Warp function and its struct."""
        boundary, Data = _open(name)
        return boundary, Data

    def data(self, name: str, device: str) -> Any:
        """Return the function's data."""
        return self.function(name)[1]()


@dataclass(frozen=True)
class LadleInTank:
    """A square tank, centred on x = z = 0, with its floor at y = 0, and a ladle that moves in it.

    Lengths in m: half the tank's width, the height of a `lid` that stops what flies highest, the bowl's mid-surface
    `radius`, `half_thickness` of its shell, the handle's `height` (0: there is none), and the `band` over which the
    ladle's grip fades to nothing outside its surface. `friction` is Coulomb's; `slip` is what floor and walls leave of
    the velocity along them, from 1 (they slip) to 0 (they stick).
    """

    half_width: float
    lid: float
    radius: float
    half_thickness: float
    height: float
    band: float
    friction: float
    slip: float = 1.0
    slots: ClassVar[int] = 1
    walls: ClassVar[str] = "TankWalls"

    def function(self, name: str) -> tuple[Any, Any]:
        """Return the boundary's Warp function and its struct."""
        boundary, Data = _ladle_in_tank(name)
        return boundary, Data

    def data(self, name: str, device: str) -> Any:
        """Return the function's data."""
        return fill_struct(self.function(name)[1](), self)


@cache
@no_type_check
def _open(name: str) -> tuple[Any, Any]:
    types = precision(name)
    real, vec3 = types.real, types.vec3
    module = f"gradscape.boundaries.{name}"

    @partial(wp.struct, module=module)
    class Nothing:
        unused: int

    @wp.func(module=module, name=f"open_{name}")
    def boundary(
        data: Nothing,
        p: vec3,
        v: vec3,
        e: int,
        lane: int,
        tools: wp.array3d[vec3],
        sums: wp.array2d[wp.int64],
        step: int,
        fraction: real,
        rate: real,
    ) -> vec3:
        return v

    return boundary, Nothing


@cache
@no_type_check
def _ladle_in_tank(name: str) -> tuple[Any, Any]:
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    module = f"gradscape.boundaries.{name}"
    bowl_distance, rod_distance = bowl(name), rod(name)
    read, look = tool_readers(name).read, tool_readers(name).look

    @partial(wp.struct, module=module)
    class Scene:
        """The fields of LadleInTank."""

        half_width: real
        lid: real
        radius: real
        half_thickness: real
        height: real
        band: real
        friction: real
        slip: real

    @wp.func(module=module)
    def look_between(tools: wp.array3d[vec3], e: int, step: int, fraction: real) -> vec3:
        """Return where the ladle is, without an adjoint."""
        start = look(tools, e, step, 0, 0)
        return start + fraction * (look(tools, e, step, 1, 0) - start)

    @wp.func(module=module)
    def between(
        tools: wp.array3d[vec3], sums: wp.array2d[wp.int64], e: int, lane: int, step: int, fraction: real
    ) -> vec3:
        """Return where the ladle is."""
        start = read(tools, sums, e, lane, step, 0, 0)
        return start + fraction * (read(tools, sums, e, lane, step, 1, 0) - start)

    @wp.func(module=module)
    def velocity(tools: wp.array3d[vec3], sums: wp.array2d[wp.int64], e: int, lane: int, step: int, rate: real) -> vec3:
        """Return how the ladle moves."""
        return rate * (read(tools, sums, e, lane, step, 1, 0) - read(tools, sums, e, lane, step, 0, 0))

    @wp.func(module=module)
    def slide(v: vec3, body: vec3, hit: vec4, band: real, friction: real) -> vec3:
        """Take from the velocity what goes into the body, less with distance; rub the rest (Coulomb)."""
        n = vec3(hit[0], hit[1], hit[2])
        u = v - body
        normal = wp.dot(u, n)
        if normal >= real(0.0) or hit[3] >= band:
            return v
        s = wp.clamp(real(1.0) - hit[3] / band, real(0.0), real(1.0))
        grip = s * s * (real(3.0) - real(2.0) * s)
        tangent = u - normal * n
        speed = wp.sqrt(wp.dot(tangent, tangent) + real(1e-10))
        tangent = tangent * wp.max(real(0.0), real(1.0) + friction * normal / speed)
        return body + (real(1.0) - grip) * u + grip * tangent

    @wp.func(module=module)
    def along_wall(p: vec3, v: vec3, edge: real, slip: real) -> vec3:
        """Return what floor and walls leave of a velocity along them; that towards them is not theirs to change."""
        across = wp.where(wp.abs(p[0]) > edge, real(1.0), slip)
        upwards = wp.where(p[1] < real(1e-6), real(1.0), slip)
        deep = wp.where(wp.abs(p[2]) > edge, real(1.0), slip)
        return vec3(across * v[0], upwards * v[1], deep * v[2])

    @wp.func(module=module)
    def boundary(
        scene: Scene,
        p: vec3,
        v: vec3,
        e: int,
        lane: int,
        tools: wp.array3d[vec3],
        sums: wp.array2d[wp.int64],
        step: int,
        fraction: real,
        rate: real,
    ) -> vec3:
        beside = scene.half_thickness + scene.band
        rounded = real(1.001) * beside
        outer, inner = scene.radius + rounded, wp.max(scene.radius - rounded, real(0.0))
        local = p - look_between(tools, e, step, fraction)
        apart = wp.dot(local, local)
        if apart < outer * outer and apart >= inner * inner:  # elsewhere the bowl is too far off to change anything
            hit = bowl_distance(p - between(tools, sums, e, lane, step, fraction), scene.radius, scene.half_thickness)
            v = slide(v, velocity(tools, sums, e, lane, step, rate), hit, scene.band, scene.friction)
        handle = scene.height > real(0.0)
        if handle and wp.abs(local[2]) < beside and wp.abs(local[0] + scene.radius) < beside:
            foot = p - between(tools, sums, e, lane, step, fraction) + vec3(scene.radius, real(0.0), real(0.0))
            hit = rod_distance(foot, scene.height, scene.half_thickness)
            v = slide(v, velocity(tools, sums, e, lane, step, rate), hit, scene.band, scene.friction)
        edge = scene.half_width - real(1e-6)  # a wall's own nodes belong to it
        if wp.abs(p[0]) > edge or wp.abs(p[2]) > edge or p[1] < real(1e-6):
            v = along_wall(p, v, edge, scene.slip)
        vx, vy, vz = v[0], v[1], v[2]
        if p[0] < -edge:
            vx = wp.max(vx, real(0.0))
        if p[0] > edge:
            vx = wp.min(vx, real(0.0))
        if p[1] < real(1e-6):
            vy = wp.max(vy, real(0.0))
        if p[1] > scene.lid:
            vy = wp.min(vy, real(0.0))
        if p[2] < -edge:
            vz = wp.max(vz, real(0.0))
        if p[2] > edge:
            vz = wp.min(vz, real(0.0))
        return vec3(vx, vy, vz)

    return boundary, Scene
