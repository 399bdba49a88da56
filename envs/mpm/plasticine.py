"""Plasticine that tools push into a target shape: the environment behind eight scenes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ... import __version__
from ...landscapes.episode import Part, View
from ...landscapes.space import ParameterSpace
from ..base import Fidelity, ModelPart
from ..batching import Pool
from ..controls import extend, hold, integrate_velocity, roll
from ..engines.mpm.model import Model
from ..engines.mpm.raster import Raster
from ..engines.mpm.solver import Solver
from ..engines.mpm.tools import Kind
from .plasticine_look import parts, view
from .plasticine_model import SPAN, PhysicsOptions, Scene, fidelities, model, target
from .scene import SEGMENTS, STEPS, MpmScene, Stage
from .targets import Target, compare, contact, load_or_make

DEMONSTRATION = "demonstration"  # the example that solves a scene
TERMS = ("density", "sdf", "contact")
MOST_WORK = 1e8  # particle-substeps of a demonstration that a CPU makes, so that all devices have the same target
REACH = 0.1  # what a policy measures lengths by [m]


@dataclass(frozen=True)
class PlasticineOptions(PhysicsOptions):
    """`loss` is of the final frame, or summed over all control steps.

    `density`, `sdf` and `contact` are the weights of its terms: the body's density against the target's, its distance
    from the target, and the distance of the tools from it.
    """

    loss: Literal["final", "sum"] = "final"
    density: float = 10.0
    sdf: float = 10.0
    contact: float = 500.0


@dataclass(frozen=True, eq=False)
class JudgedStage(Stage):
    """What one thread simulates and judges with."""

    raster: Raster


class Plasticine(MpmScene):
    """Model: MLS-MPM, fixed-corotated elasticity, von Mises plasticity in log strain; x right, y up, z to the front.

    Young's modulus 5000 Pa at a density of 1 kg/m^3; gravity 30 m/s^2; 0.1 s. Tools are signed distances that move as
    the parameters say and are felt by grid nodes, with Coulomb friction, through a shell (3.5 mm) in which their
    influence falls to nothing. The floor is thick: its nodes reach up to y = 1/32 m, and what lies lower rests among
    them.
    Parameters: 5 segments x tools x 3, each a share of the farthest a tool can go, held for 10 control steps.
    Loss at the end, or summed over control steps: 10 density + 10 sdf + 500 contact (options; `terms` has each alone).
    density = sum |m - m*| over the masses of grid nodes [kg]; sdf = sum m D* [kg m], D* the distance to the target's
    nearest node; contact = sum over tools of the squared distance to the closest particle [m^2]. The weight of contact
    is ours: the paper raised it and does not say to what. At draft 64 random points of table lose 8 to 104 with it
    (5 to 95 %), in the median 71 % of that contact; the paper's colour bar goes from 14 to 86.
    Targets are shapes, or what the scene's demonstration (an example) leaves at the same fidelity: at each of them a
    solution is known.
    Simplifications: a tool that only translates carries no rotation; a slippery room ends where tools push nothing, or
    0.5 m beyond the bodies; particles are spread evenly whatever a body weighs (upstream, weight follows the number
    drawn). Departures from upstream: 20 substeps for 19, an exact distance field, softness 666 everywhere, no jump at
    a shell's end nor on a sticky floor; a shell acts per time, not per substep; only the closest particle has the
    contact's gradient, and undeformed bodies have theirs.
    Refine step and grid together. Velocities pass through the grid once per substep, which damps what is as short as a
    few cells: on a given grid the shorter the step, the more. On 64 cells with 4000 particles the loss of one of
    assembly's random episodes grows by 1.3, 1.5 and 1.5 % as the step halves from 2e-4 to 2.5e-5 s. That is no chaos:
    with 2000 particles at 1e-4 s, parameters 1e-8 apart end at most 1.3e-8 m apart at four random points of table and
    assembly.
    Source: PlasticineLab (Huang et al., ICLR 2021), as used in "Rethinking Optimization with Differentiable Simulation
    from a Global Perspective" (CoRL 2022).
    """

    model_version = 1
    fidelities: ClassVar[dict[str, Fidelity]] = fidelities(draft=(48, 1500, 14), standard=(80, 10_000, 25))
    Options: ClassVar[type[Any]] = PlasticineOptions
    model_parts: ClassVar[tuple[ModelPart, ...]] = (
        ModelPart("friction of tools", {"tool_friction": 0.0}, "tools slip"),
        ModelPart("friction of the floor", {"floor_friction": 0.0}, "the floor slips"),
        ModelPart("plasticity", {"yield_stress": 1e6}, "an elastic body"),
        ModelPart("Poisson's ratio", {"poisson": 0.0}, "what is pressed does not bulge"),
        ModelPart("gravity", {"gravity": 0.0}, "no weight"),
        ModelPart("soft shell of tools", {"softness": 1e5}, "felt at their surface alone"),
        ModelPart("walls", {"walls": False}, "an open room"),
        ModelPart("density term", {"density": 0.0}, "not in the loss"),
        ModelPart("sdf term", {"sdf": 0.0}, "not in the loss"),
        ModelPart("contact term", {"contact": 0.0}, "not in the loss"),
    )
    control_step: ClassVar[float] = SPAN
    scene: ClassVar[Scene]
    _solvers: Pool[JudgedStage]

    def memory(self) -> int:
        """Estimate the bytes one episode takes while it runs."""
        return super().memory() + Raster.bytes_per_row(self.model)

    def tools(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step_plus_1 slot 3"]:
        """Return where tools are at the ends of control steps [m]; a roller's second slot is (spin, yaw, 0) [rad]."""
        shares, count = hold(x.view(len(x), SEGMENTS, -1), STEPS), self.model.steps
        steps = extend(shares, count, then=torch.zeros_like(shares[:, :1])).view(len(x), count, -1, 3)
        slots: list[Tensor] = []
        for anchor, share in zip(self.scene.anchors, steps.unbind(dim=2), strict=True):
            step, start, lower, upper = (
                x.new_tensor(p) for p in (anchor.step, anchor.start, anchor.lower, anchor.upper)
            )
            if anchor.tool.kind is Kind.ROLLER:
                slots += roll(start, share * step, anchor.tool.size[1], lower=lower, upper=upper)
            else:
                slots.append(integrate_velocity(start, share * step, 1.0, lower=lower, upper=upper))
        slots += [x.new_tensor(place).expand(len(x), count + 1, 3) for _, place in self.scene.posts]
        return torch.stack(slots, dim=2)

    def terms(self, x: Float[Tensor, "batch dim"]) -> dict[str, Float[Tensor, " batch"]]:
        """Return the loss's terms (density, sdf and contact), each alone and unweighted."""
        found = []
        with self._solvers.lend() as stage:
            for part in torch.split(self._check_points(x), self._capacity):
                paths = self.tools(part).to(self.device)
                stage.solver.run(paths)
                ends = {step: stage.solver.read_positions(step, len(part)) for step in self._loss_steps()}
                terms = [self._terms(stage, end, paths[:, step]) for step, end in ends.items()]
                found.append(torch.stack(terms).sum(dim=0))
        return dict(zip(TERMS, torch.cat(found).cpu().unbind(1), strict=True))

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
        super()._setup()
        self._making = threading.Lock()

    def _model(self) -> Model:
        return model(self.scene, self.fidelity, self.options.count_steps(STEPS), self.options)

    @staticmethod
    def _make_stage(
        make_solver: Callable[..., Solver], model: Model, stop: threading.Event, settings: Mapping[str, Any]
    ) -> JudgedStage:
        return JudgedStage(make_solver(model, stop=stop, **settings), Raster(model, model.mass, **settings))

    def _prepare(self) -> None:
        _ = self._target

    def _loss_steps(self) -> Sequence[int]:
        return (self.model.steps,) if self.options.loss == "final" else range(1, self.model.steps + 1)

    def _losses(self, stage: JudgedStage, step: int, end: Tensor, paths: Tensor) -> Float[Tensor, " batch"]:
        weights = paths.new_tensor([getattr(self.options, term) for term in TERMS])
        return (self._terms(stage, end, paths[:, step]) * weights).sum(dim=1)

    def _terms(
        self, stage: JudgedStage, end: Float[Tensor, "batch particle 3"], tools: Float[Tensor, "batch slot 3"]
    ) -> Float[Tensor, "batch term"]:
        """Return the loss's terms where particles and tools are."""
        shape = compare(stage.raster(end).double(), self._target)
        touch = contact(end.double(), tools, [anchor.tool for anchor in self.scene.anchors])
        return torch.cat([shape, touch[:, None]], dim=1)

    def _length_scale(self, tools: Float[Tensor, "batch step_plus_1 slot 3"], points: int) -> Float[Tensor, "point 1"]:
        """Return tenths of a metre; radians for a roller's angles."""
        scale = tools.new_full((points, 1), REACH)
        if any(anchor.tool.kind is Kind.ROLLER for anchor in self.scene.anchors):
            scale[-tools.shape[2] + 1] = 1.0
        return scale

    def _body_names(self) -> list[str]:
        return [f"plasticine {number}" for number in range(1, len(self.model.bodies) + 1)]

    def _surroundings(self, tools: Float[Tensor, "frame slot 3"]) -> dict[str, Tensor]:
        return {f"tool {number}": path for number, path in enumerate(tools.unbind(1), start=1)}

    def _parts(self, bodies: Sequence[Tensor], tools: Float[Tensor, "frame slot 3"]) -> tuple[Part, ...]:
        return parts(self.scene, bodies, tools, self._target_particles())

    def _view(self) -> View:
        return view(self.scene)

    @cached_property
    def _target(self) -> Target:
        """What a shape is compared with, on this model's grid."""
        with self._making:
            return Target.of(self.model, self._target_particles(), self.device)

    def _target_particles(self) -> np.ndarray:
        """Return where the target's particles are [m]."""
        if self.scene.target:
            return target(self.scene, self.model.particles)
        device = "cpu" if self.model.particle_substeps <= MOST_WORK else self.device
        model = f"model {self.version_on(self.engines[0])}, {__version__}"
        content = f"{self.scene} {self.fidelity} {self.examples[DEMONSTRATION]} {model}"
        content += "" if device == "cpu" else f" {device}"
        return load_or_make(f"{self.name}-{self.fidelity.name}", content, lambda: self._demonstrate(device))

    def _demonstrate(self, device: str) -> np.ndarray:
        demonstration = type(self)(fidelity=self.fidelity, device=device).end(self.example(DEMONSTRATION))
        return np.asarray(demonstration)
