"""What a plasticine scene is made of, and the model a solver simulates it by."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from ..base import Fidelity
from ..engines.mpm.materials import Plasticine
from ..engines.mpm.model import Body, Model
from ..engines.mpm.tools import Kind, Tool, ToolsInRoom
from ..options import EpisodeOptions
from .scene import STEPS
from .shapes import Point, Shape, fill, shares

SPAN = 2e-3  # length of a control step [s]
YOUNG, GRAVITY, SOFTNESS = 5000.0, 30.0, 666.0  # [Pa] at a density of 1 kg/m^3; [m/s^2]; [1/m]
PARTICLE = (1 / 128) ** 2  # PlasticineLab's particle mass [kg], which sets the scale of its losses
FLOOR, WALLS = 2.5 / 64, (2.5 / 64, 61.5 / 64)  # nodes outside belong to floor and walls [m]
ROOM = 0.15, 0.5  # least and most that the room extends beyond the bodies [m]
BEYOND = 1e6  # where walls are that no body meets [m]
MARGIN = 2  # nodes outside the walls


def fidelities(*, draft: tuple[int, int, int], standard: tuple[int, int, int]) -> dict[str, Fidelity]:
    """Return a scene's fidelities, of (cells per metre, particles, substeps of a control step) each.

    The reference has a finer grid than all standards and, as they have, about the longest step that is stable on it:
    grid and step are refined together.
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
    """What the model's parts are multiplied by, 1 being the scene's own and 0 leaving the part out.

    `tool_friction` and `floor_friction` (a sticky floor's is 10, and less than that rubs), `yield_stress` (1e6: an
    elastic body), `poisson` (its ratio) and `gravity`. `softness` [1/m] is that of the shell through which tools are
    felt (1e5: they are felt at their surface alone). Without `walls` the room has neither walls nor lid, and an episode
    escapes where plasticine leaves the grid. Raises ValueError where one is below 0.
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

    @property
    def reach(self) -> Point:
        """How far the tool gets along each axis in one control step [m]."""
        if self.tool.kind is Kind.ROLLER:
            rolled = self.tool.size[1] * self.step[0]
            return rolled, self.step[2], rolled
        return self.step


@dataclass(frozen=True)
class Scene:
    """All that makes one scene; `posts` are tools that stay, `target` is empty where a demonstration makes it."""

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
        """Return the scene with its material and frictions as options say."""
        return replace(
            self,
            yield_stress=self.yield_stress * options.yield_stress,
            floor_friction=self.floor_friction * options.floor_friction,
            poisson=self.poisson * options.poisson,
            anchors=tuple(replace(a, tool=_rub(a.tool, options.tool_friction)) for a in self.anchors),
            posts=tuple((_rub(tool, options.tool_friction), at) for tool, at in self.posts),
        )

    def room(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of what tools can push bodies through [m]: where walls stand."""
        corners = [shape.bounds for shape in (*(piece.shape for piece in self.pieces), *self.target)]
        reach = np.clip(STEPS * np.max([anchor.reach for anchor in self.anchors], axis=0), *ROOM)
        lower = np.min([low for low, _ in corners], axis=0) - reach
        upper = np.max([high for _, high in corners], axis=0) + reach
        return np.maximum(lower, [WALLS[0], 0.0, WALLS[0]]), np.minimum(upper, WALLS[1])


def model(scene: Scene, fidelity: Fidelity, steps: int = STEPS, options: PhysicsOptions = PhysicsOptions()) -> Model:
    """Return a scene's model of so many control steps: bodies at rest, tools, and a grid that covers its room."""
    dx = 1.0 / fidelity.resolution
    scene = scene.altered(options)
    lower, upper = scene.room()
    first = np.floor(lower / dx).astype(int) - MARGIN
    last = np.ceil(upper / dx).astype(int) + MARGIN
    return Model(
        precision=fidelity.precision,
        bodies=_bodies(scene, fidelity.particles, dx),
        boundary=_boundary(scene, fidelity.dt, options),
        origin=tuple((first * dx).tolist()),
        dx=dx,
        nodes=tuple((last - first + 1).tolist()),
        dt=fidelity.dt,
        substeps=round(SPAN / fidelity.dt),
        steps=steps,
        gravity=GRAVITY * options.gravity,
    )


def target(scene: Scene, particles: int) -> np.ndarray:
    """Return the particles of a target that is made of shapes [m], shape (particle, 3)."""
    counts = shares([piece.shape for piece in scene.pieces], particles)
    return np.concatenate([fill(shape, count) for shape, count in zip(scene.target, counts, strict=True)])


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
    """Return the tool with so many times its friction."""
    return replace(tool, friction=factor * tool.friction)


def _bodies(scene: Scene, particles: int, dx: float) -> tuple[Body, ...]:
    material = Plasticine(1.0, YOUNG, scene.poisson, scene.yield_stress)
    counts = shares([piece.shape for piece in scene.pieces], particles)
    # at density 1 the volume is the mass
    masses = [np.full(n, piece.particles * PARTICLE / n) for piece, n in zip(scene.pieces, counts, strict=True)]
    return tuple(
        Body(material, _sort_by_cell(fill(piece.shape, len(mass)), dx), volume=mass, ratio=np.ones(len(mass)))
        for piece, mass in zip(scene.pieces, masses, strict=True)
    )


def _sort_by_cell(x: np.ndarray, dx: float) -> np.ndarray:
    """Return particles cell by cell, so that those that meet the same nodes are neighbours in memory."""
    return np.asarray(x[np.lexsort(np.floor(x / dx).T[::-1])])
