"""Plasticine that tools push into a target shape: the environment of eight scenes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ... import __version__
from ...landscapes import episode
from ...landscapes.episode import Part, View
from ...landscapes.space import ParameterSpace
from ..base import Environment, Fidelity, ModelPart
from ..controls import extend, hold, integrate_velocity, roll
from ..engines.mpm import materials
from ..engines.mpm.boundaries import Kind, Tool, ToolsInRoom
from ..engines.mpm.model import Body, Model
from ..engines.mpm.raster import Raster
from ..engines.mpm.solver import Solver
from ..outlines import rotate_about
from ..records import EpisodeOptions
from .scene import SEGMENTS, SHIFTS, STEPS, MpmScene, Stage
from .targets import Ball, Box, Point, Shape, Target, compare, contact, fill, load_or_make, shares

# ---- What a plasticine scene is made of, and the model a solver simulates it by.

SPAN = 2e-3  # length of a control step [s]
YOUNG, GRAVITY, SOFTNESS = 5000.0, 30.0, 666.0  # [Pa] at a density of 1 kg/m^3; [m/s^2]; [1/m]
PARTICLE = (1 / 128) ** 2  # PlasticineLab's particle mass [kg], which sets the scale of its losses
FLOOR, WALLS = 2.5 / 64, (2.5 / 64, 61.5 / 64)  # nodes outside belong to floor and walls [m]
ROOM = 0.15, 0.5  # least and most that the room extends beyond the bodies [m]
BEYOND = 1e6  # where walls are that no body meets [m]
MARGIN = 2  # nodes outside the walls
THIRDS = ((1 / 3, 2 / 3), (2 / 3, 1 / 3))  # of a cell along x and z: with 0, what has a cell's wavelength is seen whole


def fidelities(*, draft: tuple[int, int, int], standard: tuple[int, int, int]) -> dict[str, Fidelity]:
    """Return a scene's fidelities from (cells per metre, particles, substeps of a control step) of each.

    The reference has a finer grid than every standard. Like them, it takes about the longest step that is stable on its
    grid, so grid and step are refined together.
    """
    settings = {"draft": draft, "standard": standard, "reference": (96, 34_000, 30)}
    return {
        name: Fidelity(
            name,
            dt=SPAN / substeps,
            resolution=cells,
            particles=particles,
            precision="float64" if name == "reference" else "float32",
        )
        for name, (cells, particles, substeps) in settings.items()
    }


@dataclass(frozen=True)
class PhysicsOptions(EpisodeOptions):
    """Factors on parts of the model: 1 keeps the scene's own value, and 0 leaves the part out.

    `tool_friction` and `floor_friction` scale Coulomb friction. A sticky floor has friction 10; with less, bodies slide
    and rub on it. `yield_stress` (1e6: an elastic body). `poisson` scales Poisson's ratio, `gravity` the gravity.
    `softness` [1/m] is no factor but the value for the shell through which tools act (1e5: tools act at their surface
    only). Without `walls` the room has neither walls nor lid, and an episode gets status ESCAPED when plasticine leaves
    the grid. Raises ValueError where one is below 0.
    """

    tool_friction: float = 1.0
    floor_friction: float = 1.0
    yield_stress: float = 1.0
    poisson: float = 1.0
    gravity: float = 1.0
    softness: float = SOFTNESS
    walls: bool = True

    def __post_init__(self) -> None:
        for field in fields(PhysicsOptions):
            value = getattr(self, field.name)
            if value < 0 or (field.name == "softness" and value == 0):
                least = "above 0" if field.name == "softness" else "of at least 0"
                raise ValueError(f"plasticine option {field.name} takes a number {least}; got {value:g}")


@dataclass(frozen=True)
class Piece:
    """A piece of plasticine that weighs as much as this many of PlasticineLab's `particles`."""

    shape: Shape
    particles: int


@dataclass(frozen=True)
class Anchor:
    """A tool that the parameters move: from `start` [m], by at most `step` per control step, within its bounds.

    The step of a roller is (spin [rad], turn [rad], height [m]).
    """

    tool: Tool
    start: Point
    step: Point
    lower: Point = (0.0, 0.0, 0.0)
    upper: Point = (1.0, 1.0, 1.0)

    @property
    def reach(self) -> Point:
        """Largest move of the tool along each axis in one control step [m]."""
        if self.tool.kind is Kind.ROLLER:
            rolled = self.tool.size[1] * self.step[0]
            return rolled, self.step[2], rolled
        return self.step


@dataclass(frozen=True)
class Scene:
    """The data of one scene; `posts` are fixed tools, and `target` is empty if a demonstration makes the target.

    `yield_stress` [Pa] is the norm of the deviatoric stress at yield, as in PlasticineLab. Von Mises' stress is
    sqrt(3/2) times as large: a bar of "50 Pa" yields in tension at 61 Pa.
    """

    pieces: tuple[Piece, ...]
    anchors: tuple[Anchor, ...]
    yield_stress: float
    floor_friction: float
    poisson: float = 0.2
    posts: tuple[tuple[Tool, Point], ...] = ()
    target: tuple[Shape, ...] = ()

    @property
    def tools(self) -> tuple[Tool, ...]:
        """Every tool, in the order of their slots."""
        return (*(anchor.tool for anchor in self.anchors), *(tool for tool, _ in self.posts))

    def altered(self, options: PhysicsOptions) -> Scene:
        """Return the scene with its material and frictions changed by the options."""
        return replace(
            self,
            yield_stress=self.yield_stress * options.yield_stress,
            floor_friction=self.floor_friction * options.floor_friction,
            poisson=self.poisson * options.poisson,
            anchors=tuple(replace(a, tool=_rub(a.tool, options.tool_friction)) for a in self.anchors),
            posts=tuple((_rub(tool, options.tool_friction), at) for tool, at in self.posts),
        )

    def room(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of the room through which tools can push bodies [m]: the positions of the walls."""
        corners = [shape.bounds for shape in (*(piece.shape for piece in self.pieces), *self.target)]
        reach = np.clip(STEPS * np.max([anchor.reach for anchor in self.anchors], axis=0), *ROOM)
        lower = np.min([low for low, _ in corners], axis=0) - reach
        upper = np.max([high for _, high in corners], axis=0) + reach
        return np.maximum(lower, [WALLS[0], 0.0, WALLS[0]]), np.minimum(upper, WALLS[1])


def model(scene: Scene, fidelity: Fidelity, steps: int = STEPS, options: PhysicsOptions = PhysicsOptions()) -> Model:
    """Return a scene's model with this many control steps: bodies at rest, tools, and a grid that covers its room."""
    dx = 1.0 / fidelity.resolution
    scene = scene.altered(options)
    lower, upper = scene.room()
    shift = np.array([fidelity.settings.get(name, 0.0) for name in SHIFTS])
    first = np.floor(lower / dx - shift).astype(int) - MARGIN
    last = np.ceil(upper / dx - shift).astype(int) + MARGIN
    return Model(
        precision=fidelity.precision,
        bodies=_bodies(scene, fidelity, dx),
        boundary=_boundary(scene, fidelity.dt, options),
        origin=tuple(((first + shift) * dx).tolist()),
        dx=dx,
        nodes=tuple((last - first + 1).tolist()),
        dt=fidelity.dt,
        substeps=round(SPAN / fidelity.dt),
        steps=steps,
        gravity=GRAVITY * options.gravity,
    )


def target(scene: Scene, fidelity: Fidelity) -> np.ndarray:
    """Return the particles of a target that is made of shapes [m], shape (particle, 3)."""
    counts, seed = shares([piece.shape for piece in scene.pieces], fidelity.particles), _seed(fidelity)
    return np.concatenate([fill(shape, count, seed) for shape, count in zip(scene.target, counts, strict=True)])


def _seed(fidelity: Fidelity) -> int:
    """Return the seed that particles are drawn by."""
    return int(fidelity.settings.get("particle_seed", 0))


def _boundary(scene: Scene, dt: float, options: PhysicsOptions) -> ToolsInRoom:
    lower, upper = scene.room() if options.walls else (np.full(3, -BEYOND), np.full(3, BEYOND))
    return ToolsInRoom(
        scene.tools,
        tuple(lower.tolist()),
        tuple(upper.tolist()),
        FLOOR,
        scene.floor_friction,
        options.softness,
        dt,
    )


def _rub(tool: Tool, factor: float) -> Tool:
    """Return the tool with its friction multiplied by a factor."""
    return replace(tool, friction=factor * tool.friction)


def _bodies(scene: Scene, fidelity: Fidelity, dx: float) -> tuple[Body, ...]:
    material = materials.Plasticine(1.0, YOUNG, scene.poisson, scene.yield_stress)
    counts, seed = shares([piece.shape for piece in scene.pieces], fidelity.particles), _seed(fidelity)
    # at density 1 the volume is the mass
    masses = [np.full(n, piece.particles * PARTICLE / n) for piece, n in zip(scene.pieces, counts, strict=True)]
    return tuple(
        Body(material, _sort_by_cell(fill(piece.shape, len(mass), seed), dx), volume=mass, ratio=np.ones(len(mass)))
        for piece, mass in zip(scene.pieces, masses, strict=True)
    )


def _sort_by_cell(x: np.ndarray, dx: float) -> np.ndarray:
    """Return particles cell by cell, so that particles at the same nodes are neighbours in memory."""
    return np.asarray(x[np.lexsort(np.floor(x / dx).T[::-1])])


# ---- What a plasticine scene looks like: bodies, tools and targets to draw.


def parts(
    scene: Scene,
    bodies: Sequence[Float[Tensor, "frame particle 3"]],
    tools: Float[Tensor, "frame slot 3"],
    target: np.ndarray,
) -> tuple[Part, ...]:
    """Return bodies, tools at their slots' poses, and targets: shapes, or the bodies' particles where they belong."""
    pitches = [(piece.shape.volume / x.shape[1]) ** (1 / 3) for piece, x in zip(scene.pieces, bodies, strict=True)]
    pieces = [
        Part("lump", "plasticine", x, (pitch,), tint=number)
        for number, (x, pitch) in enumerate(zip(bodies, pitches, strict=True))
    ]
    movers, slot = [], 0
    for tool in scene.tools:
        movers.append(_tool(tool, tools[:, slot : slot + tool.slots]))
        slot += tool.slots
    if scene.target:
        return (*pieces, *movers, *(_target(shape, len(tools)) for shape in scene.target))
    wanted = torch.split(torch.from_numpy(target), [x.shape[1] for x in bodies])
    goals = [
        Part("lump", "target", x.expand(len(tools), -1, 3), (pitch,)) for x, pitch in zip(wanted, pitches, strict=True)
    ]
    return (*pieces, *movers, *goals)


def view(scene: Scene) -> View:
    """Return the view of what bodies, tools at their starts and targets take up."""
    corners = [shape.bounds for shape in (*(piece.shape for piece in scene.pieces), *scene.target)]
    placed = [(anchor.tool, anchor.start) for anchor in scene.anchors] + list(scene.posts)
    corners += [(np.subtract(at, tool.radius), np.add(at, tool.radius)) for tool, at in placed]
    lower, upper = np.min([low for low, _ in corners], axis=0), np.max([high for _, high in corners], axis=0)
    lower[1] = 0.0
    return View(tuple(lower.tolist()), tuple(upper.tolist()), eye=(0.35, 0.55, 1.0), ground=FLOOR - 1 / 128)


def _tool(tool: Tool, pose: Float[Tensor, "frame slot 3"]) -> Part:
    turn = None
    if tool.kind is Kind.ROLLER:  # its axis starts along z; a capsule's is y
        spin, yaw, _ = pose[:, 1].unbind(1)
        turn = rotate_about(1, yaw) @ rotate_about(2, spin) @ rotate_about(0, torch.full_like(yaw, torch.pi / 2))
    material: episode.Material = "wood" if tool.kind in (Kind.ROLLER, Kind.CYLINDER) else "steel"
    shape: Any = "capsule" if tool.kind is Kind.ROLLER else tool.kind.name.lower()
    return Part(shape, material, pose[:, :1], tool.size, turn)


def _target(shape: Shape, frames: int) -> Part:
    at = torch.tensor(shape.center, dtype=torch.float64).expand(frames, 1, 3)
    if isinstance(shape, Box):
        return Part("box", "target", at, shape.widths)
    if isinstance(shape, Ball):
        return Part("sphere", "target", at, (shape.radius,))
    return Part("ring", "target", at, (shape.inner, shape.outer, shape.height))


DEMONSTRATION = "demonstration"  # the example that solves a scene
TERMS = ("density", "sdf", "contact")
MAX_CPU_WORK = 1e8  # particle-substeps of a demonstration that a CPU makes, so that all devices have the same target
REACH = 0.1  # what a policy measures lengths by [m]


@dataclass(frozen=True)
class PlasticineOptions(PhysicsOptions):
    """`loss` is that of the final frame, or summed over all control steps.

    `density`, `sdf` and `contact` are the weights of its terms. They compare the body's density with the target's, and
    measure the body's distance from the target and the tools' distance from the body.
    """

    loss: Literal["final", "sum"] = "final"
    density: float = 10.0
    sdf: float = 10.0
    contact: float = 500.0


class Plasticine(MpmScene):
    """Model: MLS-MPM, fixed-corotated elasticity, von Mises plasticity in log strain; x right, y up, z to the front.

    A yield stress is the norm of the deviatoric stress: in tension a body yields at sqrt(3/2) times as much. Young's
    modulus is 5000 Pa, density 1 kg/m^3, gravity 30 m/s^2; an episode lasts 0.1 s. Tools are signed distances that
    follow the parameters. They act on grid nodes, with Coulomb friction, through a shell (3.5 mm) in which their
    influence fades to nothing. The floor is thick: its nodes reach up to y = 1/32 m, and material below that height
    rests among them.
    Parameters: 5 segments x tools x 3. Each is a fraction of the tool's largest possible move, and lasts 10 control
    steps.
    Loss: 10 density + 10 sdf + 500 contact, at the end or summed over control steps (options; `terms` has each alone).
    density = sum |m - m*| over the masses of grid nodes [kg]. sdf = sum m D* [kg m], with D* the distance to the
    target's nearest node. contact = sum over tools of the squared distance to the closest particle [m^2]. The weight of
    contact is ours: the paper raised it without giving a value. At draft, 64 random points of table have losses of 8 to
    104 (5 to 95 %) with our weight, and the median share of contact is 71 %. The paper's colour bar goes from 14 to 86.
    PlasticineLab sums the loss over 50 control steps. Our default is the loss of the final frame, because the paper's
    colour bars match it. Summed, density and sdf of untouched bodies alone come to 271 in assembly, 678 in triple-move
    and 46 in writer, whose bars end at 44, 85 and 15. At the final frame they are 5.4, 13.6 and 0.9 (draft, contact=0).
    Targets: shapes, or the result of the scene's demonstration (an example) at the same fidelity. So a solution is
    known at every fidelity.
    Simplifications: a tool that only translates carries no rotation. A slippery room ends at the reach of the tools, or
    0.5 m beyond the bodies. Particles are spread evenly whatever a body weighs (upstream, its weight follows its number
    of particles). Departures from upstream: as many substeps as the grid needs (10 to 25 per control step at standard,
    19 upstream), an exact distance field, softness 666 everywhere, and no jump at a shell's end or on a sticky floor. A
    shell acts per time, not per substep. Only the closest particle gets the contact's gradient. Undeformed bodies have
    gradients too.
    Refinement: refine step and grid together. Velocities pass through the grid once per substep, which damps motion on
    the scale of a few cells, and more so with shorter steps on a given grid. On 64 cells with 4000 particles, the loss
    of one random episode of assembly grows by 1.3, 1.5 and 1.5 % as the step is halved from 2e-4 to 2.5e-5 s. That is
    not chaos: with 2000 particles at 1e-4 s, parameters 1e-8 apart end at most 1.3e-8 m apart at four random points of
    table and assembly.
    Source: PlasticineLab (Huang et al., ICLR 2021), as used in "Rethinking Optimization with Differentiable Simulation
    from a Global Perspective" (CoRL 2022).
    """

    model_version = 1
    fidelities: ClassVar[dict[str, Fidelity]] = fidelities(draft=(48, 1500, 14), standard=(80, 10_000, 25))
    Options: ClassVar[type[Any]] = PlasticineOptions
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"paper": {}}  # the scene as it is
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

    @property
    def view(self) -> View:  # type: ignore[override] # read only
        """How the scene is seen."""
        return view(self.scene)

    def memory(self) -> int:
        """Estimate the bytes one episode takes while it runs."""
        return super().memory() + Raster.bytes_per_row(self.model)

    def replicas(self) -> Mapping[str, Environment]:
        """Return the scene on grids moved along the floor by thirds of a cell, and with other particles.

        Each replica has its own target. Along y the grid stays, because the floor is as high as its highest node.
        """
        places = {f"grid moved by {x:.2f}, {z:.2f} cells": {"shift_x": x, "shift_z": z} for x, z in THIRDS}
        changes = {**places, "other particles": {"particle_seed": 1}}
        return self._replicas_of({name: {"settings": settings} for name, settings in changes.items()})

    def tools(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step_plus_1 slot 3"]:
        """Return tool positions at the ends of control steps [m]; a roller's second slot is (spin, yaw, 0) [rad]."""
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
    ) -> Stage:
        return Stage(make_solver(model, stop=stop, **settings), Raster(model, model.mass, **settings))

    def _prepare(self) -> None:
        _ = self._target

    def _loss_steps(self) -> Sequence[int]:
        return (self.model.steps,) if self.options.loss == "final" else range(1, self.model.steps + 1)

    def _losses(self, stage: Stage, step: int, end: Tensor, paths: Tensor) -> Float[Tensor, " batch"]:
        weights = paths.new_tensor([getattr(self.options, term) for term in TERMS])
        return (self._terms(stage, end, paths[:, step]) * weights).sum(dim=1)

    def _terms(
        self, stage: Stage, end: Float[Tensor, "batch particle 3"], tools: Float[Tensor, "batch slot 3"]
    ) -> Float[Tensor, "batch term"]:
        """Return the loss's terms at these positions of particles and tools."""
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

    def _tool_names(self) -> list[str]:
        return [f"tool {number}" for number in range(1, self.model.boundary.slots + 1)]

    def _parts(self, bodies: Sequence[Tensor], tools: Float[Tensor, "frame slot 3"]) -> tuple[Part, ...]:
        return parts(self.scene, bodies, tools, self._target_particles())

    @cached_property
    def _target(self) -> Target:
        """Target of the shape, on this model's grid."""
        with self._making:
            return Target.of(self.model, self._target_particles(), self.device)

    def _target_particles(self) -> np.ndarray:
        """Return the positions of the target's particles [m]."""
        if self.scene.target:
            return target(self.scene, self.fidelity)
        device = "cpu" if self.model.particle_substeps <= MAX_CPU_WORK else self.device
        model = f"model {self.version_on(self.engines[0])}, {__version__}"
        content = f"{self.scene} {self.fidelity} {self.examples[DEMONSTRATION]} {model}"
        content += "" if device == "cpu" else f" {device}"
        return load_or_make(f"{self.name}-{self.fidelity.name}", content, lambda: self._demonstrate(device))

    def _demonstrate(self, device: str) -> np.ndarray:
        demonstration = type(self)(fidelity=self.fidelity, device=device).end(self.example(DEMONSTRATION))
        return np.asarray(demonstration)
