"""An object that Newton throws: the parameters are its velocity, the loss is its final distance from a target."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes.episode import Part, View
from ...landscapes.objective import Evaluation
from ...landscapes.sampling.memory import Pool
from ...landscapes.space import ParameterSpace
from ..base import Environment, Episode, Work
from ..records import EpisodeOptions

GRAVITY = 9.8  # [m/s^2]
FRAMES = 240  # of an episode that is drawn, at most
MARK = 0.1  # radius of the target that is drawn [m]
BUDGET = 1 << 28  # bytes of the states that are kept for the tape
SPEED = ("velocity x", "velocity y", "velocity z")


@dataclass(frozen=True)
class NewtonOptions(EpisodeOptions):
    """`solver`: the Newton solver that makes the steps."""

    solver: Literal["semi-implicit", "featherstone", "xpbd"] = "semi-implicit"


class NewtonScene(Environment):
    """An object that Newton throws at a target.

    A scene derives from this class and defines: `duration` [s], the `target` [m], `rows`, the most episodes to simulate
    at once, the thrown object (`_thing`), and the ground (`_ground`). The engine computes in float32. Its tape supplies
    the gradients, right or wrong. A row whose end or gradient is not finite has failed.
    """

    model_version = 1
    duration: ClassVar[float]
    gravity: ClassVar[float] = GRAVITY  # [m/s^2]
    target: ClassVar[tuple[float, float, float]]
    rows: ClassVar[int]
    bytes_per_step: ClassVar[dict[str, int]]  # of a row, by solver: states with their adjoints, and what steps allocate
    engines: ClassVar[tuple[str, ...]] = ("newton",)
    whole_batches = True  # one point costs as much as a batch
    loss_unit = "m²"
    Options: ClassVar[type[Any]] = NewtonOptions
    _solvers: Pool[Any]

    @property
    def steps(self) -> int:
        """Number of time steps of an episode."""
        count: int = self.options.count_steps(round(self.duration / self.fidelity.dt))
        return count

    def memory(self) -> int:
        """Estimate the bytes one episode takes while it runs: the tape needs every state."""
        return (self.steps + 1) * self.bytes_per_step[self.options.solver]

    def work(self) -> Work:
        """Count steps of the object."""
        return Work(self.steps, "body-step")

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return the positions of the object during the episode at one point."""
        with self._solvers.lend() as rollout:
            frames = rollout.frames(self._start(self._row(x)))[:, 0]
        shown = torch.linspace(0, len(frames) - 1, min(FRAMES, len(frames))).round().long()
        at = frames[shown]
        target = torch.tensor(self.target, dtype=torch.float64).expand(len(at), 3)
        parts = (*self._parts(at), Part("sphere", "target", target[:, None], (MARK,)))
        everything = torch.cat([at, target[:, None]], dim=1)
        room = self._thing().radius + 2 * MARK
        lower, upper = everything.amin(dim=(0, 1)) - room, everything.amax(dim=(0, 1)) + room
        view = View(tuple(lower.tolist()), tuple(upper.tolist()), ground=None if self._ground() is None else 0.0)
        return Episode(self.fidelity.dt * shown, {"thing": at}, {"target": target}, parts, view)

    @abc.abstractmethod
    def _thing(self) -> Any:
        """Return the thrown object: the engine's Sphere, Particle or Cloth."""

    def _ground(self) -> Any:
        """Return the engine's Ground, or None where there is none."""
        return None

    def _parts(self, at: Float[Tensor, "frame point 3"]) -> tuple[Part, ...]:
        """Return the parts to draw."""
        radius = self._thing().radius
        return Part("sphere", "rubber", at, (radius,)), Part("trail", "rubber", at, (radius / 8,))

    def _setup(self) -> None:
        if self.fidelity.precision != "float32":
            raise ValueError(
                f"{self.name} runs on Newton, which computes in float32 only; got precision {self.fidelity.precision!r}"
            )
        engine = self._engine("rollout")
        self._capacity = max(1, min(self.rows, self._max_rows, BUDGET // self.memory()))
        settings = engine.Settings(self.fidelity.dt, self.steps, self.gravity, self.options.solver, self._capacity)
        self._solvers = Pool(partial(engine.Rollout, self._thing(), self._ground(), settings), most=1)

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        with self._solvers.lend() as rollout:
            if not grad:
                return Evaluation.from_results(self._loss(rollout.ends(self._start(x))[: len(x)]), None)
            end, slope = rollout.pull_back(self._start(x), self._adjoint)
        return Evaluation.from_results(self._loss(end[: len(x)]), self._slope(slope))

    def _start(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch start"]:
        """Return velocities [m/s], and initial displacements of particles [m] where parameters set them."""
        return x

    def _slope(self, start: Float[Tensor, "batch start"]) -> Float[Tensor, "batch dim"]:
        """Return the gradient by parameters from the gradient by initial states."""
        return start

    def _loss(self, end: Float[Tensor, "batch point 3"]) -> Float[Tensor, " batch"]:
        """Return the squared distance to the target [m^2]."""
        return self._miss(end).square().sum(dim=1)

    def _miss(self, end: Float[Tensor, "batch point 3"]) -> Float[Tensor, "batch 3"]:
        """Return the distance vector from the target to the mean of the points [m]."""
        return end.mean(dim=1) - torch.tensor(self.target, dtype=torch.float64)

    def _adjoint(self, end: Float[Tensor, "batch point 3"]) -> Float[Tensor, "batch point 3"]:
        """Return the loss's gradient by the positions of the points."""
        return (2 / end.shape[1] * self._miss(end))[:, None].expand_as(end)


def speeds(bound: float) -> ParameterSpace:
    """Return the space of velocities along x, y and z up to a bound [m/s]."""
    return ParameterSpace({name: (-bound, bound, "m/s") for name in SPEED})
