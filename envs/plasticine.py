"""Plasticine that tools push into a target shape: the environment behind eight scenes."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..landscapes.objective import Evaluation, Status
from ..landscapes.space import ParameterSpace
from .base import Environment, Episode, Fidelity
from .controls import hold, roll, travel
from .engines.manipulators import Kind, Manipulators, Tool
from .engines.materials import Plasticine as Material
from .engines.mpm import Body, Model, Solver, capacity
from .engines.raster import Raster
from .engines.runtime import Pool
from .registry import code_digest
from .shapes import Point, Shape, fill, shares
from .targets import Target, cached, contact

SEGMENTS, STEPS, SPAN = 5, 50, 2e-3  # control segments, control steps, length of a step [s]
YOUNG, GRAVITY, SOFTNESS = 5000.0, 30.0, 666.0  # at unit density; [m/s^2]; [1/m]
PARTICLE = (1 / 128) ** 2  # PlasticineLab's particle mass and volume, which sets the scale of its losses
FLOOR, WALLS = 2.5 / 64, (2.5 / 64, 61.5 / 64)  # below the first, nodes belong to the floor [m]
ROOM = 0.15  # what the grid has around the bodies at least [m]
MARGIN = 2  # nodes outside the walls
DEMONSTRATION = "demonstration"  # the example that solves a scene
TERMS = ("density", "sdf", "contact")


@dataclass(frozen=True)
class Lump:
    """A piece of plasticine that weighs as much as so many of PlasticineLab's `particles`."""

    shape: Shape
    particles: int


@dataclass(frozen=True)
class Anchor:
    """A tool that the parameters move: from `start` [m], at most by `step` per control step, within its bounds.

    A roller's step is (spin [rad], turn [rad], height [m]).
    """

    tool: Tool
    start: Point
    step: Point
    lower: Point = (0.0, 0.0, 0.0)
    upper: Point = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Scene:
    """All that makes one scene; `posts` are tools that stay, `target` is empty where a demonstration makes it."""

    lumps: tuple[Lump, ...]
    anchors: tuple[Anchor, ...]
    yield_stress: float
    floor_friction: float
    poisson: float = 0.2
    posts: tuple[tuple[Tool, Point], ...] = ()
    target: tuple[Shape, ...] = ()


@dataclass(frozen=True)
class PlasticineOptions:
    """`loss`: of the final frame, or the sum over all control steps; and what each of its terms weighs."""

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
    the parameters say and are felt by grid nodes, with Coulomb friction, through a shell in which their influence falls
    to a tenth (at 3.5 mm). The floor's nodes reach up to y = 1/32 m; what lies lower rests in them, as upstream.
    Parameters: 5 segments x tools x 3, each a share of the farthest a tool can go, held for 10 control steps.
    Loss: 10 density + 10 sdf + 500 contact at the end (or summed over control steps). density = sum |m - m*| over grid
    nodes; sdf = sum m D*, D* the distance to the target's nearest node; contact = sum over tools of the squared distance
    to the closest particle. The weight of contact is ours: the paper raised it and does not say to what.
    Simplifications: tools that only translate carry no rotation; the room ends where tools cannot push anything; a
    body's particles are spread evenly whatever it weighs (upstream, mass follows the number drawn); the distance field
    is exact.
    Source: PlasticineLab (Huang et al., ICLR 2021) as used in "Rethinking Optimization with Differentiable Simulation
    from a Global Perspective" (CoRL 2022). Departures from upstream: 20 substeps for 19, the closest particle alone has
    the contact's gradient, and undeformed bodies have theirs.
    """

    devices: ClassVar[tuple[str, ...]] = ("cpu", "cuda")
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=SPAN / 9, resolution=32, particles=800),
        "standard": Fidelity("standard", dt=SPAN / 20, resolution=64, particles=10_000),
        "reference": Fidelity("reference", dt=SPAN / 40, resolution=64, particles=10_000, precision="float64"),
    }
    Options: ClassVar[type[Any]] = PlasticineOptions
    scene: ClassVar[Scene]
    _solvers: Pool[Solver]

    def memory(self) -> int:
        """Estimate the bytes one episode takes while it runs."""
        return self.model.bytes_per_environment()

    def tools(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step_plus_1 slot 3"]:
        """Return where tools are at the ends of control steps [m]; a roller's second slot is (spin, yaw, 0) [rad]."""
        actions = hold(x.view(len(x), SEGMENTS, -1), STEPS).unflatten(2, (-1, 3))
        slots = []
        for number, anchor in enumerate(self.scene.anchors):
            steps = actions[:, :, number] * x.new_tensor(anchor.step)
            start, lower, upper = (x.new_tensor(p) for p in (anchor.start, anchor.lower, anchor.upper))
            if anchor.tool.kind is Kind.ROLLER:
                slots += roll(start, steps, anchor.tool.size[1], lower=lower, upper=upper)
            else:
                slots.append(travel(start, steps, 1.0, lower=lower, upper=upper))
        slots += [x.new_tensor(place).expand(len(x), STEPS + 1, 3) for _, place in self.scene.posts]
        return torch.stack(slots, dim=2)

    def terms(self, x: Float[Tensor, "batch dim"]) -> dict[str, Float[Tensor, " batch"]]:
        """Return the loss's terms (density, sdf and contact), each alone and unweighted."""
        found = []
        with self._solvers.lend() as stage:
            for part in self._checked(x).split(self._capacity):
                paths = self.tools(part)
                stage.solver.run(paths)
                found.append(sum(self._judge(stage, step, paths)[1] for step in self._judged))
        return dict(zip(TERMS, torch.cat(found).cpu().unbind(1), strict=True))

    def end(self, x: Float[Tensor, " dim"]) -> Float[Tensor, "particle 3"]:
        """Return where particles are at the end of the episode at one point [m]."""
        with self._solvers.lend() as stage:
            return stage.solver.run(self.tools(self._checked(x[None])))[0].double().cpu()

    def demonstrated(self) -> Float[np.ndarray, "particle 3"]:
        """Return where the demonstration leaves the particles [m]."""
        return self.end(self.example(DEMONSTRATION)).numpy()

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return plasticine and tools at the ends of control steps."""
        tools = self.tools(self._checked(x[None]))
        with self._solvers.lend() as stage:
            stage.solver.run(tools)
            frames = stage.solver.positions(0)
        bodies = frames.split([len(body.x) for body in self.model.bodies], dim=1)
        time = SPAN * torch.arange(STEPS + 1, dtype=torch.float64)
        return Episode(
            time,
            {f"plasticine {n}": body for n, body in enumerate(bodies, start=1)},
            {f"tool {n}": path for n, path in enumerate(tools[0].unbind(1), start=1)},
        )

    def _setup(self) -> None:
        names = [
            f"tool {number} {axis}, segment {segment}"
            for segment in range(1, SEGMENTS + 1)
            for number, anchor in enumerate(self.scene.anchors, start=1)
            for axis in (("roll", "turn", "height") if anchor.tool.kind is Kind.ROLLER else "xyz")
        ]
        self.space = ParameterSpace.box(names, -1.0, 1.0)
        self.model = _model(self.scene, self.fidelity)
        self._judged = (STEPS,) if self.options.loss == "final" else tuple(range(1, STEPS + 1))
        self._capacity = capacity(self.model, self.device)
        self._solvers = Pool(self._stage)
        self._making = threading.Lock()

    def _stage(self) -> Stage:
        solver = Solver(self.model, capacity=self._capacity, device=self.device, stop=self._stop)
        return Stage(solver, Raster(self.model, self.model.mass, capacity=self._capacity, device=self.device))

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        x = x.clone().requires_grad_(grad)
        tools = self.tools(x)
        paths = tools.detach().to(self.device).requires_grad_(grad)
        loss, adj_x, adj_paths = paths.new_zeros(len(x)), {}, torch.zeros_like(paths)
        weights = paths.new_tensor([getattr(self.options, term) for term in TERMS])
        with self._solvers.lend() as stage:
            stage.solver.run(paths.detach())
            escaped = stage.solver.left_grid(len(x)).cpu()
            for step in self._judged:
                end, terms = self._judge(stage, step, paths)
                loss += terms.detach() @ weights
                if grad:
                    adj_x[step], part = torch.autograd.grad((terms @ weights).sum(), (end, paths))
                    adj_paths += part
            if grad:
                adj_paths += stage.solver.gradient(adj_x)
        slope = torch.autograd.grad(tools, x, adj_paths.cpu())[0] if grad else None
        return Evaluation(loss.cpu(), slope, torch.where(escaped, int(Status.ESCAPED), int(Status.OK)))

    def _judge(self, stage: Stage, step: int, paths: Float[Tensor, "batch step_plus_1 slot 3"]) -> tuple[Tensor, Tensor]:
        """Return particles before a control step, and the loss's terms there, shape (batch, term)."""
        end = stage.solver.reached(step, len(paths)).detach().requires_grad_(paths.requires_grad)
        at_nodes = stage.raster(end).double()
        density = (at_nodes - self._target.mass).abs().sum(dim=1)
        sdf = at_nodes @ self._target.distance
        movable = [anchor.tool for anchor in self.scene.anchors]
        return end, torch.stack([density, sdf, contact(end.double(), paths[:, step].to(end.device), movable)], dim=1)

    @cached_property
    def _target(self) -> Target:
        """What the final shape is compared with, on this model's grid."""
        with self._making:
            x, mass = self._wanted()
            return Target.of(self.model, x, mass, self.device)

    def _wanted(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the target's particles [m] and their masses."""
        standard = self.fidelities["standard"]
        model = _model(self.scene, standard)
        if self.scene.target:
            counts = [len(body.x) for body in model.bodies]
            return np.concatenate([fill(s, n) for s, n in zip(self.scene.target, counts, strict=True)]), model.mass
        content = f"{self.scene} {standard} {self.examples[DEMONSTRATION]} {code_digest(self.name)}"
        return cached(self.name, content, lambda: type(self)(fidelity=standard, device="cpu").demonstrated()), model.mass


def _model(scene: Scene, fidelity: Fidelity) -> Model:
    dx = 1.0 / fidelity.resolution
    lower, upper = _room(scene)
    first = np.floor(lower / dx).astype(int) - MARGIN
    last = np.ceil(upper / dx).astype(int) + MARGIN
    tools = (*(anchor.tool for anchor in scene.anchors), *(tool for tool, _ in scene.posts))
    return Model(
        precision=fidelity.precision,
        bodies=_bodies(scene, fidelity.particles),
        boundary=Manipulators(tools, tuple(lower), tuple(upper), FLOOR, scene.floor_friction, SOFTNESS),
        origin=tuple(first * dx),
        dx=dx,
        nodes=tuple(last - first + 1),
        dt=fidelity.dt,
        substeps=round(SPAN / fidelity.dt),
        steps=STEPS,
        gravity=GRAVITY,
    )


def _bodies(scene: Scene, particles: int) -> tuple[Body, ...]:
    material = Material(1.0, YOUNG, scene.poisson, scene.yield_stress)
    bodies = []
    for lump, count in zip(scene.lumps, shares([lump.shape for lump in scene.lumps], particles), strict=True):
        volume = np.full(count, lump.particles * PARTICLE / count)
        bodies.append(Body(material, fill(lump.shape, count), volume, np.ones(count)))
    return tuple(bodies)


def _room(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of what tools can push bodies through [m]: where walls stand."""
    corners = [lump.shape.bounds for lump in scene.lumps] + [shape.bounds for shape in scene.target]
    reach = np.maximum(ROOM, STEPS * np.max([_fastest(anchor) for anchor in scene.anchors], axis=0))
    lower = np.min([low for low, _ in corners], axis=0) - reach
    upper = np.max([high for _, high in corners], axis=0) + reach
    lower[1] = 0.0
    return np.maximum(lower, [WALLS[0], 0.0, WALLS[0]]), np.minimum(upper, WALLS[1])


def _fastest(anchor: Anchor) -> np.ndarray:
    """Return how far a tool can go along each axis in one control step [m]."""
    if anchor.tool.kind is Kind.ROLLER:
        rolled = anchor.tool.size[1] * anchor.step[0]
        return np.array([rolled, anchor.step[2], rolled])
    return np.array(anchor.step)
