"""Contact by projection: rigid surfaces that take from vertices the velocity into them.

A surface is a Warp function (its data, a position, its pose) -> unit normal and signed distance, negative inside. A
pose is (x [m], y [m], tilt about z [rad]). With n and d where a vertex of velocity v would be at the end of a step,
and u the velocity of the surface's material there, a vertex that would be inside keeps

    v - max(min((v - u).n, 0), d / dt) n

One that was outside ends on the surface, and loses the rest of what goes into it in the next step; one that was inside
goes no deeper. So where vertices end is continuous in where they begin. The rule `start` takes min((v - u).n, 0) from
vertices that are inside when a step starts, by when each is as deep as it happened to come.
"""

import abc
import math
from dataclasses import dataclass
from functools import cache, partial
from types import SimpleNamespace
from typing import Any, ClassVar, Literal, no_type_check

import warp as wp

from .. import cpp
from ..runtime import Ints, fill_struct, precision

Rule = Literal["end", "start"]


class Surface(abc.ABC):
    """What a solver asks of a surface."""

    moves: ClassVar[bool]

    inside: ClassVar[str]  # which tells, in `native/contact.h`, what may be inside it

    @abc.abstractmethod
    def function(self, name: str) -> tuple[Any, Any]:
        """Return the Warp function of one precision, and the struct its data is in."""

    def data(self, name: str) -> Any:
        """Return the function's data."""
        return fill_struct(self.function(name)[1], vars(self))

    @abc.abstractmethod
    def stop(self, name: str, rule: Rule) -> Any:
        """Return the Warp function (data, position, velocity, pose, next pose, dt) -> velocity that contact leaves."""


@dataclass(frozen=True)
class Floor(Surface):
    """The half-space below `height` [m], which does not move: its poses are zeros.

    `friction` is Coulomb's coefficient: of the velocity along the floor this share of what goes into it is taken.
    """

    height: float = 0.0
    friction: float = 0.0
    moves: ClassVar[bool] = False
    inside: ClassVar[str] = "InFloor"

    def function(self, name: str) -> tuple[Any, Any]:
        """Return the surface's Warp function and its struct."""
        found = distances(name)
        return found.floor, found.Level

    def stop(self, name: str, rule: Rule) -> Any:
        """Return the Warp function that takes velocities into the floor."""
        return _stop_still(name, rule)


@dataclass(frozen=True)
class AnchoredFloor(Floor):
    """A floor that does not move, under anchors that do: a pose is how far these have gone [m], along x, y and z."""

    moves: ClassVar[bool] = True


@dataclass(frozen=True)
class Pan(Surface):
    """A round pan: a flat bottom whose edge bends up smoothly, along an arc.

    `flat` is the radius of the bottom, `bend` that of the arc, `thickness` how deep below its surface the pan still is
    [m]; `sweep` is the arc's angle [rad], at most a right one: at 0 the pan is a flat disc. `friction` is Coulomb's
    coefficient. The pose is where the bottom's centre is.
    """

    flat: float
    bend: float
    sweep: float
    thickness: float
    friction: float = 0.0
    moves: ClassVar[bool] = True
    inside: ClassVar[str] = "InPan"

    @property
    def radius(self) -> float:
        """The rim's radius [m]."""
        return self.flat + self.bend * math.sin(self.sweep)

    def function(self, name: str) -> tuple[Any, Any]:
        """Return the surface's Warp function and its struct."""
        found = distances(name)
        return found.pan, found.Dish

    def stop(self, name: str, rule: Rule) -> Any:
        """Return the Warp function that takes velocities into the pan."""
        return _stop(name, rule, *self.function(name))


@dataclass(frozen=True)
class PanOverFloor(Surface):
    """A pan that moves above a floor that does not: the pan stops vertices first, then the floor."""

    pan: Pan
    floor: Floor
    moves: ClassVar[bool] = True
    inside: ClassVar[str] = "InEither"

    def function(self, name: str) -> tuple[Any, Any]:
        """Return the function of the nearer surface, and the struct of both."""
        found = distances(name)
        return found.nearer, found.Both

    def data(self, name: str) -> Any:
        """Return the function's data."""
        return fill_struct(self.function(name)[1], {"pan": self.pan.data(name), "floor": self.floor.data(name)})

    def stop(self, name: str, rule: Rule) -> Any:
        """Return the Warp function that takes velocities into the pan, then those into the floor."""
        return _stop_twice(name, rule)


@cache
@no_type_check
def distances(name: str) -> SimpleNamespace:
    """Return the functions `floor, pan, nearer` of one precision, and the structs `Level, Dish, Both` of their data."""
    types, module = precision(name), f"gradscape.contact.{name}"
    real, vec3, vec4 = types.real, types.vec3, types.vec4

    @partial(wp.struct, module=module)
    class Level:
        """The fields of Floor."""

        height: real
        friction: real

    @wp.func(module=module, name=f"floor_{name}")
    def in_floor(floor: Level, p: vec3, pose: vec3) -> vec4:
        return vec4(real(0.0), real(1.0), real(0.0), p[1] - floor.height)

    @partial(wp.struct, module=module)
    class Dish:
        """The fields of Pan."""

        flat: real
        bend: real
        sweep: real
        thickness: real
        friction: real

    @wp.func(module=module, name=f"edge_{name}")
    def edge(pan: Dish, out: real, height: real) -> vec3:
        """Return the normal (outwards, up) and the distance in a plane through the axis, `out` beyond the bottom."""
        up = pan.bend - height
        if wp.atan2(out, up) > pan.sweep:  # beyond the rim there is nothing
            return vec3(real(0.0), real(1.0), pan.bend)
        reach = wp.sqrt(out * out + up * up)
        return vec3(-out / reach, up / reach, pan.bend - reach)

    @wp.func(module=module, name=f"pan_{name}")
    def in_pan(pan: Dish, p: vec3, pose: vec3) -> vec4:
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

    @partial(wp.struct, module=module)
    class Both:
        """The fields of PanOverFloor."""

        pan: Dish
        floor: Level

    @wp.func(module=module, name=f"nearer_{name}")
    def in_nearer(both: Both, p: vec3, pose: vec3) -> vec4:
        above, below = in_pan(both.pan, p, pose), in_floor(both.floor, p, vec3())
        if below[3] < above[3]:
            return below
        return above

    return SimpleNamespace(floor=in_floor, Level=Level, pan=in_pan, Dish=Dish, nearer=in_nearer, Both=Both)


@cache
@no_type_check
def _stop(name: str, rule: Rule, distance: Any, Data: Any) -> Any:
    types = precision(name)
    real, vec3 = types.real, types.vec3
    module = f"gradscape.contact.{name}"

    @wp.func(module=module, name=f"material_{name}")
    def material(p: vec3, pose: vec3, rate: vec3) -> vec3:
        """Return the velocity of the surface's material at a position."""
        return vec3(rate[0] - rate[2] * (p[1] - pose[1]), rate[1] + rate[2] * (p[0] - pose[0]), real(0.0))

    @wp.func(module=module, name=f"take_{name}")
    def take(v: vec3, body: vec3, n: vec3, into: real, friction: real) -> vec3:
        """Return what a velocity is without its part `into` the surface, and with less along it by friction."""
        left = v - into * n
        if friction > real(0.0):
            slip = left - body
            slip = slip - wp.dot(slip, n) * n
            speed = wp.length(slip)
            if speed > real(0.0):
                left = left - wp.min(real(1.0), -friction * into / speed) * slip
        return left

    @wp.func(module=module, name=f"stop_end_{distance.key}")
    def at_end(data: Data, p: vec3, v: vec3, pose: vec3, following: vec3, dt: real) -> vec3:
        q = p + dt * v
        hit = distance(data, q, following)
        left = v + vec3()
        if hit[3] < real(0.0):
            n = vec3(hit[0], hit[1], hit[2])
            body = material(q, following, (following - pose) / dt)
            into = wp.max(wp.min(wp.dot(v - body, n), real(0.0)), hit[3] / dt)
            left = take(v, body, n, into, data.friction)
        return left

    @wp.func(module=module, name=f"stop_start_{distance.key}")
    def at_start(data: Data, p: vec3, v: vec3, pose: vec3, following: vec3, dt: real) -> vec3:
        hit = distance(data, p, pose)
        left = v + vec3()
        if hit[3] < real(0.0):
            n = vec3(hit[0], hit[1], hit[2])
            body = material(p, pose, (following - pose) / dt)
            left = take(v, body, n, wp.min(wp.dot(v - body, n), real(0.0)), data.friction)
        return left

    return at_end if rule == "end" else at_start


@cache
@no_type_check
def _stop_still(name: str, rule: Rule) -> Any:
    types = precision(name)
    real, vec3 = types.real, types.vec3
    found = distances(name)
    Level, at_floor = found.Level, _stop(name, rule, found.floor, found.Level)

    @wp.func(module=f"gradscape.contact.{name}", name=f"stop_{rule}_still_{name}")
    def stop(floor: Level, p: vec3, v: vec3, pose: vec3, following: vec3, dt: real) -> vec3:
        return at_floor(floor, p, v, vec3(), vec3(), dt)  # whatever the poses are

    return stop


@cache
@no_type_check
def _stop_twice(name: str, rule: Rule) -> Any:
    types = precision(name)
    real, vec3 = types.real, types.vec3
    found, at_floor = distances(name), _stop_still(name, rule)
    at_pan, Both = _stop(name, rule, found.pan, found.Dish), found.Both

    @wp.func(module=f"gradscape.contact.{name}", name=f"stop_{rule}_both_{name}")
    def stop(both: Both, p: vec3, v: vec3, pose: vec3, following: vec3, dt: real) -> vec3:
        return at_floor(both.floor, p, at_pan(both.pan, p, v, pose, following, dt), pose, following, dt)

    return stop


@cache
@no_type_check
def _reader(name: str) -> Any:
    """Return the function of an element that is read once, so that its adjoint is set, not added to atomically."""
    vec3, Vectors = precision(name).vec3, precision(name).rows[1]

    @cpp.func_native(called="read_strided", adjoint="set_adj_read_strided")
    def read(values: Vectors, row: int, i: int) -> vec3: ...

    return read


@cache
@no_type_check
def contact_kernel(name: str, stop: Any, Data: Any) -> Any:
    """Return the kernel that lets a surface stop vertices, and moves them.

    Within a step the surface moves steadily from one pose to the next. `held` vertices go where places do that are
    given as poses: nowhere where poses stay. Poses are read by vertex.

    The adjoint sets those of poses, `x` and `pulled`, whatever they were, or leaves out what is None.
    """
    types, read = precision(name), _reader(name)
    real, Vectors = types.real, types.rows[1]

    @wp.kernel(module=cpp.module(f"gradscape.contact.{stop.key}"), grid_stride=False)
    def touch(
        dt: real,
        data: Data,
        held: wp.array[bool],
        pose: Vectors,
        following: Vectors,
        x: Vectors,
        pulled: Vectors,
        x_next: Vectors,
        v_next: Vectors,
    ):
        row, i = wp.tid()
        p = read(x, row, i)
        now, then = read(pose, row, i), read(following, row, i)
        v = stop(data, p, read(pulled, row, i), now, then, dt)
        if held[i]:
            v = (then - now) / dt
        v_next[row, i] = v
        x_next[row, i] = p + dt * v

    return touch


@cache
@no_type_check
def contact_kernel_in_rows(name: str, stop: Any, Data: Any, inside: str, rule: Rule) -> Any:
    """Return the same kernel for a CPU, with room for the list of a row's vertices that are touched, and their count.

    What is held or may be `inside` the surface is found eight at a time (`native/contact.h`), and left to the Warp
    function; the others fly on.
    """
    types, read = precision(name), _reader(name)
    real, Vectors = types.real, types.rows[1]

    @cpp.func_native(template=[f"gradscape::{inside}", int(rule == "end")], adjoint="")
    def list_touched(
        e: int,
        dt: real,
        data: Data,
        held: wp.array[bool],
        pose: Vectors,
        following: Vectors,
        x: Vectors,
        pulled: Vectors,
        touched: Ints,
    ): ...

    @cpp.func_native(adjoint="adj_move_others", replay=False)
    def move_others(
        e: int,
        dt: real,
        touched: Ints,
        pose: Vectors,
        following: Vectors,
        x: Vectors,
        pulled: Vectors,
        x_next: Vectors,
        v_next: Vectors,
    ): ...

    @wp.kernel(module=cpp.module(f"gradscape.contact.{stop.key}.rows"))
    def touch(
        dt: real,
        data: Data,
        held: wp.array[bool],
        pose: Vectors,
        following: Vectors,
        x: Vectors,
        pulled: Vectors,
        x_next: Vectors,
        v_next: Vectors,
        touched: Ints,
    ):
        row, _ = wp.tid()
        list_touched(row, dt, data, held, pose, following, x, pulled, touched)
        move_others(row, dt, touched, pose, following, x, pulled, x_next, v_next)
        for n in range(touched[row, 0]):
            i = touched[row, n + 1]
            p = read(x, row, i)
            now, then = read(pose, row, i), read(following, row, i)
            v = stop(data, p, read(pulled, row, i), now, then, dt)
            if held[i]:
                v = (then - now) / dt
            v_next[row, i] = v
            x_next[row, i] = p + dt * v

    return cpp.take_rows(touch)


@cache
@no_type_check
def sum_kernel_in_rows(name: str) -> Any:
    """Return a kernel that does for a CPU what both of `sum_kernels` do."""
    vec3, Vectors, module = precision(name).vec3, precision(name).rows[1], f"gradscape.contact.sums.{name}.rows"
    return cpp.kernel_in_rows(module, "add_vertices", by_vertex=Vectors, by_row=wp.array[vec3])


@cache
@no_type_check
def sum_kernels(name: str) -> tuple[Any, Any]:
    """Return two kernels that sum over a row's vertices in one order on every device, without atomic adds.

    The first takes [row, part] to the sum of every vertex whose number is `part` by the count of parts, the second adds
    a row's parts to what is there. A row's sum does not depend on other rows.
    """
    vec3, Vectors, module = precision(name).vec3, precision(name).rows[1], f"gradscape.contact.sums.{name}"

    @wp.kernel(module=module, enable_backward=False)
    def gather(by_vertex: Vectors, by_part: Vectors):
        row, part = wp.tid()
        total = vec3()
        for i in range(part, by_vertex.shape[1], by_part.shape[1]):
            total += by_vertex[row, i]
        by_part[row, part] = total

    @wp.kernel(module=module, enable_backward=False)
    def add(by_part: Vectors, by_row: wp.array[vec3]):
        row, _ = wp.tid()
        total = vec3()
        for part in range(by_part.shape[1]):
            total += by_part[row, part]
        by_row[row] = by_row[row] + total

    return gather, add
