"""Three scenes of Newton: a sphere in free flight, a ball that bounces, a cloth that bounces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from jaxtyping import Float
from torch import Tensor

from ...landscapes.episode import Part
from ..base import Fidelity
from .scene import NewtonOptions, NewtonScene, speeds

MASS = 1.0  # of the ball [kg]


class Flight(NewtonScene):
    """Throw a sphere so that it is at the target after 0.5 s; it touches nothing.

    Model: Newton's: a rigid sphere of radius 1 m and mass 1 kg starts from (0, 1, 0) m and falls freely; dt 1/240 s
    at standard, float32.
    Parameters: initial velocity x, y, z [m/s], y upwards.
    Loss: squared distance of its centre to the target (1, 1, 0) m at the end [m^2]. Where it ends has the derivative T
    by the velocity, T being the time it flies, whatever the solver: the scene is there to hold solvers against that.
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
    """Throw a ball so that it is at the target after 2 s, having bounced off the ground, as in `bounce`, by Newton.

    Model: Newton's: a particle of radius 0.1 m and mass 1 kg flies from (-0.5, 1, 0) m under gravity; the ground y = 0
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
    """`solver`: which of Newton's solvers makes the steps; featherstone has none of its own for cloth."""

    solver: Literal["semi-implicit", "xpbd"] = "semi-implicit"


class ClothThrow(NewtonScene):
    """Throw a cloth so that its middle is at the target after 0.75 s, having bounced off an elastic floor.

    Model: Newton's: a square of 0.5 m and 0.1 kg, 6 x 6 cells of particles and springs (50 N/m), starts tilted 1 m over
    the floor y = 0, which pushes back (100 N/m a particle, no damping) and rubs (0.3); dt 1/1600 s at standard,
    float32.
    Under solver=xpbd it does not bounce: there restitution is zero, and one of 1 changes little but the gradients.
    Parameters: initial velocity x, y, z of all of it [m/s], y upwards.
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
