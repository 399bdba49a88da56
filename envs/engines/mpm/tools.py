"""Rigid tools that push plasticine about on a floor.

Every tool is a signed distance. Grid velocities in its shell lose what goes into it and are rubbed (Coulomb), the less
the farther off they are. Tools are moved, never pushed back.

A tool's influence is a rate. PlasticineLab takes the share exp(-softness d) of what a node runs into it once per
substep, so that with ever shorter substeps all of its shell becomes as hard as its surface: the effective surface moves
out by ln(2)/softness (1 mm) whenever the step is halved, and losses grow with the logarithm of the number of steps.
Here the share k that one of its substeps takes (UPSTREAM_DT) is 1 - (1 - k)^(dt/UPSTREAM_DT) of ours: its law at its
step, and one that converges as the step goes to zero.

Nothing here jumps as a node moves or a velocity changes sign, where PlasticineLab does twice: its influence
exp(-softness d) ends at a tenth, ours falls to nothing there; its sticky floor lets what rises from it slide, ours lets
it rise only. Each such jump is small and in no gradient, but an episode has thousands: over steps of 1e-3 they put
slopes 2e-2 (assembly) and 3e-2 (rolling-pin) away from gradients, which is now 4e-5 and 5e-3.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from functools import cache, partial
from typing import Any, ClassVar, no_type_check

import numpy as np
import warp as wp

from ..runtime import precision
from .exact import tool_readers
from .sdf import capsule, cylinder, sphere, torus

FAINTEST = 0.1  # exp(-softness d) at which a tool's shell ends
UPSTREAM_DT = 1e-4  # the substep of PlasticineLab [s], for which its influence is meant
STICKY = 10.0  # floor friction from which nothing slides


class Kind(IntEnum):
    """Shapes of tools; `size` [m] in their order."""

    SPHERE = 0  # radius
    CAPSULE = 1  # upright: half the length of its axis, radius
    TORUS = 2  # around the y axis: radius of the ring, of the tube
    CYLINDER = 3  # upright: radius, half its height
    ROLLER = 4  # level capsule that rolls and turns: half the length of its axis, radius


@dataclass(frozen=True)
class Tool:
    """One tool: `size` [m] as its kind says, Coulomb friction. A roller takes two slots: position, (spin, yaw, 0)."""

    kind: Kind
    size: tuple[float, ...]
    friction: float

    @property
    def radius(self) -> float:
        """Radius of a ball around the tool's middle that holds it [m]."""
        return math.hypot(*self.size) if self.kind is Kind.CYLINDER else sum(self.size)

    @property
    def slots(self) -> int:
        """Number of vectors that say where the tool is."""
        return 2 if self.kind is Kind.ROLLER else 1


@dataclass(frozen=True)
class ToolsInRoom:
    """Tools in a room with slippery walls and a floor.

    `lower`, `upper` [m]: walls stand there; nodes at or below `floor` [m] belong to the floor, whose Coulomb `friction`
    is 0 where things slip freely and STICKY or more where they stick. `softness` [1/m] of the tools' shells; the
    substep is `dt` [s] long.
    """

    tools: tuple[Tool, ...]
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    floor: float
    friction: float
    softness: float
    dt: float = UPSTREAM_DT
    walls: ClassVar[str] = f"Room<{STICKY:.0f}>::Walls"

    @property
    def slots(self) -> int:
        """Number of vectors per environment and control step in `tools`."""
        return sum(tool.slots for tool in self.tools)

    def function(self, name: str) -> tuple[Any, Any]:
        """Return the boundary's Warp function and its struct."""
        boundary, Data = _tools_in_room(name, len(self.tools))
        return boundary, Data

    def data(self, name: str, device: str) -> Any:
        """Return the function's data."""
        types = precision(name)
        data = self.function(name)[1]()
        data.lower, data.upper = types.vec3(*self.lower), types.vec3(*self.upper)
        data.floor, data.floor_friction, data.softness = self.floor, self.friction, self.softness
        data.substeps = self.dt / UPSTREAM_DT
        sizes = [(*tool.size, 0.0)[:2] for tool in self.tools]
        rows = np.array([[*size, tool.friction] for size, tool in zip(sizes, self.tools, strict=True)])
        data.shape = wp.array(rows, dtype=types.vec3, device=device)
        shell = -math.log(FAINTEST) / self.softness
        data.reach = wp.array([tool.radius + shell for tool in self.tools], dtype=types.real, device=device)
        data.kind = wp.array([int(tool.kind) for tool in self.tools], dtype=wp.int32, device=device)
        slots = np.cumsum([0, *(tool.slots for tool in self.tools[:-1])])
        data.slot = wp.array(slots, dtype=wp.int32, device=device)
        return data


@cache
@no_type_check
def _tools_in_room(name: str, count: int) -> tuple[Any, Any]:
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    module = f"gradscape.tools.{name}.{count}"
    ball, stick, ring, post = sphere(name), capsule(name), torus(name), cylinder(name)
    read, look = tool_readers(name).read, tool_readers(name).look
    up = wp.constant(vec3(0.0, 1.0, 0.0))

    @partial(wp.struct, module=module)
    class Scene:
        """The fields of ToolsInRoom, dt in PlasticineLab's substeps; for each tool (size, size, friction)."""

        lower: vec3
        upper: vec3
        floor: real
        floor_friction: real
        softness: real
        substeps: real
        shape: wp.array[vec3]
        kind: wp.array[wp.int32]
        slot: wp.array[wp.int32]
        reach: wp.array[real]

    @wp.func(module=module)
    def distance(kind: int, p: vec3, axis: vec3, shape: vec3) -> vec4:
        if kind == Kind.SPHERE:
            return ball(p, shape[0])
        if kind == Kind.TORUS:
            return ring(p, shape[0], shape[1])
        if kind == Kind.CYLINDER:
            return post(p, shape[0], shape[1])
        return stick(p, axis, shape[0], shape[1])

    @wp.func(module=module)
    def rub(t: vec3, normal: real, friction: real) -> vec3:
        """Return the tangential velocity after a contact that stopped the `normal` velocity (Coulomb)."""
        speed = wp.sqrt(wp.dot(t, t) + real(1e-8))
        return t * (wp.max(real(0.0), speed + friction * normal) / speed)

    @wp.func(module=module)
    def share(gap: real, softness: real, substeps: real) -> real:
        """Return the part of what runs into a tool that a node at this distance loses in so many `substeps`."""
        left = (real(1.0) - wp.exp(-softness * wp.max(gap, real(0.0)))) / (real(1.0) - real(FAINTEST))  # in one of them
        if left <= real(0.0):  # inside, where log(left) has no value
            return real(1.0)
        return real(1.0) - wp.exp(substeps * wp.log(left))

    @wp.func(module=module)
    def contact(hit: vec4, v: vec3, body: vec3, friction: real, softness: real, substeps: real) -> vec3:
        """Return the velocity of a node at signed distance hit[3] from a tool whose matter moves at `body`."""
        influence = share(hit[3], softness, substeps)
        n = vec3(hit[0], hit[1], hit[2])
        u = v - body
        normal = wp.dot(u, n)
        if influence <= real(0.0) or normal >= real(0.0):
            return v
        t = rub(u - normal * n, normal, friction)
        return body + (real(1.0) - influence) * u + influence * t

    @wp.func(module=module)
    def apply_tool(
        scene: Scene,
        j: int,
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
        slot = scene.slot[j]
        place = look(tools, e, step, 0, slot)
        gap = p - (place + fraction * (look(tools, e, step, 1, slot) - place))
        if wp.dot(gap, gap) > scene.reach[j] * scene.reach[j]:
            return v
        kind = scene.kind[j]
        shape = scene.shape[j]
        start = read(tools, sums, e, lane, step, 0, slot)
        change = read(tools, sums, e, lane, step, 1, slot) - start
        local = p - (start + fraction * change)
        body = rate * change
        axis = up
        if kind == Kind.ROLLER:
            angles = read(tools, sums, e, lane, step, 0, slot + 1)
            turn = read(tools, sums, e, lane, step, 1, slot + 1) - angles
            yaw = angles[1] + fraction * turn[1]
            axis = vec3(wp.sin(yaw), real(0.0), wp.cos(yaw))
            body += wp.cross(rate * (turn[0] * axis + turn[1] * up), local)
        return contact(distance(kind, local, axis, shape), v, body, shape[2], scene.softness, scene.substeps)

    @wp.func(module=module)
    def apply_floor(v: vec3, friction: real) -> vec3:
        if friction >= real(STICKY):
            return vec3(real(0.0), wp.max(v[1], real(0.0)), real(0.0))
        if v[1] >= real(0.0):
            return v
        return rub(vec3(v[0], real(0.0), v[2]), v[1], friction)

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
        for j in range(wp.static(count)):  # unrolled: a loop that AD replays would lose v
            v = apply_tool(scene, j, p, v, e, lane, tools, sums, step, fraction, rate)
        if p[1] <= scene.floor:
            v = apply_floor(v, scene.floor_friction)
        vx, vy, vz = v[0], v[1], v[2]
        if p[0] <= scene.lower[0]:
            vx = wp.max(vx, real(0.0))
        if p[0] >= scene.upper[0]:
            vx = wp.min(vx, real(0.0))
        if p[1] >= scene.upper[1]:
            vy = wp.min(vy, real(0.0))
        if p[2] <= scene.lower[2]:
            vz = wp.max(vz, real(0.0))
        if p[2] >= scene.upper[2]:
            vz = wp.min(vz, real(0.0))
        return vec3(vx, vy, vz)

    return boundary, Scene
