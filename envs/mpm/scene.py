"""Common parts of the MLS-MPM scenes: tools moved by controls, a pool of solvers, losses from particle positions."""

from __future__ import annotations

import abc
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes.episode import Part, View
from ...landscapes.objective import Evaluation, Status
from ...landscapes.sampling.memory import Pool
from ..base import Environment, Episode, Work, copied
from ..controls import describe_motion, watch
from ..engines.mpm.model import Model
from ..engines.mpm.solver import Solver, capacity, memory

SEGMENTS, STEPS = 5, 50  # of the controls; control steps in an episode of horizon 1
SHIFTS = ("shift_x", "shift_y", "shift_z")  # settings of a fidelity: cells that the grid is moved by


@dataclass(frozen=True, eq=False)
class Stage:
    """What one thread simulates with, and what it judges with where a loss takes masses at nodes."""

    solver: Solver
    raster: Any = None


class MpmScene(Environment):  # noqa: D101 -- `about` prints the docstrings of a scene's family, each for its readers
    devices: ClassVar[tuple[str, ...]] = ("cpu", "cuda")
    beyond_box = True
    engines: ClassVar[tuple[str, ...]] = ("warp", "taichi")
    decisions = SEGMENTS
    designed_order: ClassVar[dict[str, float]] = {"dt": 1.0, "resolution": 2.0, "joint": 1.0}  # Euler; splines
    model: Model
    view: View
    _solvers: Pool[Stage]

    def memory(self) -> int:
        """Estimate the bytes one episode takes while it runs."""
        return memory(self.model, self.device)

    def work(self) -> Work:
        """Count substeps of particles."""
        return Work(self.model.particle_substeps, "particle-substep")

    @abc.abstractmethod
    def tools(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step_plus_1 slot 3"]:
        """Return tool positions at the ends of control steps [m]."""

    def end(self, x: Float[Tensor, " dim"]) -> Float[Tensor, "particle 3"]:
        """Return particle positions at the end of the episode at one point [m]."""
        with self._solvers.lend() as stage:
            return copied(stage.solver.run(self.tools(self._row(x)))[0])

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return bodies and tools at the ends of control steps."""
        tools = self.tools(self._row(x))
        with self._solvers.lend() as stage:
            stage.solver.run(tools)
            frames = stage.solver.read_trajectory(0)
        bodies = torch.split(frames, self._sizes, dim=1)
        return Episode(
            self.control_step * torch.arange(self.model.steps + 1, dtype=torch.float64),
            dict(zip(self._body_names(), bodies, strict=True)),
            dict(zip(self._tool_names(), tools[0].unbind(1), strict=True)),
            self._parts(bodies, tools[0]),
            self.view,
        )

    @abc.abstractmethod
    def _model(self) -> Model:
        """Return the model at this fidelity, with these options."""

    @abc.abstractmethod
    def _losses(self, stage: Stage, step: int, end: Tensor, paths: Tensor) -> Float[Tensor, " batch"]:
        """Return losses from the positions of particles and tools before a control step, differentiable in both."""

    @abc.abstractmethod
    def _length_scale(self, tools: Float[Tensor, "batch step_plus_1 slot 3"], points: int) -> Tensor | float:
        """Return the length unit [m] in which a policy sees each point, the tools' slots last."""

    @abc.abstractmethod
    def _body_names(self) -> Sequence[str]:
        """Return the names of the bodies in an episode."""

    @abc.abstractmethod
    def _tool_names(self) -> Sequence[str]:
        """Return the names of the tools' slots in an episode."""

    @abc.abstractmethod
    def _parts(self, bodies: Sequence[Tensor], tools: Float[Tensor, "frame slot 3"]) -> tuple[Part, ...]:
        """Return the parts to draw."""

    @staticmethod
    def _make_stage(
        make_solver: Callable[..., Solver], model: Model, stop: threading.Event, settings: Mapping[str, Any]
    ) -> Stage:
        """Return what a thread simulates and judges with; takes no scene, whose memory it would hold on to."""
        return Stage(make_solver(model, stop=stop, **settings))

    def _setup(self) -> None:
        self.model = self._model()
        self._capacity = self._limit_rows(capacity(self.model, self.device))
        settings: dict[str, Any] = {"capacity": self._capacity, "device": self.device}
        make = partial(self._make_stage, self._engine("mpm").Solver, self.model, self._stop, settings)
        self._solvers = Pool(make, most=self._solvers_at_most)

    def _compile_ahead(self) -> None:
        compile_all = getattr(self._engine("mpm"), "compile_all", None)  # an engine may compile as it goes
        if compile_all is not None:
            compile_all(self.model, self.device)

    def _loss_steps(self) -> Sequence[int]:
        """Return the control steps before which losses are computed, including the end of the episode."""
        return (self.model.steps,)

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        x = x.clone().requires_grad_(grad)
        tools = self.tools(x)
        paths = tools.detach().to(self.device).requires_grad_(grad)
        found, adj_x, adj_paths = [], dict[int, Tensor](), torch.zeros_like(paths)
        with self._solvers.lend() as stage:
            stage.solver.run(paths.detach())
            escaped = stage.solver.read_escaped(len(x)).cpu()
            for step in self._loss_steps():
                end = stage.solver.read_positions(step, len(x)).detach().requires_grad_(grad)
                losses = self._losses(stage, step, end, paths)
                found.append(losses.detach())
                if grad:
                    adj_x[step], part = torch.autograd.grad(losses.sum(), (end, paths))
                    adj_paths += part
            if grad:
                adj_paths += stage.solver.gradient(adj_x)
        slope = torch.autograd.grad(tools, x, adj_paths.cpu())[0] if grad else None
        loss = reduce(torch.add, found).cpu()
        return Evaluation(loss, slope, torch.where(escaped, int(Status.ESCAPED), int(Status.OK)))

    def _observe(self, x: Float[Tensor, "batch dim"], decision: int) -> Float[Tensor, "batch feature"]:
        """Observe bodies and tools: at the start, before the last control step, and after it."""
        step, tools = decision * STEPS // SEGMENTS, self.tools(x)
        with self._solvers.lend() as stage:
            if step:
                stage.solver.run(tools[:, : step + 1].to(self.device))
            seen = [
                torch.cat([self._watch(stage.solver, k, len(x)), tools[:, k].double()], dim=1)
                for k in (0, max(0, step - 1), step)
            ]
        scale = self._length_scale(tools, seen[0].shape[1])
        return describe_motion(*seen, scale=scale, intervals=STEPS // SEGMENTS)

    def _watch(self, solver: Solver, step: int, rows: int) -> Float[Tensor, "batch seen 3"]:
        return watch(copied(solver.read_positions(step, rows)), self._sizes)

    @property
    def _sizes(self) -> list[int]:
        """Number of particles of each body."""
        return [len(body.x) for body in self.model.bodies]
