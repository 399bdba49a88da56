"""Plasticine that tools push into a target shape: the environment behind eight scenes."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes.objective import Evaluation, Status
from ...landscapes.space import ParameterSpace
from ..base import Environment, Episode, Fidelity, Work
from ..code import code_digest
from ..controls import hold, lasting, roll, travel
from ..engines.mpm.tools import Kind
from ..engines.mpm.model import Model
from ..engines.mpm.solver import Solver, capacity, memory
from ..engines.mpm.raster import Raster
from ..engines.runtime import Pool
from ..observation import followed, motion
from ..options import EpisodeOptions
from .plasticine_look import parts, view
from .plasticine_model import SPAN, STEPS, Scene, model, target
from .targets import Target, cached, contact

SEGMENTS = 5  # of the controls
DEMONSTRATION = "demonstration"  # the example that solves a scene
TERMS = ("density", "sdf", "contact")
REACH = 0.1  # what a policy measures lengths by [m]


@dataclass(frozen=True)
class PlasticineOptions(EpisodeOptions):
    """`loss` is of the final frame, or summed over all control steps.

    `density`, `sdf` and `contact` are the weights of its terms: the body's density against the target's, its distance
    from the target, and the distance of the tools from it.
    """

    loss: Literal["final", "sum"] = "final"
    density: float = 10.0
    sdf: float = 10.0
    contact: float = 500.0


@dataclass(frozen=True, eq=False)
class Stage:
    """What one thread simulates and judges with."""

    solver: Solver
    raster: Raster


class Plasticine(Environment):
    """Model: MLS-MPM, fixed-corotated elasticity, von Mises plasticity in log strain; x right, y up, z to the front.

    Young's modulus 5000 Pa at a density of 1 kg/m^3; gravity 30 m/s^2; 0.1 s. Tools are signed distances that move as
    the parameters say and are felt by grid nodes, with Coulomb friction, through a shell (3.5 mm) in which their
    influence falls to nothing. The floor is thick: its nodes reach up to y = 1/32 m, and what lies lower rests among
    them.
    Parameters: 5 segments x tools x 3, each a share of the farthest a tool can go, held for 10 control steps.
    Loss at the end, or summed over control steps: 10 density + 10 sdf + 500 contact (options; `terms` has each alone).
    density = sum |m - m*| over the masses of grid nodes [kg]; sdf = sum m D* [kg m], D* the distance to the target's
    nearest node; contact = sum over tools of the squared distance to the closest particle [m^2]. The weight of contact
    is ours: the paper raised it and does not say to what.
    Targets are shapes, or what the scene's demonstration (an example) leaves at the same fidelity: at each of them a
    solution is known.
    Simplifications: a tool that only translates carries no rotation; a slippery room ends where tools push nothing, or
    0.5 m beyond the bodies; particles are spread evenly whatever a body weighs (upstream, weight follows the number
    drawn). Departures from upstream: 20 substeps for 19, an exact distance field, softness 666 everywhere, no jump at
    a shell's end nor on a sticky floor; only the closest particle has the contact's gradient, and undeformed bodies
    have theirs.
    Source: PlasticineLab (Huang et al., ICLR 2021), as used in "Rethinking Optimization with Differentiable Simulation
    from a Global Perspective" (CoRL 2022).
    """

    devices: ClassVar[tuple[str, ...]] = ("cpu", "cuda")
    beyond_box: ClassVar[bool] = True
    engines: ClassVar[tuple[str, ...]] = ("warp", "taichi")
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=SPAN / 9, resolution=32, particles=800),
        "standard": Fidelity("standard", dt=SPAN / 20, resolution=64, particles=10_000),
        "reference": Fidelity("reference", dt=SPAN / 40, resolution=64, particles=10_000, precision="float64"),
    }
    Options: ClassVar[type[Any]] = PlasticineOptions
    decisions: ClassVar[int] = SEGMENTS
    control_step: ClassVar[float] = SPAN
    scene: ClassVar[Scene]
    _solvers: Pool[Stage]

    def memory(self) -> int:
        """Estimate the bytes one episode takes while it runs."""
        return memory(self.model, self.device) + Raster.bytes_per_row(self.model)

    def work(self) -> Work:
        """Count substeps of particles."""
        return Work(self.model.particle_substeps, "particle-substep")

    def tools(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step_plus_1 slot 3"]:
        """Return where tools are at the ends of control steps [m]; a roller's second slot is (spin, yaw, 0) [rad]."""
        shares, count = hold(x.view(len(x), SEGMENTS, -1), STEPS), self.model.steps
        steps = lasting(shares, count, then=torch.zeros_like(shares[:, :1])).view(len(x), count, -1, 3)
        slots: list[Tensor] = []
        for anchor, share in zip(self.scene.anchors, steps.unbind(dim=2), strict=True):
            step, start, lower, upper = (
                x.new_tensor(p) for p in (anchor.step, anchor.start, anchor.lower, anchor.upper)
            )
            if anchor.tool.kind is Kind.ROLLER:
                slots += roll(start, share * step, anchor.tool.size[1], lower=lower, upper=upper)
            else:
                slots.append(travel(start, share * step, 1.0, lower=lower, upper=upper))
        slots += [x.new_tensor(place).expand(len(x), count + 1, 3) for _, place in self.scene.posts]
        return torch.stack(slots, dim=2)

    def terms(self, x: Float[Tensor, "batch dim"]) -> dict[str, Float[Tensor, " batch"]]:
        """Return the loss's terms (density, sdf and contact), each alone and unweighted."""
        found = []
        with self._solvers.lend() as stage:
            for part in torch.split(self._checked(x), self._capacity):
                paths = self.tools(part).to(self.device)
                stage.solver.run(paths)
                found.append(torch.stack([self._judge(stage, step, paths)[1] for step in self._judged]).sum(dim=0))
        return dict(zip(TERMS, torch.cat(found).cpu().unbind(1), strict=True))

    def end(self, x: Float[Tensor, " dim"]) -> Float[Tensor, "particle 3"]:
        """Return where particles are at the end of the episode at one point [m]."""
        with self._solvers.lend() as stage:
            end: Tensor = stage.solver.run(self.tools(self._row(x)))[0].double().cpu()
        return end

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return plasticine and tools at the ends of control steps."""
        tools = self.tools(self._row(x))
        with self._solvers.lend() as stage:
            stage.solver.run(tools)
            frames = stage.solver.positions(0)
        bodies = torch.split(frames, [len(body.x) for body in self.model.bodies], dim=1)
        return Episode(
            SPAN * torch.arange(self.model.steps + 1, dtype=torch.float64),
            {f"plasticine {number}": body for number, body in enumerate(bodies, start=1)},
            {f"tool {number}": path for number, path in enumerate(tools[0].unbind(1), start=1)},
            parts(self.scene, bodies, tools[0], self._wanted()),
            view(self.scene),
        )

    def _setup(self) -> None:
        self.space = ParameterSpace.box(
            [
                f"tool {number} {axis}, segment {segment}"
                for segment in range(1, SEGMENTS + 1)
                for number, anchor in enumerate(self.scene.anchors, start=1)
                for axis in (("roll", "turn", "height") if anchor.tool.kind is Kind.ROLLER else "xyz")
            ],
            -1.0,
            1.0,
        )
        steps = self.options.lasting(STEPS)
        self.model = model(self.scene, self.fidelity, steps)
        self._judged = (steps,) if self.options.loss == "final" else tuple(range(1, steps + 1))
        self._capacity = self._rows_at_once(capacity(self.model, self.device))
        settings: dict[str, Any] = {"capacity": self._capacity, "device": self.device}
        settings |= {"deterministic": True} if self.deterministic else {}
        make = partial(_stage, self._engine("mpm").Solver, self.model, self._stop, settings)
        self._solvers = Pool(make, most=self._solvers_at_most)
        self._making = threading.Lock()

    def _prepare(self) -> None:
        _ = self._target

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        x = x.clone().requires_grad_(grad)
        tools = self.tools(x)
        paths = tools.detach().to(self.device).requires_grad_(grad)
        loss, adj_paths = paths.new_zeros(len(x)), torch.zeros_like(paths)
        adj_x: dict[int, Tensor] = {}
        weights = paths.new_tensor([getattr(self.options, term) for term in TERMS])
        with self._solvers.lend() as stage:
            stage.solver.run(paths.detach())
            escaped = stage.solver.left_grid(len(x)).cpu()
            for step in self._judged:
                end, terms = self._judge(stage, step, paths)
                losses = (terms * weights).sum(dim=1)
                loss += losses.detach()
                if grad:
                    adj_x[step], part = torch.autograd.grad(losses.sum(), (end, paths))
                    adj_paths += part
            if grad:
                adj_paths += stage.solver.gradient(adj_x)
        slope = torch.autograd.grad(tools, x, adj_paths.cpu())[0] if grad else None
        return Evaluation(loss.cpu(), slope, torch.where(escaped, int(Status.ESCAPED), int(Status.OK)))

    def _observe(self, x: Float[Tensor, "batch dim"], decision: int) -> Float[Tensor, "batch feature"]:
        """Watch plasticine and tools, in tenths of a metre; a roller's angles in radians."""
        tools = self.tools(x)
        with self._solvers.lend() as stage:
            seen = followed(stage.solver, tools.to(self.device), decision * STEPS // SEGMENTS)
        scale = tools.new_full((seen[0].shape[1], 1), REACH)
        if any(anchor.tool.kind is Kind.ROLLER for anchor in self.scene.anchors):
            scale[-tools.shape[2] + 1] = 1.0
        return motion(*seen, scale=scale, intervals=STEPS // SEGMENTS)

    def _judge(
        self, stage: Stage, step: int, paths: Float[Tensor, "batch step_plus_1 slot 3"]
    ) -> tuple[Tensor, Tensor]:
        """Return where particles are before a control step, and the loss's terms there, shape (batch, term)."""
        end = stage.solver.reached(step, len(paths)).detach().requires_grad_(paths.requires_grad)
        rows = stage.raster(end).double().unbind(0)  # one by one: a batched sum rounds as its batch is large
        density = torch.stack([(row - self._target.mass).abs().sum() for row in rows])
        distance = torch.stack([(row * self._target.distance).sum() for row in rows])
        touch = contact(end.double(), paths[:, step], [anchor.tool for anchor in self.scene.anchors])
        return end, torch.stack([density, distance, touch], dim=1)

    @cached_property
    def _target(self) -> Target:
        """What a shape is compared with, on this model's grid."""
        with self._making:
            return Target.of(self.model, self._wanted(), self.device)

    def _wanted(self) -> np.ndarray:
        """Return where the target's particles are [m]."""
        if self.scene.target:
            return target(self.scene, self.model.particles)
        content = f"{self.scene} {self.fidelity} {self.examples[DEMONSTRATION]} {code_digest(type(self))}"
        return cached(f"{self.name}-{self.fidelity.name}", content, self._demonstrated)

    def _demonstrated(self) -> np.ndarray:
        demonstration = type(self)(fidelity=self.fidelity, device="cpu").end(self.example(DEMONSTRATION))
        return np.asarray(demonstration)


def _stage(kind: type[Solver], model: Model, stop: threading.Event, settings: dict[str, Any]) -> Stage:
    return Stage(kind(model, stop=stop, **settings), Raster(model, model.mass, **settings))
