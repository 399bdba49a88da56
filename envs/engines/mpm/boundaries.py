"""What grid velocities meet: moving tools and walls.

A boundary is a Warp function (its data, node position, velocity, environment, lane, tools, sums, substep) -> velocity.
`tools` [environment, control step, slot] holds positions [m] at the ends of control steps; in between a tool moves at
constant velocity. A node looks whether a tool is near without an adjoint, and reads where it is with one that is summed
exactly (`exact`), in the `sums` of its `lane`. Sizes and frictions are data, so that scenes with the same kind of
boundary share its compiled kernel.
"""

import abc
import math
from dataclasses import dataclass
from enum import IntEnum
from functools import cache, partial
from types import SimpleNamespace
from typing import Any, ClassVar, no_type_check

import numpy as np
import warp as wp

from .. import cpp
from ..runtime import fill_struct, precision

# ---- Signed distances of tools and walls, with their normals, as Warp functions.
#
# A shape's function takes a point [m] in the shape's own frame and returns (outward unit normal, distance [m]) as a
# 4-vector; the distance is negative inside.

TINY = 1e-12  # added under square roots [m^2], so that an axis or a centre has a gradient


@cache
@no_type_check
def shapes(name: str) -> SimpleNamespace:
    """Return the shapes' functions in one precision."""
    types, module = precision(name), f"gradscape.sdf.{name}"
    real, vec3, vec4 = types.real, types.vec3, types.vec4

    @wp.func(module=module, name=f"sphere_{name}")
    def sphere(p: vec3, radius: real) -> vec4:
        """Return the distance to a ball around the origin."""
        length = wp.sqrt(wp.dot(p, p) + real(TINY))
        return vec4(p[0] / length, p[1] / length, p[2] / length, length - radius)

    @wp.func(module=module, name=f"torus_{name}")
    def torus(p: vec3, ring: real, tube: real) -> vec4:
        """Return the distance to a torus around the y axis: the radius of its ring, and of its tube."""
        axial = wp.sqrt(p[0] * p[0] + p[2] * p[2] + real(TINY))
        gap = axial - ring
        length = wp.sqrt(gap * gap + p[1] * p[1] + real(TINY))
        outward = gap / (length * axial)
        return vec4(outward * p[0], p[1] / length, outward * p[2], length - tube)

    @wp.func(module=module, name=f"capsule_{name}")
    def capsule(p: vec3, axis: vec3, half_length: real, radius: real) -> vec4:
        """Return the distance to a capsule whose middle is the origin, its axis a unit vector."""
        along = wp.clamp(wp.dot(p, axis), -half_length, half_length)
        return sphere(p - along * axis, radius)

    @wp.func(module=module, name=f"cylinder_{name}")
    def cylinder(p: vec3, radius: real, half_height: real) -> vec4:
        """Return the distance to a solid upright cylinder whose middle is the origin."""
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

    @wp.func(module=module, name=f"bowl_{name}")
    def bowl(p: vec3, radius: real, half_thickness: real) -> vec4:
        """Return the distance to an open half-sphere shell, its rim in the plane y = 0, its opening upwards."""
        if p[1] < real(0.0):
            length = wp.sqrt(wp.dot(p, p) + real(TINY))
            gap = length - radius
            side = wp.where(gap < real(0.0), real(-1.0), real(1.0)) / length
            return vec4(side * p[0], side * p[1], side * p[2], wp.abs(gap) - half_thickness)
        return torus(p, radius, half_thickness)

    @wp.func(module=module, name=f"rod_{name}")
    def rod(p: vec3, height: real, radius: real) -> vec4:
        """Return the distance to an upright capsule that stands on the origin."""
        return sphere(vec3(p[0], p[1] - wp.clamp(p[1], real(0.0), height), p[2]), radius)

    return SimpleNamespace(sphere=sphere, torus=torus, capsule=capsule, cylinder=cylinder, bowl=bowl, rod=rod)


# ---- Sums that come out the same whatever their order, because they are exact: the adjoints of tools on a GPU.
#
# Many nodes add to the adjoint of one tool, in an order that chance decides, and sums of floating-point numbers depend
# on theirs. Sums of integers do not. So each number is added as an integer, its mantissa, to one of many sums that
# stand for ranges of exponents, BITS of them each (a Kulisch accumulator: Kulisch 2002, Advanced arithmetic for the
# digital computer). What they come to is rounded once. 2^24 numbers in single precision, 2^30 in double, fit into such
# a sum.
#
# On a CPU, whose sums have one order, numbers are added to the adjoint itself.

LANES = 8  # copies of the sums, so that fewer nodes wait for each other to add to the same one
BITS = 16
SUMS = {"float32": 17, "float64": 132}  # ranges that hold all exponents, and the last: how many are no numbers

LOWEST = {"float32": 149, "float64": 1074}  # 2^-LOWEST is the least number
Sums = wp.array2d[wp.int64]  # [environment and lane, sum]


@cache
@no_type_check
def tool_readers(name: str) -> SimpleNamespace:
    """Return the functions `read, look` of one precision: where a tool is, and the same without an adjoint.

    read(tools, sums, e, lane, step, after, slot) is tools[e, step + after, slot]. On a GPU its adjoint goes to the
    integers `sums` of the environment's `lane`, after being 0 or 1; `settle` takes it from there.
    """
    vec3 = precision(name).vec3
    Paths = wp.array3d[vec3]

    @cpp.func_native(called="read_tool", template=[LANES, SUMS[name]], adjoint="adj_read_tool")
    def read(tools: Paths, sums: Sums, e: int, lane: int, step: int, after: int, slot: int) -> vec3: ...

    @cpp.func_native(called="look_at_tool", adjoint="")
    def look(tools: Paths, e: int, step: int, after: int, slot: int) -> vec3: ...

    return SimpleNamespace(read=read, look=look)


@cache
@no_type_check
def settle_kernel(name: str):
    """Return the kernel that takes the sums of a control step to the adjoint of tools, and clears them.

    It runs over [environment, axis of a slot at the step's start or end].
    """
    types, count = precision(name), SUMS[name]
    real = types.real

    @cpp.func_native(called="weigh_sum", template=[BITS, LOWEST[name]])
    def weigh(sum: wp.int64, range: int) -> wp.float64: ...

    @cpp.func_native(template=[LANES])
    def take_sum(sums: Sums, e: int, at: int) -> wp.int64: ...

    @cpp.func_native()
    def no_number() -> wp.float64: ...

    @wp.kernel(module=cpp.module(f"gradscape.exact.{name}"), enable_backward=False)
    def settle(step: int, sums: Sums, adj_tools: wp.array4d[real]):
        e, place = wp.tid()
        value = wp.float64(0.0)
        for i in range(count):
            total = take_sum(sums, e, place * count + count - 1 - i)
            if i == 0 and total > wp.int64(0):
                value = no_number()
            elif i > 0:
                value += weigh(total, count - 1 - i)
        slots = adj_tools.shape[2]
        at_step, slot, axis = step + place / (3 * slots), place / 3 % slots, place % 3
        adj_tools[e, at_step, slot, axis] = adj_tools[e, at_step, slot, axis] + real(value)

    return settle


@cache
@no_type_check
def substep_struct(name: str) -> Any:
    """Return the struct of what all nodes of a substep have in common, in one precision."""
    real = precision(name).real

    @partial(wp.struct, module=f"gradscape.substeps.{name}")
    class Substep:
        """It lasts `dt` [s], and begins at a `fraction` of control step `step`, which takes 1 / `rate` [s].

        Nodes lighter than `empty` [kg] carry no velocity.
        """

        dt: real
        gravity: real
        empty: real
        step: int
        fraction: real
        rate: real

    return Substep


class Boundary(abc.ABC):
    """What a solver asks of a boundary; `walls` are what the headers call them."""

    walls: ClassVar[str]

    @property
    def slots(self) -> int:
        """Number of vectors per environment and control step in `tools`."""
        return 1

    @property
    def mirrors(self) -> tuple[tuple[float | None, float | None, float | None], ...]:
        """Where walls are that reflect [m], the lower and the upper one along each axis (`mirrors`)."""
        return ((None,) * 3, (None,) * 3)

    @abc.abstractmethod
    def function(self, name: str) -> tuple[Any, Any]:
        """Return the Warp function of one precision, and the struct its data is in."""

    def data(self, name: str, device: str) -> Any:
        """Return the function's data."""
        return fill_struct(self.function(name)[1], vars(self))


@dataclass(frozen=True)
class Open(Boundary):
    """No boundary at all."""

    walls: ClassVar[str] = "OpenWalls"

    def function(self, name: str) -> tuple[Any, Any]:
        """Return the boundary's Warp function and its struct."""
        boundary, Data = _open(name)
        return boundary, Data


@dataclass(frozen=True)
class LadleInTank(Boundary):
    """A square tank, centred on x = z = 0, with its floor at y = 0, and a ladle that moves in it.

    Lengths in m: half the tank's width, the height of a `lid` that stops what flies highest, the bowl's mid-surface
    `radius`, `half_thickness` of its shell, the handle's `height` (0: there is none), and the `band` over which the
    ladle's grip fades to nothing outside its surface. `friction` is Coulomb's; `slip` is what floor and walls leave of
    the velocity along them, from 1 (they slip) to 0 (they stick).

    A node inside the shell is held from both sides, the more the deeper. Where it was only pushed, the shell's middle
    let it go at once as it passed, and losses of `fluid` jumped: by less than a thousandth of their range each, but so
    often that gradients were half of the slope. What was tried at its `standard`: how far gradients are off the slopes
    over 1e-4 and 1e-2 of the box (medians), and the ripple at the cells' wavelength by the range of lines (median and
    greatest excess of ten; `benchmarks/ripples.py` on grids of 24, 32 and 40 cells).

    | shell and band [mm] | gradient off slope | ripple |
    |---|---|---|
    | pushed: 8 and 10 | 37 %, 49 % | 0.7 %, 2.4 % |
    | pushed: 8 and 25; 0.5 and 25.5; 0.5 and 37.5 | 10 to 34 %, 21 to 52 % | 0.3 to 0.4 %, 1.5 to 1.9 % |
    | pushed, without friction, handle or smoothing; 8 particles a cell | 32 to 38 %, 35 to 64 % | 0.4 to 0.8 %, 2.5 % |
    | held: 8 and 12.5 | 0.8 %, 0.6 % | 0.7 %, 3.3 % |
    | held, other bands: 5 and 20; 8 and 20; 8 and 25 | 0.4 to 0.5 %, 0.2 to 0.6 % | 0.5 to 0.7 %, 2.1 to 2.7 % |
    | held, in 5 or 10 ms instead of one time step: 8 and 20; 8 and 25 | 0.7 %, 0.5 to 0.8 % | 0.4 %, 2.2 % |
    | held: 8 and 10, walls reflect | 0.7 %, 1.6 % | 0.3 %, 3.9 % |
    | the same, mean of two grids half a cell apart (twice the cost); of four | | 0.0 %, 1.1 %; 0.0 %, 1.0 % |

    What is left is how far the cube stays from the shell, which a cell decides. On 16 cells losses of two grids half a
    cell apart differ by 3 to 5 % of a line's range; by 6 to 7 % where the cube's particles go up to its faces, by 3 to
    4 % without smoothing of volume, by 3 to 4 % with a band of 40 mm; by as much as they do without friction or handle,
    with a quarter or twice the viscosity, and with 8 particles a cell.
    """

    half_width: float
    lid: float
    radius: float
    half_thickness: float
    height: float
    band: float
    friction: float
    slip: float = 1.0
    walls: ClassVar[str] = "TankWalls"

    @property
    def mirrors(self) -> tuple[tuple[float | None, float | None, float | None], ...]:
        """Where walls are that reflect [m], the lower and the upper one along each axis: floor and sides that slip."""
        if self.slip != 1.0:
            return super().mirrors
        return (-self.half_width, 0.0, -self.half_width), (self.half_width, None, self.half_width)

    def function(self, name: str) -> tuple[Any, Any]:
        """Return the boundary's Warp function and its struct."""
        boundary, Data = _ladle_in_tank(name)
        return boundary, Data


@cache
@no_type_check
def _open(name: str) -> tuple[Any, Any]:
    vec3, Substep, module = precision(name).vec3, substep_struct(name), f"gradscape.boundaries.{name}"
    Paths = wp.array3d[vec3]

    @partial(wp.struct, module=module)
    class Nothing:
        unused: int

    @wp.func(module=module, name=f"open_{name}")
    def boundary(data: Nothing, p: vec3, v: vec3, e: int, lane: int, tools: Paths, sums: Sums, now: Substep) -> vec3:
        return v

    return boundary, Nothing


@cache
@no_type_check
def _ladle_in_tank(name: str) -> tuple[Any, Any]:
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    module, Paths, Substep = f"gradscape.boundaries.{name}", wp.array3d[vec3], substep_struct(name)
    bowl_distance, rod_distance = shapes(name).bowl, shapes(name).rod
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
    def look_between(tools: Paths, e: int, now: Substep) -> vec3:
        """Return where the ladle is, without an adjoint."""
        start = look(tools, e, now.step, 0, 0)
        return start + now.fraction * (look(tools, e, now.step, 1, 0) - start)

    @wp.func(module=module)
    def between(tools: Paths, sums: Sums, e: int, lane: int, now: Substep) -> vec3:
        """Return where the ladle is."""
        start = read(tools, sums, e, lane, now.step, 0, 0)
        return start + now.fraction * (read(tools, sums, e, lane, now.step, 1, 0) - start)

    @wp.func(module=module)
    def velocity(tools: Paths, sums: Sums, e: int, lane: int, now: Substep) -> vec3:
        """Return how the ladle moves."""
        return now.rate * (read(tools, sums, e, lane, now.step, 1, 0) - read(tools, sums, e, lane, now.step, 0, 0))

    @wp.func(module=module)
    def fade(s: real) -> real:
        """Return a cubic step from 0 at s = 0 to 1 at s = 1."""
        s = wp.clamp(s, real(0.0), real(1.0))
        return s * s * (real(3.0) - real(2.0) * s)

    @wp.func(module=module)
    def slide(v: vec3, body: vec3, hit: vec4, thickness: real, band: real, friction: real) -> vec3:
        """Take from the velocity what goes into the body, less with distance; rub the rest (Coulomb).

        Within the body, so much deep, it takes what goes out as well, the more the deeper: on its mid-surface, where
        the normal turns round, a node moves as the body does whichever side it is on.
        """
        n = vec3(hit[0], hit[1], hit[2])
        u = v - body
        normal = wp.dot(u, n)
        if hit[3] >= band or (normal >= real(0.0) and hit[3] >= real(0.0)):
            return v
        grip = fade(real(1.0) - hit[3] / band)
        if normal >= real(0.0):
            grip = fade(-hit[3] / thickness)
        tangent = u - normal * n
        speed = wp.sqrt(wp.dot(tangent, tangent) + real(1e-10))
        tangent = tangent * wp.max(real(0.0), real(1.0) - friction * wp.abs(normal) / speed)
        return body + (real(1.0) - grip) * u + grip * tangent

    @wp.func(module=module)
    def along_wall(p: vec3, v: vec3, edge: real, slip: real) -> vec3:
        """Return what floor and walls leave of a velocity along them; that towards them is not theirs to change."""
        across = wp.where(wp.abs(p[0]) > edge, real(1.0), slip)
        upwards = wp.where(p[1] < real(1e-6), real(1.0), slip)
        deep = wp.where(wp.abs(p[2]) > edge, real(1.0), slip)
        return vec3(across * v[0], upwards * v[1], deep * v[2])

    @wp.func(module=module)
    def boundary(scene: Scene, p: vec3, v: vec3, e: int, lane: int, tools: Paths, sums: Sums, now: Substep) -> vec3:
        shell = scene.half_thickness + scene.band
        rounded = real(1.001) * shell
        outer, inner = scene.radius + rounded, wp.max(scene.radius - rounded, real(0.0))
        local = p - look_between(tools, e, now)
        apart = wp.dot(local, local)
        if apart < outer * outer and apart >= inner * inner:  # elsewhere the bowl is too far off to change anything
            hit = bowl_distance(p - between(tools, sums, e, lane, now), scene.radius, scene.half_thickness)
            v = slide(v, velocity(tools, sums, e, lane, now), hit, scene.half_thickness, scene.band, scene.friction)
        handle = scene.height > real(0.0)
        if handle and wp.abs(local[2]) < shell and wp.abs(local[0] + scene.radius) < shell:
            foot = p - between(tools, sums, e, lane, now) + vec3(scene.radius, real(0.0), real(0.0))
            hit = rod_distance(foot, scene.height, scene.half_thickness)
            v = slide(v, velocity(tools, sums, e, lane, now), hit, scene.half_thickness, scene.band, scene.friction)
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


# ---- Rigid tools that push plasticine about on a floor.
#
# Every tool is a signed distance. Grid velocities in its shell lose what goes into it and are rubbed (Coulomb), the
# less the farther off they are. Tools are moved, never pushed back.
#
# A tool's influence is a rate. PlasticineLab takes the share exp(-softness d) of what a node runs into it once per
# substep, so that with ever shorter substeps all of its shell becomes as hard as its surface: the effective surface
# moves out by ln(2)/softness (1 mm) whenever the step is halved, and losses grow with the logarithm of the number of
# steps. Here the share k that one of its substeps takes (UPSTREAM_DT) is 1 - (1 - k)^(dt/UPSTREAM_DT) of ours: its law
# at its step, and one that converges as the step goes to zero.
#
# Nothing here jumps as a node moves or a velocity changes sign, where PlasticineLab does twice: its influence
# exp(-softness d) ends at a tenth, ours falls to nothing there; its sticky floor lets what rises from it slide, ours
# lets it rise only. Each such jump is small and in no gradient, but an episode has thousands: over steps of 1e-3 they
# put slopes 2e-2 (assembly) and 3e-2 (rolling-pin) away from gradients, which is now 4e-5 and 5e-3.

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
class ToolsInRoom(Boundary):
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
    module, Paths, Substep = f"gradscape.tools.{name}.{count}", wp.array3d[vec3], substep_struct(name)
    forms = shapes(name)
    ball, stick, ring, post = forms.sphere, forms.capsule, forms.torus, forms.cylinder
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
        scene: Scene, j: int, p: vec3, v: vec3, e: int, lane: int, tools: Paths, sums: Sums, now: Substep
    ) -> vec3:
        slot = scene.slot[j]
        place = look(tools, e, now.step, 0, slot)
        gap = p - (place + now.fraction * (look(tools, e, now.step, 1, slot) - place))
        if wp.dot(gap, gap) > scene.reach[j] * scene.reach[j]:
            return v
        kind = scene.kind[j]
        shape = scene.shape[j]
        start = read(tools, sums, e, lane, now.step, 0, slot)
        change = read(tools, sums, e, lane, now.step, 1, slot) - start
        local = p - (start + now.fraction * change)
        body = now.rate * change
        axis = up
        if kind == Kind.ROLLER:
            angles = read(tools, sums, e, lane, now.step, 0, slot + 1)
            turn = read(tools, sums, e, lane, now.step, 1, slot + 1) - angles
            yaw = angles[1] + now.fraction * turn[1]
            axis = vec3(wp.sin(yaw), real(0.0), wp.cos(yaw))
            body += wp.cross(now.rate * (turn[0] * axis + turn[1] * up), local)
        return contact(distance(kind, local, axis, shape), v, body, shape[2], scene.softness, scene.substeps)

    @wp.func(module=module)
    def apply_floor(v: vec3, friction: real) -> vec3:
        if friction >= real(STICKY):
            return vec3(real(0.0), wp.max(v[1], real(0.0)), real(0.0))
        if v[1] >= real(0.0):
            return v
        return rub(vec3(v[0], real(0.0), v[2]), v[1], friction)

    @wp.func(module=module)
    def boundary(scene: Scene, p: vec3, v: vec3, e: int, lane: int, tools: Paths, sums: Sums, now: Substep) -> vec3:
        for j in range(wp.static(count)):  # unrolled: a loop that AD replays would lose v
            v = apply_tool(scene, j, p, v, e, lane, tools, sums, now)
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
