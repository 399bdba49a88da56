"""Scenes of Newton: a sphere in free flight, balls that bounce, two with a closed form, a cloth that bounces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes.episode import Part
from ...landscapes.space import ParameterSpace
from .. import closed_forms
from ..base import Fidelity
from ..closed_forms import RADIUS, WALL
from ..collisions import TARGET, missed
from ..records import EpisodeOptions
from .scene import NewtonOptions, NewtonScene, speeds

MASS = 1.0  # of the ball [kg]


class Flight(NewtonScene):
    """Throw a sphere so that it is at the target after 0.5 s; it touches nothing.

    Model: Newton's. A rigid sphere of radius 1 m and mass 1 kg starts from (0, 1, 0) m and falls freely; dt 1/240 s at
    standard, float32.
    Parameters: initial velocity x, y, z [m/s], y upwards.
    Loss: squared distance of its centre to the target (1, 1, 0) m at the end [m^2]. The derivative of its final
    position by the velocity is T, its flight time, for every solver. The scene exists to test solvers against that.
    """

    name = "newton-flight"
    duration: ClassVar[float] = 0.5
    target: ClassVar[tuple[float, float, float]] = (1.0, 1.0, 0.0)
    rows: ClassVar[int] = 64
    bytes_per_step: ClassVar[dict[str, int]] = {"semi-implicit": 1000, "featherstone": 3700, "xpbd": 2100}
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=1 / 120),
        "standard": Fidelity("standard", dt=1 / 240),
    }
    space = speeds(5.0)

    def _thing(self) -> Any:
        return self._engine("rollout").Sphere((0.0, 1.0, 0.0), 1.0, 1.0, joined=self.options.solver == "featherstone")


@dataclass(frozen=True)
class BallOptions(NewtonOptions):
    """Contact: stiffness `ke` [N/m], damping `kd` and viscous friction `kf` [N s/m], Coulomb's `mu`.

    solver=xpbd has `restitution` instead of the first three.
    """

    ke: float = 1e4
    kd: float = 10.0
    kf: float = 1e3
    mu: float = 0.25
    restitution: float = 0.91


class Ball(NewtonScene):
    """Throw a ball so that it is at the target after 2 s and a bounce off the ground, as in `bounce`, by Newton.

    Model: Newton's. A particle of radius 0.1 m and mass 1 kg flies from (-0.5, 1, 0) m under gravity. The ground y = 0
    pushes back by Newton's contact of particles with the constants of `bounce`; dt 1/480 s at standard, float32.
    Parameters: initial velocity x, y, z [m/s], y upwards, as in `bounce`.
    Loss: squared distance of the ball's centre to the target (2, 1, 0) m after 2 s [m^2].
    Source: Newton's example `diffsim_ball`, without its wall.
    """

    name = "newton-ball"
    duration: ClassVar[float] = 2.0
    target: ClassVar[tuple[float, float, float]] = (2.0, 1.0, 0.0)
    rows: ClassVar[int] = 256
    bytes_per_step: ClassVar[dict[str, int]] = {"semi-implicit": 160, "featherstone": 160, "xpbd": 570}
    contact_stiffness: ClassVar[str] = "ke"
    Options: ClassVar[type[Any]] = BallOptions
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=1 / 320),
        "standard": Fidelity("standard", dt=1 / 480),
    }
    examples: ClassVar[dict[str, tuple[float, ...]]] = {"aim": (6.12, -9.68, 0.0)}
    space = speeds(10.0)

    def _thing(self) -> Any:
        return self._engine("rollout").Particle((-0.5, 1.0, 0.0), 0.1, MASS)

    def _ground(self) -> Any:
        o = self.options
        stopping = MASS / self.fidelity.dt  # more would turn sliding round within a step, and shake it
        return self._engine("rollout").Ground(o.ke, o.kd, min(o.kf, stopping), o.mu, o.restitution)


@dataclass(frozen=True)
class ClothOptions(NewtonOptions):
    """`solver`: the Newton solver that makes the steps; featherstone has no cloth solver of its own."""

    solver: Literal["semi-implicit", "xpbd"] = "semi-implicit"


class ClothThrow(NewtonScene):
    """Throw a cloth so that its middle is at the target after 0.75 s and a bounce off an elastic floor.

    Model: Newton's. A square of 0.5 m and 0.1 kg, 6 x 6 cells of particles and springs (50 N/m), starts tilted 1 m
    above the floor y = 0. The floor pushes back (100 N/m per particle, no damping) and has friction (0.3); dt 1/1600 s
    at standard, float32. With solver=xpbd it does not bounce, because restitution is zero there; a restitution of 1
    changes little except the gradients.
    Parameters: initial velocity x, y, z of the whole cloth [m/s], y upwards.
    Loss: squared distance of the mean of its particles to the target (1, 0.5, 0) m at the end [m^2].
    Source: Newton's example `diffsim_cloth`, with springs and a floor instead of triangles and air.
    """

    name = "newton-cloth"
    duration: ClassVar[float] = 0.75
    target: ClassVar[tuple[float, float, float]] = (1.0, 0.5, 0.0)
    rows: ClassVar[int] = 16
    bytes_per_step: ClassVar[dict[str, int]] = {"semi-implicit": 5200, "xpbd": 29000}
    Options: ClassVar[type[Any]] = ClothOptions
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=1 / 800),
        "standard": Fidelity("standard", dt=1 / 1600),
    }
    space = speeds(2.0)

    def _thing(self) -> Any:
        return self._engine("rollout").Cloth(
            (-0.25, 1.0, -0.25), side=0.5, cells=6, tilted=math.pi / 3, mass=0.1, radius=0.01, ke=50.0, kd=0.02
        )

    def _ground(self) -> Any:
        return self._engine("rollout").Ground(ke=100.0, kd=0.0, kf=1.0, mu=0.3, restitution=0.0)

    def _parts(self, at: Float[Tensor, "frame point 3"]) -> tuple[Part, ...]:
        with self._solvers.lend() as rollout:
            faces = rollout.faces
        return (Part("sheet", "cloth", at, (0.01,), faces=faces),)


@dataclass(frozen=True)
class ImpactOptions(EpisodeOptions):
    """`solver`: the Newton solver that makes the steps; featherstone uses semi-implicit for particles."""

    solver: Literal["semi-implicit", "xpbd"] = "semi-implicit"


class ImpactScene(NewtonScene):
    """A ball in an upright plane, whose initial position and velocity are the parameters, as in the scene it names.

    Model: Newton's. A particle of radius 0.1 m and mass 1 kg. Ground and wall push back by Newton's contact of
    particles with stiffness 1e4 N/m, or with a restitution under xpbd, without friction; dt 1/480 s at standard,
    float32.
    Parameters: initial position x, y [m] and velocity x, y [m/s], y upwards.
    """

    middle: ClassVar[tuple[float, float]]
    damping: ClassVar[float]
    restitution: ClassVar[float]
    wall: ClassVar[float | None] = None
    rows: ClassVar[int] = 256
    bytes_per_step: ClassVar[dict[str, int]] = {"semi-implicit": 160, "xpbd": 570}
    Options: ClassVar[type[Any]] = ImpactOptions
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=1 / 320),
        "standard": Fidelity("standard", dt=1 / 480),
    }

    @property
    def time(self) -> float:
        """Duration of an episode [s]."""
        return self.steps * self.fidelity.dt

    def _thing(self) -> Any:
        return self._engine("rollout").Particle((*self.middle, 0.0), RADIUS, MASS)

    def _ground(self) -> Any:
        return self._engine("rollout").Ground(1e4, self.damping, 0.0, 0.0, self.restitution, self.wall)

    def _start(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch start"]:
        none = torch.zeros_like(x[:, :1])
        return torch.cat([x[:, 2:], none, x[:, :2] - x.new_tensor(self.middle), none], dim=1)

    def _slope(self, start: Float[Tensor, "batch start"]) -> Float[Tensor, "batch dim"]:
        return torch.cat([start[:, 3:5], start[:, :2]], dim=1)


class NewtonBounceOnce(ImpactScene):
    """Let a ball bounce off the elastic ground once, as in `bounce-once`, by Newton, without gravity.

    Loss: height of the ball's centre after 1 s [m].
    """

    name = "newton-bounce-once"
    duration: ClassVar[float] = 1.0
    gravity: ClassVar[float] = 0.0
    target: ClassVar[tuple[float, float, float]] = (1.0, 0.0, 0.0)
    middle: ClassVar[tuple[float, float]] = (-1.0, 1.0)
    damping: ClassVar[float] = 0.0
    restitution: ClassVar[float] = 1.0
    loss_unit = "m"
    space = ParameterSpace(
        {
            "position x": (-1.5, -0.5, "m"), "position y": (0.6, 1.4, "m"),
            "velocity x": (1.0, 3.0, "m/s"), "velocity y": (-3.5, -0.5, "m/s"),
        }
    )  # fmt: skip

    def _loss(self, end: Float[Tensor, "batch point 3"]) -> Float[Tensor, " batch"]:
        return end[:, 0, 1]

    def _adjoint(self, end: Float[Tensor, "batch point 3"]) -> Float[Tensor, "batch point 3"]:
        return end.new_tensor([0.0, 1.0, 0.0]).expand_as(end)

    def _closed_form(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        return closed_forms.bounce_once(x[:, 1], x[:, 3], torch.zeros_like(x[:, 1]), self.time)


class NewtonGroundWall(ImpactScene):
    """Throw a ball at the ground and a wall, as in `ground-wall`, by Newton, so that it comes back to the target.

    Loss: squared distance of the ball's centre to (-2, 1.5) m after 0.6 s [m²]. The semi-implicit solver damps the
    approach with 10 N s/m, so that the rebound has 0.92 times the speed.
    """

    name = "newton-ground-wall"
    duration: ClassVar[float] = 0.6
    target: ClassVar[tuple[float, float, float]] = (*TARGET, 0.0)
    middle: ClassVar[tuple[float, float]] = (-0.5, 1.0)
    damping: ClassVar[float] = 10.0
    restitution: ClassVar[float] = closed_forms.LIVELY
    wall: ClassVar[float | None] = WALL
    space = ParameterSpace(
        {
            "position x": (-0.9, -0.1, "m"), "position y": (0.6, 1.4, "m"),
            "velocity x": (1.0, 9.0, "m/s"), "velocity y": (-8.0, -2.0, "m/s"),
        }
    )  # fmt: skip

    def _closed_form(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        return missed(closed_forms.ground_wall(x[:, :2], x[:, 2:], torch.zeros_like(x[:, :2]), self.time))
