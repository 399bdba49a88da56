"""The Bounce scene: throw a ball so that it hits a target after a bounce off the ground."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..landscapes.episode import Part, View
from ..landscapes.objective import Evaluation, Status
from ..landscapes.options import added
from ..landscapes.sampling.memory import Pool
from ..landscapes.space import ParameterSpace
from .base import Environment, Episode, Fidelity, MaterialRange, ModelPart, Work, copied
from .engines.balls.rigid import Ball, Solver
from .engines.runtime import to_torch
from .records import EpisodeOptions

START = (-0.5, 1.0, 0.0)  # [m]
DURATION = 2.0  # [s]
RADIUS, MASS, GRAVITY, AIR = 0.1, 1.0, 9.8, 1.2  # [m], [kg], [m/s^2], density of the air [kg/m^3]
SPHERE = 2.5  # mass radius^2 / inertia
VIEW = View((-0.8, 0.0, -0.7), (2.6, 5.1, 0.7), eye=(0.1, 0.25, 1.0))


@dataclass(frozen=True)
class BounceOptions(EpisodeOptions):
    """Contact: stiffness `ke` [N/m], damping `kd` and viscous friction `kf` [N s/m], Coulomb's `mu`.

    `contacts`: step applies the ground's force in whole time steps, as Warp does. touch splits the step at the time of
    touch. smooth lets damping grow with depth, up to kd at 2.5 cm. `spin`: friction spins the ball, a solid sphere that
    starts without spin. `drag`: drag coefficient in air (1.2 kg/m^3); a smooth sphere has 0.47. The target is at
    (`target_x`, `target_y`, `target_z`) [m]. `downward`: only throws downwards, with a vertical velocity from -10 to 0
    m/s.
    """

    contacts: Literal["step", "touch", "smooth"] = "step"
    spin: bool = False
    drag: float = 0.0
    ke: float = 1e4
    kd: float = 10.0
    kf: float = 1e3
    mu: float = 0.25
    target_x: float = 2.0
    target_y: float = 1.0
    target_z: float = 0.0
    downward: bool = added(False)


def _velocities(*, highest: float) -> ParameterSpace:
    """Return the box of velocities with an upper bound on the vertical one [m/s]."""
    lower, upper = (torch.tensor(end, dtype=torch.float64) for end in ((-10.0, -10.0, -10.0), (10.0, highest, 10.0)))
    return ParameterSpace(("velocity x", "velocity y", "velocity z"), lower, upper, ("m/s",) * 3)


class Bounce(Environment):
    """Throw a ball so that it hits the target after 2 s and a bounce off the ground.

    Model: a ball of radius 0.1 m and mass 1 kg flies from (-0.5, 1, 0) m under gravity. The ground y = 0 pushes back by
    Warp's relaxed contact: penalty stiffness 1e4 N/m, damping 10 N s/m during approach, and friction. Semi-implicit
    Euler, dt 1/480 s at standard.
    Parameters: initial velocity x, y, z [m/s].
    Loss: squared distance from the ball's centre to the target (2, 1, 0) m at the end, after 2 s [m^2]. One bounce is
    enough to reach the target (example `aim`).
    Gradients: exact for the program, not for the model. At touch, damping makes the force jump from 0 to kd |v|, and
    whole time steps do not differentiate the time of touch. So d loss / d vy converges to the gradient of a motion with
    a fixed time of touch. Against the model, its median relative error is 8.0, 7.2, 7.9 at steps of 1/480, 1/3840,
    1/30720 s. Its sign is right in 61, 57, 57 % of 23 throws that bounce. contacts=touch splits the step at the time of
    touch (errors 0.37, 0.24, 0.023). contacts=smooth lets damping grow with depth (2.8, 0.29, 0.026). Both converge at
    first order, and their signs end up right in 100 % of the throws. At 1/480 s contacts=touch has less accurate losses
    than the default, but more accurate gradients. The default keeps the paper's contact, because the scene is about its
    landscape.
    Simplifications: the ball does not spin (option), because the paper's contact is a point contact. There is no air
    (option). There is no wall, because the policy has to use the ground. Viscous friction is capped so that a step
    cannot reverse sliding.
    Preset paper: the supplement restricts the velocities to a downward cone without giving its width. The preset takes
    the widest (downward=true). The paper's figure 8 nevertheless shows -10 to 10 m/s, as the default does.
    Source: task Bounce of "Rethinking Optimization with Differentiable Simulation from a Global Perspective" (CoRL
    2022), appendix B.1; contact constants from NVIDIA Warp's bounce example.
    """

    model_version = 1
    name = "bounce"
    devices: ClassVar[tuple[str, ...]] = ("cpu", "cuda")
    beyond_box = True
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=1 / 320),
        "standard": Fidelity("standard", dt=1 / 480),
        "reference": Fidelity("reference", dt=1 / 7680, precision="float64"),
    }
    loss_unit = "m²"
    model_parts: ClassVar[tuple[ModelPart, ...]] = (
        ModelPart("friction", {"mu": 0.0, "kf": 0.0}, "a smooth ground"),
        ModelPart("damping", {"kd": 0.0}, "an elastic ground"),
        ModelPart("jump at touch", {"contacts": "smooth"}, "damping grows with depth"),
        ModelPart("time of touch", {"contacts": "touch"}, "a step split at the touch", missing=True),
        ModelPart("spin", {"spin": True}, "friction spins the ball", missing=True),
        ModelPart("drag", {"drag": 0.47}, "drag of the air", missing=True),
    )
    contact_stiffness: ClassVar[str] = "ke"
    designed_order: ClassVar[dict[str, float]] = {"dt": 1.0}  # semi-implicit Euler
    material_range: ClassVar[MaterialRange] = MaterialRange("ke", 1e3, 1e5)  # a tenth and ten times the default
    Options: ClassVar[type[Any]] = BounceOptions
    examples: ClassVar[dict[str, tuple[float, ...]]] = {"aim": (6.12, -9.68, 0.0)}
    _solvers: Pool[Solver]
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"paper": {"downward": True}}
    space = _velocities(highest=10.0)

    @property
    def preferred_batch(self) -> int:  # type: ignore[override] # read only
        """Number of points worth evaluating at once."""
        return 512 if self.device == "cpu" else 1 << 16

    @property
    def steps(self) -> int:
        """Number of time steps of an episode."""
        steps: int = self.options.count_steps(round(DURATION / self.fidelity.dt))
        return steps

    def memory(self) -> int:
        """Estimate the bytes one episode takes while it runs."""
        return (self.steps + 1) * 6 * 3 * (8 if self.fidelity.precision == "float64" else 4)

    def work(self) -> Work:
        """Count steps of the ball."""
        return Work(self.steps, "body-step")

    def bounces(self, x: Float[Tensor, "batch 3"]) -> Int[Tensor, " batch"]:
        """Count how often each ball leaves the ground, in a flight whose steps are split at the time of touch.

        In whole steps, the count would depend on how deep a step happens to end. As the vertical velocity crosses its
        box at `aim`, it would then change 401 times instead of 7.
        """
        counts = []
        for part in torch.split(self._check_points(x), self._capacity):
            with self._counting.lend() as solver:
                inside = solver.run(torch.tensor(START), part)[:, :, 1].cpu() < self.ball.radius
            counts.append((inside[:-1] & ~inside[1:]).sum(dim=0))
        return torch.cat(counts) if counts else torch.zeros(0, dtype=torch.int64)

    def events(self, x: Float[Tensor, "batch dim"]) -> Mapping[str, Int[Tensor, " batch"]]:
        """Count the bounces of each flight."""
        return {"bounces": self.bounces(x)}

    def replicas(self) -> Mapping[str, Environment]:
        """Return the flight in slightly shorter time steps, which moves a bounce within its step."""
        return self._replicas_of(self._shorter_steps(round(DURATION / self.fidelity.dt)))

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return the ball's flight."""
        (row,) = self._row(x)
        with self._solvers.lend() as solver:
            flight = copied(solver.run(torch.tensor(START), row[None]))
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
        """Position of the target [m]."""
        o = self.options
        return torch.tensor([o.target_x, o.target_y, o.target_z], dtype=torch.float64)

    def _setup(self) -> None:
        o = self.options
        if o.downward:
            self.space = _velocities(highest=0.0)
        parts = {"drag": o.drag * AIR * math.pi * RADIUS**2 / 2, "turning": SPHERE if o.spin else 0.0}
        self.ball = Ball(RADIUS, MASS, GRAVITY, ke=o.ke, kd=o.kd, kf=o.kf, mu=o.mu, **parts)
        self._capacity = 256 if self.device == "cpu" else self.preferred_batch
        settings: dict[str, Any] = {"dt": self.fidelity.dt, "steps": self.steps, "name": self.fidelity.precision}
        settings |= {"capacity": self._capacity, "device": self.device, "contacts": o.contacts}
        self._solvers = Pool(partial(Solver, self.ball, **settings))
        exact = {**settings, "contacts": "touch"}
        self._counting = Pool(partial(Solver, self.ball, **exact)) if o.contacts == "step" else self._solvers

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        with self._solvers.lend() as solver:
            miss = solver.run(torch.tensor(START), x)[-1].cpu().double() - self.target
            slope = solver.gradient(2 * miss) if grad else None
        return Evaluation(miss.square().sum(dim=1), slope, torch.full((len(x),), Status.OK, dtype=torch.int8))

    def _energy(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step"]:
        """Return kinetic and potential energy of each flight, including the energy of the ground's spring."""
        with self._solvers.lend() as solver:
            flight = copied(solver.run(torch.tensor(START), x))
            roll = copied(to_torch(solver.roll)[1:, : len(x)])
        ball, speed = self.ball, flight.diff(dim=0) / self.fidelity.dt  # semi-implicit Euler: the step's own
        height = flight[1:, :, 1] - ball.radius
        spring = ball.ke / 2 * height.clamp(max=0.0).square()
        motion = speed.square().sum(dim=2) + roll.square().sum(dim=2) / SPHERE
        found: Tensor = ball.mass / 2 * motion + ball.mass * ball.gravity * height + spring
        return found.T
