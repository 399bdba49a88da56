"""Common parts of the sheet scenes (cloth, pancake): a mass-spring sheet, its drive, and its final losses."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes.episode import Part, View
from ...landscapes.objective import Evaluation, Status
from ...landscapes.sampling.memory import Pool
from ..base import Environment, Episode, Work, copied
from ..controls import describe_motion, watch
from ..engines.sheets.contact import Rule
from ..engines.sheets.springs import Sheet, Solver, capacity
from ..records import EpisodeOptions

FRAME = 0.01  # between the frames of an episode [s]
REACH = 0.1  # what a policy measures lengths by [m]


@dataclass(frozen=True, eq=False)
class Drive:
    """What the parameters set: initial `velocity` [m/s], vertex `stiffness` [N/m], `poses` of the surface."""

    velocity: Float[Tensor, "batch 3"]
    stiffness: Float[Tensor, "batch vertex"]
    poses: Float[Tensor, "batch step_plus_1 3"]

    def detach(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return all three without their history."""
        return self.velocity.detach(), self.stiffness.detach(), self.poses.detach()


@dataclass(frozen=True)
class SheetOptions(EpisodeOptions):
    """`contact`: which vertices a surface stops, and thus how exactly they stop at the surface.

    `end`: vertices that would be inside at the end of a step end on the surface. `start`: vertices that are inside at
    the start of a step stop at their depth, so losses jump by the distance a vertex moves in a step.
    """

    contact: Rule = dataclasses.field(default="end", kw_only=True)


class SheetScene(Environment):
    """A sheet is a square lattice of vertices joined by damped springs, integrated by semi-implicit Euler.

    Springs run along the lattice and along its diagonals. The weight of vertices and springs is their share of the
    area, so meshes of different resolutions are one material. A vertex that would be inside a surface at the end of a
    step is stopped on it. It loses the velocity into the surface, v -= min(v.n, 0) n, and keeps the rest. There is no
    restitution, and no friction unless an option sets it. Sheets pass through themselves.
    """

    model_version = 1
    devices: ClassVar[tuple[str, ...]] = ("cpu", "cuda")
    beyond_box = True
    engines: ClassVar[tuple[str, ...]] = ("warp", "taichi")
    loss_unit = "m"
    designed_order: ClassVar[dict[str, float]] = {"dt": 1.0, "resolution": 2.0, "joint": 1.0}  # Euler; springs
    Options: ClassVar[type[Any]] = SheetOptions
    duration: ClassVar[float]  # of an episode of horizon 1 [s]
    surface: Any  # a Surface: the solver's
    view: ClassVar[View]
    sheet: Sheet
    _solvers: Pool[Solver]

    @property
    def own_steps(self) -> int:
        """Number of time steps of an episode of horizon 1."""
        return round(self.duration / self.fidelity.dt)

    @property
    def steps(self) -> int:
        """Number of time steps of an episode."""
        steps: int = self.options.count_steps(self.own_steps)
        return steps

    def memory(self) -> int:
        """Estimate the bytes one episode takes while it runs."""
        size: int = self._engine("springs").bytes_per_row(self.sheet, self.steps, self.fidelity.precision)
        return size

    def work(self) -> Work:
        """Count steps of vertices."""
        return Work(len(self.sheet.x) * self.steps, "vertex-step")

    def replicas(self) -> Mapping[str, Environment]:
        """Return the sheet in slightly shorter time steps, which moves its contacts within their steps.

        Its mesh has both diagonals in every cell, so its mirror image is the same mesh.
        """
        return self._replicas_of(self._shorter_steps(self.own_steps))

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return the sheet and its surroundings every hundredth of a second, and at the end."""
        drive = self._drive(self._row(x))
        shown = torch.arange(0, self.steps + 1, max(1, round(FRAME / self.fidelity.dt)))
        if shown[-1] != self.steps:
            shown = torch.cat([shown, shown.new_tensor([self.steps])])
        with self._solvers.lend() as solver:
            frames = copied(solver.run(*drive.detach())[shown, 0])
        poses = drive.poses[0, shown].detach()
        parts = self._parts(frames, poses)
        return Episode(self.fidelity.dt * shown, {"sheet": frames}, self._surroundings(poses), parts, self.view)

    def end(self, x: Float[Tensor, " dim"]) -> Float[Tensor, "vertex 3"]:
        """Return vertex positions at the end of the episode at one point [m]."""
        with self._solvers.lend() as solver:
            return copied(solver.run(*self._drive(self._row(x)).detach())[-1, 0])

    @abc.abstractmethod
    def _sheet(self) -> Sheet:
        """Return the sheet at this fidelity."""

    @abc.abstractmethod
    def _drive(self, x: Float[Tensor, "batch dim"]) -> Drive:
        """Return the quantities that the parameters set, differentiably."""

    @abc.abstractmethod
    def _loss(self, end: Float[Tensor, "vertex 3"]) -> Float[Tensor, ""]:
        """Return the loss of one episode from its final vertex positions."""

    @abc.abstractmethod
    def _surroundings(self, poses: Float[Tensor, "frame 3"]) -> Mapping[str, Float[Tensor, "frame 3"]]:
        """Return the solids around the sheet, from the surface's poses."""

    @abc.abstractmethod
    def _parts(self, frames: Float[Tensor, "frame vertex 3"], poses: Float[Tensor, "frame 3"]) -> tuple[Part, ...]:
        """Return the parts to draw."""

    def _setup(self) -> None:
        self.sheet = self._sheet()
        self._capacity = self._limit_rows(capacity(self.memory(), self.device))
        self._solvers = Pool(
            partial(
                self._engine("springs").Solver,
                self.sheet,
                self.surface,
                dt=self.fidelity.dt,
                steps=self.steps,
                name=self.fidelity.precision,
                capacity=self._capacity,
                device=self.device,
                stop=self._stop,
                rule=self.options.contact,
            )
        )

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        x = x.clone().requires_grad_(grad)
        drive = self._drive(x)
        with self._solvers.lend() as solver:
            end = copied(solver.run(*drive.detach())[-1]).requires_grad_(grad)
            loss = torch.stack([self._loss(row) for row in end])  # by row: batched sums round as the batch is split
            slope = self._pull_back(solver, loss, end, drive, x) if grad else None
        return Evaluation(loss.detach(), slope, torch.full((len(x),), Status.OK, dtype=torch.int8))

    def _observe(self, x: Float[Tensor, "batch dim"], decision: int) -> Float[Tensor, "batch feature"]:
        """Observe the sheet in tenths of a metre, with its surface's pose."""
        if self.decisions == 1:
            return super()._observe(x, decision)
        drive, step = self._drive(x), decision * self.steps // self.decisions
        with self._solvers.lend() as solver:
            frames = copied(solver.run(*drive.detach()))
        seen = [
            torch.cat([watch(frames[k], [frames.shape[2]]), drive.poses[:, k, None]], dim=1)
            for k in (0, max(0, step - 1), step)
        ]
        return describe_motion(*seen, scale=REACH, intervals=self.steps // self.decisions)

    def _pull_back(self, solver: Solver, loss: Tensor, end: Tensor, drive: Drive, x: Tensor) -> Tensor:
        (adj_end,) = torch.autograd.grad(loss.sum(), end)
        driven = zip((drive.velocity, drive.stiffness, drive.poses), solver.gradient(adj_end), strict=True)
        changes = [(part * adjoint.to(part)).sum() for part, adjoint in driven if part.requires_grad]
        change = torch.stack(changes).sum()
        (slope,) = torch.autograd.grad(change, x)
        return slope
