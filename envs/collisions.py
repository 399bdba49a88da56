"""Three scenes of colliding balls in a plane, whose losses and gradients have a closed form."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from ..landscapes.episode import Part, View
from ..landscapes.objective import Evaluation
from ..landscapes.space import ParameterSpace
from . import closed_forms
from .base import Environment, Episode, Fidelity, ModelPart, Work
from .closed_forms import GRAVITY, HELD, LIVELY, RADIUS, REACH, WALL
from .engines.balls.collisions import Contacts, Table, Wall, run
from .records import EpisodeOptions

TARGET = (-2.0, 1.5)  # of ground-wall [m]
PRICE = 0.1  # of two-balls: what its push costs, by the square of it and by time
FRAMES = 120  # of an episode that is drawn
ROWS = 256
FLOOR = Wall((0.0, 1.0), 0.0)

Places = Float[Tensor, "batch disc 2"]
Pushes = list[tuple[Places, float]]


@dataclass(frozen=True)
class CollisionOptions(EpisodeOptions):
    """`contacts`: touch finds the time of each touch and differentiates it.

    step reflects velocities in whole steps, as many simulators do. shift corrects positions by the time of touch but
    not velocities, as DiffTaichi does.
    """

    contacts: Contacts = "touch"


class CollisionScene(Environment):
    """Model: balls of 1 kg in an upright plane, without friction and air; impacts are instantaneous.

    With contacts=touch flights are parabolas and the time of each touch is exact up to rounding. The step only sets how
    finely touches are searched for. contacts=step and shift use semi-implicit Euler, dt 1/480 s. There, gradients of
    the program do not converge to those of the model.
    Source: Zhong, Han and Brikis 2022 (arXiv 2207.05060). The numbers of the scene are theirs, and the centre of the
    box is their starting point.
    """

    model_version = 1
    engines: ClassVar[tuple[str, ...]] = ("torch",)
    fidelities: ClassVar[dict[str, Fidelity]] = {"standard": Fidelity("standard", dt=1 / 480, precision="float64")}
    Options: ClassVar[type[CollisionOptions]] = CollisionOptions
    loss_unit = "m²"
    model_parts: ClassVar[tuple[ModelPart, ...]] = ()
    duration: ClassVar[float]
    table: ClassVar[Table]

    @abc.abstractmethod
    def _start(self, x: Float[Tensor, "batch dim"]) -> tuple[Places, Places, Pushes]:
        """Return the positions, velocities and pushes that the parameters set."""

    @abc.abstractmethod
    def _loss(self, end: Places, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        """Return the loss at the final positions of the balls."""

    @property
    def time(self) -> float:
        """Duration of an episode [s], in whole steps."""
        dt = self.fidelity.dt
        return float(self.options.count_steps(round(self.duration / dt)) * dt)

    @property
    def preferred_batch(self) -> int:  # type: ignore[override] # read only
        """Number of points worth evaluating at once."""
        return ROWS

    def memory(self) -> int:
        """Estimate the bytes of one row: torch keeps every step for differentiation."""
        return round(self.time / self.fidelity.dt) * 600 * self.table.discs

    def work(self) -> Work:
        """Count steps of the balls."""
        return Work(round(self.time / self.fidelity.dt) * self.table.discs, "body-step")

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return the balls' flights."""
        place, speed, pushes = self._start(self._row(x))
        finely = [(push, time / count) for push, time in pushes for count in [_frames(time)] for _ in range(count)]
        frames = run(self.table, place, speed, finely, self.fidelity.dt, self.options.contacts)
        passed = [0.0, *torch.tensor([time for _, time in finely], dtype=torch.float64).cumsum(0).tolist()]
        time = torch.tensor(passed, dtype=torch.float64)
        if self.options.contacts != "touch":
            time = self.fidelity.dt * torch.arange(len(frames), dtype=torch.float64)
        return self._drawn(time, pad(frames[:, 0], (0, 1)))

    def _drawn(self, time: Float[Tensor, " frame"], at: Float[Tensor, "frame disc 3"]) -> Episode:
        radius = self.table.radius
        balls = [
            Part("sphere", "rubber" if k == 0 else "steel", at[:, k : k + 1], (radius,)) for k in range(at.shape[1])
        ]
        trails = [Part("trail", "rubber", at[:, k : k + 1], (radius / 6,)) for k in range(at.shape[1])]
        room, (low, high) = 3 * radius, torch.aminmax(at.flatten(0, 1), dim=0)
        lower, upper = (tuple(float(value) for value in of) for of in (low - room, high + room))
        ground = 0.0 if FLOOR in self.table.walls else None
        view = View((lower[0], lower[1], -room), (upper[0], upper[1], room), eye=(0.1, 0.15, 1.0), ground=ground)
        return Episode(time, {"balls": at}, {}, (*balls, *trails), view)

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        points = x.clone().requires_grad_(grad)
        place, speed, pushes = self._start(points)
        end = run(self.table, place, speed, pushes, self.fidelity.dt, self.options.contacts)[-1]
        loss = self._loss(end, points)
        slope = torch.autograd.grad(loss.sum(), points)[0] if grad else None
        return Evaluation.from_results(loss.detach(), slope)


def _frames(time: float) -> int:
    return max(1, round(FRAMES * time))


def _box(*around: tuple[str, float, float, str]) -> ParameterSpace:
    """Return the parameter space from name, centre, half width and unit of each parameter."""
    return ParameterSpace({name: (middle - half, middle + half, unit) for name, middle, half, unit in around})


class _OneBall(CollisionScene):
    """A ball whose initial position, initial velocity and push over the first 1/480 s are the parameters."""

    control_step: ClassVar[float] = HELD
    fall: ClassVar[float] = 0.0  # gravity [m/s^2]

    def _start(self, x: Float[Tensor, "batch dim"]) -> tuple[Places, Places, Pushes]:
        place, speed, push = x.view(-1, 3, 1, 2).unbind(dim=1)
        gravity = torch.tensor([0.0, -self.fall], dtype=x.dtype).expand_as(push)
        return place, speed, [(push + gravity, HELD), (gravity, self.time - HELD)]


class BounceOnce(_OneBall):
    """Let a ball bounce off the ground once; the loss is its height afterwards.

    Parameters: position x, y [m], velocity x, y [m/s], and a push x, y over the first 1/480 s [m/s²].
    Loss: height of the ball's centre after 1 s [m]. The impact is elastic and there is no gravity, so the height is
    linear in the parameters as long as the ball bounces. Its derivatives are -1 by the initial height, -1 s by the
    vertical velocity, -(1/480 - 1/480²/2) s² by the vertical push, and 0 by all horizontal parameters.
    """

    name = "bounce-once"
    loss_unit = "m"
    duration: ClassVar[float] = 1.0
    table: ClassVar[Table] = Table(RADIUS, 1.0, (FLOOR,))
    space = _box(
        ("position x", -1.0, 0.5, "m"), ("position y", 1.0, 0.4, "m"),
        ("velocity x", 2.0, 1.0, "m/s"), ("velocity y", -2.0, 1.5, "m/s"),
        ("push x", 0.0, 100.0, "m/s²"), ("push y", 0.0, 100.0, "m/s²"),
    )  # fmt: skip

    def _loss(self, end: Places, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        return end[:, 0, 1]

    def _closed_form(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        return closed_forms.bounce_once(x[:, 1], x[:, 3], x[:, 5], self.time)


class GroundWall(_OneBall):
    """Throw a ball at the ground and a wall, so that it comes back to the target.

    Parameters: position x, y [m], velocity x, y [m/s], and a push x, y over the first 1/480 s [m/s²].
    Loss: squared distance of the ball's centre to (-2, 1.5) m after 0.6 s [m²]. Ground (y = 0) and wall (x = 1.75 m)
    reflect with restitution 0.92; gravity is 9.8 m/s².
    """

    name = "ground-wall"
    duration: ClassVar[float] = 0.6
    fall: ClassVar[float] = GRAVITY
    table: ClassVar[Table] = Table(RADIUS, LIVELY, (FLOOR, Wall((-1.0, 0.0), -WALL)))
    space = _box(
        ("position x", -0.5, 0.4, "m"), ("position y", 1.0, 0.4, "m"),
        ("velocity x", 5.0, 4.0, "m/s"), ("velocity y", -5.0, 3.0, "m/s"),
        ("push x", 0.0, 100.0, "m/s²"), ("push y", 0.0, 100.0, "m/s²"),
    )  # fmt: skip

    def _loss(self, end: Places, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        return missed(end[:, 0])

    def _closed_form(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        place, speed, push = x.view(-1, 3, 2).unbind(dim=1)
        return missed(closed_forms.ground_wall(place, speed, push, self.time))


class TwoBalls(CollisionScene):
    """Push a ball against a second one, so that the second one is at the origin after 1 s, at little cost.

    Parameters: position x, y [m] and velocity x, y [m/s] of both, and a constant push x, y on the first [m/s²].
    Loss: squared distance of the second ball to the origin after 1 s [m²], plus 0.1 times the squared push times its
    duration. Radii are 0.2 m, the impact is elastic, and there is no gravity.
    """

    name = "two-balls"
    duration: ClassVar[float] = 1.0
    table: ClassVar[Table] = Table(REACH, 1.0, discs=2)
    space = _box(
        ("position 1 x", -2.0, 0.1, "m"), ("position 1 y", -2.0, 0.1, "m"),
        ("position 2 x", -1.0, 0.1, "m"), ("position 2 y", -1.0, 0.1, "m"),
        ("velocity 1 x", 0.0, 0.2, "m/s"), ("velocity 1 y", 0.0, 0.2, "m/s"),
        ("velocity 2 x", 0.0, 0.2, "m/s"), ("velocity 2 y", 0.0, 0.2, "m/s"),
        ("push x", 3.0, 0.5, "m/s²"), ("push y", 3.0, 0.5, "m/s²"),
    )  # fmt: skip

    def _start(self, x: Float[Tensor, "batch dim"]) -> tuple[Places, Places, Pushes]:
        place, speed = x[:, :4].view(-1, 2, 2), x[:, 4:8].view(-1, 2, 2)
        push = torch.stack([x[:, 8:], torch.zeros_like(x[:, 8:])], dim=1)
        return place, speed, [(push, self.time)]

    def _loss(self, end: Places, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        return end[:, 1].square().sum(dim=1) + self._cost(x)

    def _cost(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        return PRICE * self.time * x[:, 8:].square().sum(dim=1)

    def _closed_form(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        place, speed = x[:, :4].view(-1, 2, 2), x[:, 4:8].view(-1, 2, 2)
        end = closed_forms.two_balls(place, speed, x[:, 8:], self.time)
        return end.square().sum(dim=1) + self._cost(x)


def missed(end: Float[Tensor, "batch 2"]) -> Float[Tensor, " batch"]:
    """Return the squared distance to ground-wall's target [m^2]."""
    return (end - end.new_tensor(TARGET)).square().sum(dim=1)
