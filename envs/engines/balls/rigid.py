"""One ball against the ground by penalty contact with friction, after Warp's relaxed contact model."""

from dataclasses import dataclass
from functools import cache
from typing import Any, no_type_check

import torch
import warp as wp

from ..runtime import load, precision, to_torch


@dataclass(frozen=True)
class Ball:
    """A ball of `radius` [m] and `mass` [kg] over the plane y = 0, in SI units.

    While it overlaps the ground by c = y - radius < 0, approaching at v_n = v_y < 0 where it does, it feels the normal
    force f_n = -(ke c + kd min(v_n, 0)) and the tangential force min(kf |v_t|, mu f_n) against sliding. The viscous
    part is kept below what stops the ball within one step, mass |v_t| / dt: more would reverse it and add energy.
    """

    radius: float
    mass: float
    gravity: float
    ke: float
    kd: float
    kf: float
    mu: float


class Solver:
    """Integrate up to `capacity` flights by semi-implicit Euler, and differentiate their ends.

    The whole flight is kept: six numbers a step need no checkpoints.
    """

    def __init__(self, ball: Ball, *, dt: float, steps: int, name: str, capacity: int, device: str) -> None:
        self.ball, self.dt, self.steps, self.device = ball, dt, steps, device
        self.types = precision(name)
        self.kernel = step_kernel(name)
        load([self.kernel], device)
        shape = (steps + 1, capacity)
        self.x, self.v, self.adj_x, self.adj_v = (
            wp.zeros(shape, dtype=self.types.vec3, device=device) for _ in range(4)
        )

    def run(self, start: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """Fly from `start` [m], shape (3,), at `velocity` [m/s], shape (batch, 3); return x, (step + 1, batch, 3)."""
        batch = len(velocity)
        to_torch(self.x)[0, :batch] = start.to(self.types.torch)
        to_torch(self.v)[0, :batch] = velocity.to(self.types.torch)
        for step in range(self.steps):
            wp.launch(self.kernel, batch, self._inputs(step), device=self.device, record_tape=False)
        return to_torch(self.x)[:, :batch]

    def gradient(self, adj_x: torch.Tensor) -> torch.Tensor:
        """Return the adjoint of the first velocity from that of the last position, both of shape (batch, 3)."""
        batch = len(adj_x)
        self.adj_x.zero_()
        self.adj_v.zero_()
        to_torch(self.adj_x)[-1, :batch] = adj_x.to(self.types.torch)
        for step in reversed(range(self.steps)):
            inputs = self._inputs(step)
            adjoints = [None] * (len(inputs) - 2) + [self.adj_x, self.adj_v]
            wp.launch(
                self.kernel, batch, inputs, adj_inputs=adjoints, device=self.device, adjoint=True, record_tape=False
            )
        return to_torch(self.adj_v)[0, :batch].clone()

    def _inputs(self, step: int) -> list[Any]:
        b = self.ball
        rubbing = min(b.kf, b.mass / self.dt), b.mu
        return [step, self.dt, b.radius, b.mass, b.gravity, b.ke, b.kd, *rubbing, self.x, self.v]


@cache
@no_type_check
def step_kernel(name: str) -> Any:
    """Return the kernel of one semi-implicit Euler step."""
    types = precision(name)
    real, vec3 = types.real, types.vec3

    @wp.kernel(module=f"gradscape.rigid.{name}")
    def advance(
        step: int,
        dt: real,
        radius: real,
        mass: real,
        gravity: real,
        ke: real,
        kd: real,
        kf: real,
        mu: real,
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
    ):
        e = wp.tid()
        here, speed = x[step, e], v[step, e]
        force = vec3(real(0.0), -mass * gravity, real(0.0))
        c = here[1] - radius
        if c < real(0.0):
            f_n = -(ke * c + kd * wp.min(speed[1], real(0.0)))
            v_t = vec3(speed[0], real(0.0), speed[2])
            squared = speed[0] * speed[0] + speed[2] * speed[2]
            limit = mu * f_n
            force += vec3(real(0.0), f_n, real(0.0))
            if kf * kf * squared <= limit * limit:
                force -= kf * v_t
            else:  # the root only here: at rest its derivative is infinite
                force -= (limit / wp.sqrt(squared)) * v_t
        after = speed + (dt / mass) * force
        v[step + 1, e] = after
        x[step + 1, e] = here + dt * after

    return advance
