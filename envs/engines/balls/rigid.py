"""One ball against the ground by penalty contact with friction, after Warp's relaxed contact model.

Damping that sets in at once makes the force jump at touch. Steps of a fixed length cannot see when that is: derivatives
of such a program are exact, and converge to those of a motion that always touches at the same time. Two remedies are
here: a step that is split at the time of touch, and damping that grows with depth.
"""

from dataclasses import dataclass
from functools import cache, partial
from typing import Any, no_type_check

import torch
import warp as wp

from ..runtime import load, precision, to_torch

SMOOTHING = 0.25  # depth at which growing damping is `kd`, in radii


@dataclass(frozen=True)
class Ball:
    """A ball of `radius` [m] and `mass` [kg] over the plane y = 0, in SI units.

    While it overlaps the ground by c = y - radius < 0, approaching at v_n = v_y < 0 where it does, it feels the normal
    force f_n = -(ke c + kd min(v_n, 0)) and the tangential force min(kf |v_t|, mu f_n) against sliding. The viscous
    part is kept below what stops sliding within one step: more would reverse it and add energy. Where damping grows
    with depth, kd is multiplied by -c / (radius / 4) (Hunt & Crossley 1975, the exponent being 1).

    Against the air it feels the force `drag` [kg/m] times its speed squared. `turning`, mass radius^2 / inertia, says
    how easily friction spins it: 2.5 for a solid sphere, 0 for one that cannot spin.
    """

    radius: float
    mass: float
    gravity: float
    ke: float
    kd: float
    kf: float
    mu: float
    drag: float = 0.0
    turning: float = 0.0


class Solver:
    """Integrate up to `capacity` flights by semi-implicit Euler, and differentiate their ends.

    `contacts` is step (whole steps), touch (split at the time of touch) or smooth (damping grows with depth). The whole
    flight is kept: nine numbers a step need no checkpoints. The third state `roll` [m/s] is how fast spin moves the
    lowest point of the ball.
    """

    def __init__(
        self, ball: Ball, *, dt: float, steps: int, name: str, capacity: int, device: str, contacts: str = "step"
    ) -> None:
        self.ball, self.dt, self.steps, self.device = ball, dt, steps, device
        self.types = precision(name)
        self.kernel = flight_kernel(name, contacts)
        load([self.kernel], device)
        self.data = _constants(ball, dt, name)
        shape, vec3 = (steps + 1, capacity), self.types.vec3
        self.state = [wp.zeros(shape, dtype=vec3, device=device) for _ in range(3)]
        self.adjoint = [wp.zeros(shape, dtype=vec3, device=device) for _ in range(3)]
        self.x, self.v, self.roll = self.state

    def run(self, start: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """Fly from `start` [m], shape (3,), at `velocity` [m/s], shape (batch, 3); return x, (step + 1, batch, 3)."""
        batch = len(velocity)
        to_torch(self.x)[0, :batch] = start.to(self.types.torch)
        to_torch(self.v)[0, :batch] = velocity.to(self.types.torch)
        wp.launch(self.kernel, batch, [self.steps, self.data, *self.state], device=self.device, record_tape=False)
        return to_torch(self.x)[:, :batch]

    def gradient(self, adj_x: torch.Tensor) -> torch.Tensor:
        """Return the adjoint of the first velocity from that of the last position, both of shape (batch, 3)."""
        batch = len(adj_x)
        for adjoint in self.adjoint:
            adjoint.zero_()
        to_torch(self.adjoint[0])[-1, :batch] = adj_x.to(self.types.torch)
        settings: dict[str, Any] = {"device": self.device, "adjoint": True, "record_tape": False}
        settings["adj_inputs"] = [None, type(self.data)(), *self.adjoint]
        wp.launch(self.kernel, batch, [self.steps, self.data, *self.state], **settings)
        return to_torch(self.adjoint[1])[0, :batch].clone()


def _constants(ball: Ball, dt: float, name: str) -> Any:
    """Return the struct that kernels read a ball from; `kf` stops sliding within a step at the most."""
    data = ground(name)[0]()
    for field in ("radius", "gravity", "turning"):
        setattr(data, field, getattr(ball, field))
    for field in ("ke", "kd", "mu", "drag"):
        setattr(data, field, getattr(ball, field) / (1.0 if field == "mu" else ball.mass))
    data.dt, data.smoothing = dt, SMOOTHING * ball.radius
    data.kf = min(ball.kf / ball.mass, 1 / (dt * (1 + ball.turning)))
    return data


@cache
@no_type_check
def ground(name: str) -> tuple[Any, Any, Any]:
    """Return what the kernels share: the struct of constants, by mass, and what pushes a ball, by air and friction."""
    types, module = precision(name), f"gradscape.ground.{name}"
    real, vec3 = types.real, types.vec3

    @partial(wp.struct, module=module)
    class Data:
        """Those of Ball by mass, the step, and the depth [m] over which damping grows."""

        dt: real
        radius: real
        gravity: real
        ke: real
        kd: real
        kf: real
        mu: real
        drag: real
        turning: real
        smoothing: real

    @wp.func(module=module)
    def fly(data: Data, speed: vec3) -> vec3:
        """Return the acceleration by gravity and air."""
        return vec3(real(0.0), -data.gravity, real(0.0)) - data.drag * wp.length(speed) * speed

    @wp.func(module=module)
    def rub(data: Data, f_n: real, speed: vec3, roll: vec3) -> vec3:
        """Return what friction adds to the acceleration under the normal force f_n."""
        slip = vec3(speed[0] + roll[0], real(0.0), speed[2] + roll[2])
        squared = wp.dot(slip, slip)
        limit = data.mu * f_n
        if data.kf * data.kf * squared <= limit * limit:
            return -data.kf * slip
        return -(limit / wp.sqrt(squared)) * slip  # the root only here: at rest its derivative is infinite

    return Data, fly, rub


@cache
@no_type_check
def flight_kernel(name: str, contacts: str) -> Any:
    """Return the kernel of a flight in semi-implicit Euler steps; a ball meets the ground as `contacts` says.

    One thread takes a flight through all its steps, since a launch costs more than a step. Nothing is carried from step
    to step but by the arrays: variables that a loop carries would be lost to its derivatives.
    """
    types, module = precision(name), f"gradscape.rigid.{contacts}.{name}"
    real, vec3, Vecs = types.real, types.vec3, wp.array2d[types.vec3]
    Data, fly, rub = ground(name)

    if contacts == "smooth":

        @wp.func(module=module)
        def press(data: Data, c: real, v_n: real) -> real:
            return -(data.ke * c - data.kd * (c / data.smoothing) * wp.min(v_n, real(0.0)))

    else:

        @wp.func(module=module)
        def press(data: Data, c: real, v_n: real) -> real:
            return -(data.ke * c + data.kd * wp.min(v_n, real(0.0)))

    @wp.func(module=module)
    def push(data: Data, dt: real, depth: real, speed: vec3, roll: vec3):
        """Return velocity and roll after a step under the ground's force at a depth."""
        f_n = press(data, depth, speed[1])
        f_t = rub(data, f_n, speed, roll)
        force = fly(data, speed) + vec3(f_t[0], f_n, f_t[2])
        return speed + dt * force, roll + (dt * data.turning) * f_t

    if contacts == "touch":

        @wp.func(module=module)
        def time_to_touch(data: Data, c: real, v_n: real, a: real) -> real:
            """Return when c + t (v_n + t a), where a step of length t would end, is 0; its end where it is not."""
            if c < real(0.0):
                return real(0.0)
            if c + data.dt * (v_n + data.dt * a) >= real(0.0):
                return data.dt
            root = wp.sqrt(v_n * v_n - real(4.0) * a * c)
            if v_n < real(0.0):
                return real(2.0) * c / (root - v_n)
            return (root + v_n) / (real(-2.0) * a)

    else:

        @wp.func(module=module)
        def time_to_touch(data: Data, c: real, v_n: real, a: real) -> real:
            return wp.where(c < real(0.0), real(0.0), data.dt)

    @wp.kernel(module=module)
    def advance(steps: int, data: Data, x: Vecs, v: Vecs, roll: Vecs):
        e = wp.tid()
        for step in range(steps):
            here, speed, turn = x[step, e], v[step, e], roll[step, e]
            c = here[1] - data.radius
            a = fly(data, speed)
            t = time_to_touch(data, c, speed[1], a[1])
            met = speed + t * a
            there = here + t * met
            left = data.dt - t
            if left > real(0.0):
                after, turned = push(data, left, wp.min(c, real(0.0)), met, turn)
                v[step + 1, e] = after
                roll[step + 1, e] = turned
                x[step + 1, e] = there + left * after
            else:
                v[step + 1, e] = met
                roll[step + 1, e] = turn
                x[step + 1, e] = there

    return advance
