"""The Bounce scene: a ball is thrown so that it meets a target after bouncing off the ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..landscapes.episode import Part, View
from ..landscapes.objective import Evaluation, Status
from ..landscapes.space import ParameterSpace
from .base import Environment, Episode, Fidelity, MaterialRange, Work
from .batching import Pool
from .engines.balls.rigid import Ball, Solver
from .options import EpisodeOptions

START = (-0.5, 1.0, 0.0)  # [m]
DURATION = 2.0  # [s]
VIEW = View((-0.8, 0.0, -0.7), (2.6, 5.1, 0.7), eye=(0.1, 0.25, 1.0))


@dataclass(frozen=True)
class BounceOptions(EpisodeOptions):
    """Contact: stiffness `ke` [N/m], damping `kd` and viscous friction `kf` [N s/m], Coulomb's `mu`.

    The target is at (`target_x`, `target_y`, `target_z`) [m].
    """

    ke: float = 1e4
    kd: float = 10.0
    kf: float = 1e3
    mu: float = 0.25
    target_x: float = 2.0
    target_y: float = 1.0
    target_z: float = 0.0


class Bounce(Environment):
    """Throw a ball so that it is at the target after 2 s, having bounced off the ground.

    Model: a ball of radius 0.1 m and mass 1 kg flies from (-0.5, 1, 0) m under gravity; the ground y = 0 pushes back by
    Warp's relaxed contact (penalty stiffness 1e4 N/m, damping 10 N s/m while approaching, friction); semi-implicit
    Euler, dt 1/480 s at standard.
    Parameters: initial velocity x, y, z [m/s].
    Loss: squared distance of the ball's centre to the target (2, 1, 0) m at the end, after 2 s [m^2]. One bounce
    reaches it (example `aim`).
    Simplifications: the ball does not spin, since friction on a point keeps the discontinuity the scene is about; there
    is no wall, since the policy has to use the ground. Viscous friction is capped so that a step cannot reverse
    sliding.
    Source: task Bounce of "Rethinking Optimization with Differentiable Simulation from a Global Perspective" (CoRL
    2022), appendix B.1; contact constants of NVIDIA Warp's bounce example.
    """

    name: ClassVar[str] = "bounce"
    devices: ClassVar[tuple[str, ...]] = ("cpu", "cuda")
    beyond_box: ClassVar[bool] = True
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=1 / 240),
        "standard": Fidelity("standard", dt=1 / 480),
        "reference": Fidelity("reference", dt=1 / 3840, precision="float64"),
    }
    loss_unit: ClassVar[str] = "m²"
    contact_stiffness: ClassVar[str] = "ke"
    designed_order: ClassVar[dict[str, float]] = {"dt": 1.0}  # semi-implicit Euler
    material_range: ClassVar[MaterialRange] = MaterialRange("ke", 1e3, 1e5)  # a tenth and ten times the default
    Options: ClassVar[type[Any]] = BounceOptions
    examples: ClassVar[dict[str, tuple[float, ...]]] = {"aim": (6.12, -9.68, 0.0)}
    _solvers: Pool[Solver]
    space = ParameterSpace(
        ("velocity x", "velocity y", "velocity z"),
        torch.full((3,), -10.0, dtype=torch.float64),
        torch.full((3,), 10.0, dtype=torch.float64),
        ("m/s",) * 3,
    )

    @property
    def preferred_batch(self) -> int:
        """Number of points worth evaluating at once."""
        return 512 if self.device == "cpu" else 1 << 16

    @property
    def steps(self) -> int:
        """Number of time steps of an episode."""
        steps: int = self.options.count_steps(round(DURATION / self.fidelity.dt))
        return steps

    def memory(self) -> int:
        """Estimate the bytes one episode takes while it runs."""
        return (self.steps + 1) * 4 * 3 * (8 if self.fidelity.precision == "float64" else 4)

    def work(self) -> Work:
        """Count steps of the ball."""
        return Work(self.steps, "body-step")

    def bounces(self, x: Float[Tensor, "batch 3"]) -> Int[Tensor, " batch"]:
        """Count how often each ball leaves the ground."""
        counts = []
        for part in torch.split(self._check_points(x), self._capacity):
            with self._solvers.lend() as solver:
                height = solver.run(torch.tensor(START), part)[:, :, 1].cpu()
            inside = height < self.ball.radius
            counts.append((inside[:-1] & ~inside[1:]).sum(dim=0))
        return torch.cat(counts) if counts else torch.zeros(0, dtype=torch.int64)

    def events(self, x: Float[Tensor, "batch dim"]) -> Mapping[str, Int[Tensor, " batch"]]:
        """Count the bounces of each flight."""
        return {"bounces": self.bounces(x)}

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return the ball's flight."""
        (row,) = self._row(x)
        with self._solvers.lend() as solver:
            flight = solver.run(torch.tensor(START), row[None]).double().cpu()
        time = self.fidelity.dt * torch.arange(self.steps + 1, dtype=torch.float64)
        target = self.target.expand(len(time), 3)
        parts = (
            Part("sphere", "rubber", flight, (self.ball.radius,)),
            Part("trail", "rubber", flight, (self.ball.radius / 8,)),
            Part("sphere", "target", target[:, None], (self.ball.radius,)),
        )
        return Episode(time, {"ball": flight}, {"target": target}, parts, VIEW)

    @property
    def target(self) -> Float[Tensor, " 3"]:
        """Where the ball is wanted [m]."""
        o = self.options
        return torch.tensor([o.target_x, o.target_y, o.target_z], dtype=torch.float64)

    def _setup(self) -> None:
        o = self.options
        self.ball = Ball(radius=0.1, mass=1.0, gravity=9.8, ke=o.ke, kd=o.kd, kf=o.kf, mu=o.mu)
        self._capacity = 256 if self.device == "cpu" else self.preferred_batch
        settings: dict[str, Any] = {"dt": self.fidelity.dt, "steps": self.steps, "name": self.fidelity.precision}
        self._solvers = Pool(partial(Solver, self.ball, capacity=self._capacity, device=self.device, **settings))

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        with self._solvers.lend() as solver:
            miss = solver.run(torch.tensor(START), x)[-1].cpu().double() - self.target
            slope = solver.gradient(2 * miss) if grad else None
        return Evaluation(miss.square().sum(dim=1), slope, torch.full((len(x),), Status.OK, dtype=torch.int8))

    def _energy(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step"]:
        """Return kinetic and potential energy of each flight, that of the ground's spring included."""
        with self._solvers.lend() as solver:
            flight = solver.run(torch.tensor(START), x).double().cpu()
        ball, speed = self.ball, flight.diff(dim=0) / self.fidelity.dt  # semi-implicit Euler: the step's own
        height = flight[1:, :, 1] - ball.radius
        spring = ball.ke / 2 * height.clamp(max=0.0).square()
        found: Tensor = ball.mass / 2 * speed.square().sum(dim=2) + ball.mass * ball.gravity * height + spring
        return found.T
