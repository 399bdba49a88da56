"""Mass-spring sheets as DiffTaichi writes them: time index first, one kernel per equation, adjoints by the compiler.

A step takes vertices' x and v from time t to time t + 1:

    pull     f_t    = sum over a vertex's springs of weight (s (|d| - rest) + damping w.n) n + plate d
    advance  v'     = v_t + dt (f_t / m - drag v_t - g)
             v_t+1  = v' - max(min((v' - u).n, 0), d / dt) n where x_t + dt v' is inside a surface,
             or (pose_t+1 - pose_t) / dt where held
             x_t+1  = x_t + dt v_t+1

A spring has d = x_j - x_i, w = v_j - v_i, n = d / |d|, s = (s_i + s_j) / 2, and adds its force to both its ends; a
surface has the normal n, the distance d < 0 and material that moves with u, all where the vertex would be at the end
of the step, or by the rule `start` where it is, and then without d / dt. Friction takes from what is left along the
surface. Fields are [time, row, vertex] and hold the whole episode.
"""

import threading
import weakref
from types import SimpleNamespace
from typing import Any, no_type_check

import numpy as np
import torch

from ..runtime import precision
from ..sheets.contact import Floor, Pan, Rule, Surface
from ..sheets.springs import Sheet
from .runtime import real, start


def bytes_per_row(sheet: Sheet, steps: int, name: str) -> int:
    """Return the bytes an episode takes: position, velocity and force of every step, their adjoints, and the result."""
    return 21 * (steps + 1) * len(sheet.x) * (8 if name == "float64" else 4)


class Solver:
    """Integrate up to `capacity` sheets by semi-implicit Euler, and differentiate where they end.

    This is `springs.Solver` on Taichi, for one thread at a time. On a CPU each row is one iteration of a loop, so that
    its sums have one order; Taichi gives a core no fewer than 512 of those, so small batches keep one core busy. On a
    GPU sums have no order. Setting `stop` ends an episode within a step, with InterruptedError.
    """

    def __init__(
        self,
        sheet: Sheet,
        surface: Surface,
        *,
        dt: float,
        steps: int,
        name: str,
        capacity: int,
        device: str,
        stop: threading.Event | None = None,
        rule: Rule = "end",
    ) -> None:
        ti, R = start(device), real(name)
        self.steps, self.count, self.capacity = steps, len(sheet.x), capacity
        self.kind: Any = {"dtype": precision(name).torch, "device": device}
        self.stop = stop or threading.Event()
        fields, tree = _fields(ti, R, sheet, frames=steps + 1, capacity=capacity)
        given = {"pairs": sheet.pairs, "rest": sheet.rest, "weight": sheet.weight, "plate": sheet.plates}
        given |= {"start": sheet.x, "free": ~np.isin(np.arange(self.count), sheet.held), "mass": sheet.masses}
        for field, values in given.items():
            getattr(fields, field).from_numpy(values.astype("int32" if field == "pairs" else name))
        weakref.finalize(self, tree.destroy).atexit = False  # Taichi keeps fields that nothing refers to
        self.borders = _borders(ti, R, fields)
        stop_by = _stops(ti, R, surface, rule, dt=dt)
        self.physics = _physics(ti, R, sheet, fields, stop_by, moves=surface.moves, dt=dt, device=device)
        self._compile()

    def run(self, velocity: torch.Tensor, stiffness: torch.Tensor, poses: torch.Tensor | None = None) -> torch.Tensor:
        """Return where vertices are after each step [m], shape (step + 1, batch, vertex, 3).

        All but held vertices start at `velocity` [m/s], shape (batch, 3); `stiffness` [N/m] has shape (batch, vertex);
        `poses` of the surface have shape (batch, step + 1, 3), and are zeros unless given.

        Raises ValueError for more rows than the solver takes.
        """
        batch, count, frames = len(velocity), self.count, self.steps + 1
        if batch > self.capacity:
            raise ValueError(f"this solver takes up to {self.capacity} rows; got {batch}")
        poses = torch.zeros(batch, frames, 3) if poses is None else poses
        self.given = (
            self._convert("velocity", velocity, batch, 3),
            self._convert("stiffness", stiffness, batch, count),
            self._convert("poses", poses, batch, frames, 3),
        )
        self.borders.begin(*self.given)
        for step in range(self.steps):
            self._refuse_if_stopped()
            self.physics.pull(step, batch)
            self.physics.advance(step, batch)
        x = torch.empty(frames, batch, count, 3, **self.kind)
        self.borders.read(x)
        return x

    def gradient(self, adj_x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the adjoints of `run`'s velocity, stiffness and poses from that of the last positions."""
        batch = len(self.given[0])
        self.borders.seed(self._convert("adj_x", adj_x, batch, self.count, 3))
        for step in reversed(range(self.steps)):
            self._refuse_if_stopped()
            self.physics.advance.grad(step, batch)
            self.physics.pull.grad(step, batch)
        adjoints = [torch.zeros_like(part) for part in self.given]
        for part, adjoint in zip(self.given, adjoints, strict=True):
            part.grad = adjoint
        self.borders.begin.grad(*self.given)
        velocity, stiffness, poses = (adjoint.cpu() for adjoint in adjoints)
        return velocity, stiffness, poses

    def _convert(self, name: str, part: torch.Tensor, *shape: int) -> torch.Tensor:
        """Return a tensor as the kernels read it, which check no index."""
        if tuple(part.shape) != shape:
            raise ValueError(f"this solver takes {name} of shape {shape}; got {tuple(part.shape)}")
        return part.detach().to(**self.kind).contiguous()

    def _compile(self) -> None:
        """Compile every kernel, or fetch it from the cache, by launching it on no rows."""
        nothing = [torch.zeros(0, *shape, **self.kind) for shape in ((3,), (self.count,), (self.steps + 1, 3))]
        for kernel in (self.physics.pull, self.physics.advance):
            kernel(0, 0)
            kernel.grad(0, 0)
        self.borders.begin(*nothing)
        self.borders.begin.grad(*nothing)
        self.borders.seed(torch.zeros(0, self.count, 3, **self.kind))
        self.borders.read(torch.zeros(self.steps + 1, 0, self.count, 3, **self.kind))

    def _refuse_if_stopped(self) -> None:
        if self.stop.is_set():
            raise InterruptedError("the simulation was stopped")


@no_type_check
def _fields(ti: Any, R: Any, sheet: Sheet, *, frames: int, capacity: int) -> tuple[SimpleNamespace, Any]:
    """Return the fields of springs, vertices, what drives them and their episode, and the tree that holds them."""
    builder = ti.FieldsBuilder()
    count, springs = len(sheet.x), len(sheet.pairs)

    def place(field, *shape):
        for part in (field, field.grad) if field.grad is not None else (field,):
            builder.dense(ti.axes(*range(len(shape))), shape).place(part)
        return field

    def states():
        return place(ti.Vector.field(3, R, needs_grad=True), frames, capacity, count)

    fields = SimpleNamespace(
        pairs=place(ti.Vector.field(2, ti.i32), springs),
        rest=place(ti.field(R), springs),
        weight=place(ti.field(R), springs),
        plate=place(ti.field(R), springs),
        start=place(ti.Vector.field(3, R), count),
        free=place(ti.field(R), count),
        mass=place(ti.field(R), count),
        stiffness=place(ti.field(R, needs_grad=True), capacity, count),
        poses=place(ti.Vector.field(3, R, needs_grad=True), frames, capacity),
        x=states(),
        v=states(),
        f=states(),
    )
    return fields, builder.finalize()


@no_type_check
def _physics(
    ti: Any, R: Any, sheet: Sheet, fields: Any, stop: Any, *, moves: bool, dt: float, device: str
) -> SimpleNamespace:
    """Return the kernels `pull` of springs' forces and `advance` of vertices against a surface."""
    plate = fields.plate
    pairs, rest, weight, free, mass = fields.pairs, fields.rest, fields.weight, fields.free, fields.mass
    x, v, f, stiffness, poses = fields.x, fields.v, fields.f, fields.stiffness, fields.poses
    count, springs = len(sheet.x), len(sheet.pairs)
    damping, drag, g = sheet.damping, sheet.drag, sheet.gravity
    vec3 = ti.types.vector(3, R)
    pulling, advancing = (1, 1) if device == "cpu" else (springs, count)  # threads of a row

    @ti.kernel
    def pull(t: ti.i32, batch: ti.i32):
        for row, part in ti.ndrange(batch, pulling):
            for k in range(part * (springs // pulling), (part + 1) * (springs // pulling)):
                i, j = pairs[k][0], pairs[k][1]
                d = x[t, row, j] - x[t, row, i]
                f[t, row, i] += plate[k] * d
                f[t, row, j] -= plate[k] * d
                square = d.dot(d)
                if square > R(0.0):  # ends that coincide have no direction
                    length = ti.sqrt(square)
                    n = d / length
                    s = R(0.5) * (stiffness[row, i] + stiffness[row, j])
                    rate = (v[t, row, j] - v[t, row, i]).dot(n)
                    force = weight[k] * (s * (length - rest[k]) + R(damping) * rate) * n
                    f[t, row, i] += force
                    f[t, row, j] -= force

    @ti.kernel
    def advance(t: ti.i32, batch: ti.i32):
        for row, part in ti.ndrange(batch, advancing):
            for i in range(part * (count // advancing), (part + 1) * (count // advancing)):
                p = x[t, row, i]
                a = f[t, row, i] / mass[i] - R(drag) * v[t, row, i] - vec3(0.0, g, 0.0)
                v_next = free[i] * stop(p, v[t, row, i] + R(dt) * a, poses[t, row], poses[t + 1, row])
                if ti.static(moves):
                    v_next += (R(1.0) - free[i]) * (poses[t + 1, row] - poses[t, row]) / R(dt)
                v[t + 1, row, i] = v_next
                x[t + 1, row, i] = p + R(dt) * v_next

    return SimpleNamespace(pull=pull, advance=advance)


@no_type_check
def _borders(ti: Any, R: Any, fields: Any) -> SimpleNamespace:
    """Return the kernels between tensors and fields; the adjoint of `begin` adds to the gradients of its tensors."""
    x, v, f, free, stiffness, poses = fields.x, fields.v, fields.f, fields.free, fields.stiffness, fields.poses
    vec3 = ti.types.vector(3, R)
    arrays = ti.types.ndarray

    @ti.kernel
    def begin(
        velocity: arrays(dtype=vec3, ndim=1, needs_grad=True),
        stiff: arrays(dtype=R, ndim=2, needs_grad=True),
        path: arrays(dtype=vec3, ndim=2, needs_grad=True),
    ):
        for row in range(velocity.shape[0]):
            for i in range(stiff.shape[1]):
                x[0, row, i] = fields.start[i]
                v[0, row, i] = free[i] * velocity[row]
                stiffness[row, i] = stiff[row, i]
        for row, t in ti.ndrange(path.shape[0], path.shape[1]):
            poses[t, row] = path[row, t]
        for t, row, i in ti.ndrange(path.shape[1], path.shape[0], stiff.shape[1]):
            f[t, row, i] = vec3(0.0)

    @ti.kernel
    def read(out: arrays(dtype=vec3, ndim=3)):
        for t, row, i in out:
            out[t, row, i] = x[t, row, i]

    @ti.kernel
    def seed(adj_x: arrays(dtype=vec3, ndim=2)):
        for t, row, i in ti.ndrange(x.shape[0], adj_x.shape[0], adj_x.shape[1]):
            x.grad[t, row, i] = v.grad[t, row, i] = f.grad[t, row, i] = vec3(0.0)
        for row, i in adj_x:
            x.grad[x.shape[0] - 1, row, i] = adj_x[row, i]
            stiffness.grad[row, i] = R(0.0)
        for t, row in ti.ndrange(poses.shape[0], adj_x.shape[0]):
            poses.grad[t, row] = vec3(0.0)

    return SimpleNamespace(begin=begin, read=read, seed=seed)


@no_type_check
def _stops(ti: Any, R: Any, surface: Surface, rule: Rule, *, dt: float) -> Any:
    """Return what a surface, or a pan and then a floor, leaves of a velocity, as a function of place and poses."""
    vec3 = ti.types.vector(3, R)
    if isinstance(surface, Pan):
        return _stop(ti, R, _pan(ti, R, surface), rule, dt=dt, friction=surface.friction)
    if isinstance(surface, Floor):
        still = _stop(ti, R, _floor(ti, R, surface), rule, dt=dt, friction=surface.friction)

        @ti.func
        def stop_still(p, v, pose, following):
            return still(p, v, vec3(0.0), vec3(0.0))  # whatever the poses are

        return stop_still
    pan, floor = (_stops(ti, R, part, rule, dt=dt) for part in (surface.pan, surface.floor))

    @ti.func
    def stop(p, v, pose, following):
        return floor(p, pan(p, v, pose, following), pose, following)

    return stop


@no_type_check
def _stop(ti: Any, R: Any, inside: Any, rule: Rule, *, dt: float, friction: float) -> Any:
    """Return the function of one surface."""
    vec3 = ti.types.vector(3, R)
    ahead = float(rule == "end")  # of the steps that a place is looked at

    @ti.func
    def stop(p, v, pose, following):
        q, now = p + R(ahead * dt) * v, pose + R(ahead) * (following - pose)
        n, depth = inside(q, now)
        left = v
        if depth > R(0.0):
            rate = (following - pose) / R(dt)
            material = vec3(rate[0] - rate[2] * (q[1] - now[1]), rate[1] + rate[2] * (q[0] - now[0]), 0.0)
            into = ti.min((v - material).dot(n), R(0.0))
            if ti.static(rule == "end"):
                into = ti.max(into, -depth / R(dt))
            left = v - into * n
            if ti.static(friction > 0.0):
                slip = left - material
                slip = slip - slip.dot(n) * n
                square = slip.dot(slip)
                if square > R(0.0):
                    left = left - ti.min(R(1.0), -R(friction) * into / ti.sqrt(square)) * slip
        return left

    return stop


@no_type_check
def _floor(ti: Any, R: Any, floor: Floor) -> Any:
    vec3 = ti.types.vector(3, R)

    @ti.func
    def inside(p, pose):
        return vec3(0.0, 1.0, 0.0), R(floor.height) - p[1]

    return inside


@no_type_check
def _pan(ti: Any, R: Any, pan: Pan) -> Any:
    """In its own frame its bottom is the disc r < flat at y = 0; its edge is of a torus around (flat, bend)."""
    vec3 = ti.types.vector(3, R)

    @ti.func
    def inside(p, pose):
        c, s = ti.cos(pose[2]), ti.sin(pose[2])
        right, up, front = vec3(c, s, 0.0), vec3(-s, c, 0.0), vec3(0.0, 0.0, 1.0)
        offset = p - vec3(pose[0], pose[1], 0.0)
        along, height = offset.dot(right), offset.dot(up)
        square = along * along + p[2] * p[2]
        n, depth = up, -height
        if square > R(pan.flat**2):  # r has no slope on the axis
            r = ti.sqrt(square)
            out, down = r - R(pan.flat), R(pan.bend) - height
            reach = ti.sqrt(out * out + down * down)
            n = (down * up - (out / r) * (along * right + p[2] * front)) / reach
            depth = reach - R(pan.bend)
            if ti.atan2(out, down) > R(pan.sweep):  # nothing is beyond the rim
                depth = -R(pan.bend)
        if depth > R(pan.thickness):  # what is under the pan has left it
            depth = -R(pan.thickness)
        return n, depth

    return inside
