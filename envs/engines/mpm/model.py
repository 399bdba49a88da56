"""What a batch of MLS-MPM episodes shares: bodies, boundary, grid, time; and which of the grid's nodes matter when."""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import warp as wp

from ..runtime import precision
from .boundaries import Boundary
from .materials import Fluid, Material
from .stencil import lattice

BOX_MARGIN = 1  # cells around the particles that a control step begins with
SPREAD = 1.5  # times the nodes that bodies touch at rest, for which memory is estimated, too
TRAVEL = 5  # cells that bodies move beyond where they were at rest, for estimates of memory
ON_NODE = 2e-4  # halves of a cell between a wall and its nodes, at most
EMPTY = 1e-8  # nodes lighter than this part of the lightest particle carry no velocity


@dataclass(frozen=True, eq=False)
class Body:
    """One body: positions `x` [m], shape (particle, 3), `volume` [m^3] and initial `ratio` J, shape (particle,)."""

    material: Material
    x: np.ndarray
    volume: np.ndarray
    ratio: np.ndarray

    @property
    def mass(self) -> np.ndarray:
        """Mass of each particle [kg]."""
        return self.material.density * self.volume

    def joined(self, other: "Body") -> "Body":
        """Return one body that is both of these, of one material."""
        pairs = ((getattr(self, key), getattr(other, key)) for key in ("x", "volume", "ratio"))
        return Body(self.material, *map(np.concatenate, pairs))


@dataclass(frozen=True, eq=False)
class Model:
    """Everything a batch of episodes shares. Lengths [m], times [s]; `nodes` of the grid along x, y, z."""

    precision: str
    bodies: tuple[Body, ...]
    boundary: Boundary
    origin: tuple[float, float, float]
    dx: float
    nodes: tuple[int, int, int]
    dt: float
    substeps: int
    steps: int
    gravity: float = 9.81

    @cached_property
    def groups(self) -> tuple[Body, ...]:
        """Return the bodies as they are simulated: neighbours of one material as one, unless it is smoothed by body."""
        groups: list[Body] = []
        for body in self.bodies:
            if groups and body.material == groups[-1].material and not body.material.smoothing:
                body = groups.pop().joined(body)
            groups.append(body)
        return tuple(groups)

    @property
    def particles(self) -> int:
        """Number of particles of all bodies."""
        return sum(len(body.x) for body in self.bodies)

    @property
    def particle_substeps(self) -> int:
        """Number of particles times that of an episode's substeps."""
        return self.particles * self.steps * self.substeps

    @property
    def mass(self) -> np.ndarray:
        """Mass of each particle of all bodies [kg], shape (particle,)."""
        return np.concatenate([body.mass for body in self.bodies])

    @property
    def volume(self) -> np.ndarray:
        """Volume of each particle of all bodies [m^3], shape (particle,)."""
        return np.concatenate([body.volume for body in self.bodies])

    @property
    def cells(self) -> int:
        """Number of nodes of the grid."""
        return int(np.prod(self.nodes))

    def piece(self, pieces: int) -> int:
        """Return how many substeps a piece has where a control step is in so many; the last one may have fewer."""
        return -(-self.substeps // pieces)

    def bytes_per_environment(self, tapes: int, *, columns: bool = False, pieces: int = 1) -> int:
        """Return about what an environment takes of a solver that stores so many control steps whole, with adjoints.

        Grids are counted as large as around the bodies at rest and TRAVEL cells farther on all sides; by `columns`, of
        SPREAD times the nodes that bodies touch there. Sums then take 45 numbers a node, and each substep has lists of
        integers. Of a step in `pieces` one is stored, and a frame for each of the others.
        """
        state = sum(len(body.x) * (1 if isinstance(body.material, Fluid) else 9) for body in self.bodies)
        frame = 15 * self.particles + state  # x, v, C and each material's own
        nodes = nodes_around(self, *self.corners, BOX_MARGIN + TRAVEL).cells
        held = min(nodes, math.ceil(SPREAD * self.touched)) if columns else nodes
        stored = tapes * self.piece(pieces)
        numbers = (self.steps + 3 + tapes * (pieces - 1)) * frame + (stored + 1) * (frame + 8 * held)
        numbers += 9 * self.particles * (1 if columns else stored + 1)  # A
        if not columns:
            return self.real_bytes * numbers
        means = 4 * tapes * sum(body.material.smoothing > 0 for body in self.bodies)
        integers = (stored + 3) * (self.particles + nodes // 4 + 3 * held)
        return self.real_bytes * (numbers + 45 * nodes + means * held) + 4 * integers

    @cached_property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest coordinates of particles at rest [m], each of shape (3,)."""
        x = np.concatenate([body.x for body in self.bodies])
        return x.min(axis=0), x.max(axis=0)

    @cached_property
    def touched(self) -> int:
        """Return how many nodes particles at rest touch, with those that lie between such along z."""
        x = np.concatenate([body.x for body in self.bodies])
        base = np.unique(np.floor((x - self.origin) / self.dx - 0.5).astype(int), axis=0)
        base = np.clip(base, 0, np.array(self.nodes) - 3)
        low, high = np.full(self.nodes[:2], self.nodes[2]), np.zeros(self.nodes[:2], dtype=int)
        for i, j in product(range(3), repeat=2):
            columns = base[:, 0] + i, base[:, 1] + j
            np.minimum.at(low, columns, base[:, 2])
            np.maximum.at(high, columns, base[:, 2] + 3)
        return int((high - low).clip(0).sum())

    @property
    def real_bytes(self) -> int:
        """Bytes of one number."""
        return 8 if self.precision == "float64" else 4


@dataclass(frozen=True)
class Box:
    """A box of nodes: the `first` of them, and how many there are along x, y, z."""

    first: tuple[int, int, int]
    nodes: tuple[int, int, int]

    @property
    def cells(self) -> int:
        """Number of nodes."""
        return math.prod(self.nodes)

    @property
    def columns(self) -> int:
        """Number of columns of nodes, along z."""
        return self.nodes[0] * self.nodes[1]

    def around(self, other: "Box") -> "Box":
        """Return the smallest box that holds this one and another."""
        spans = [
            (min(a, b), max(a + n, b + m))
            for a, n, b, m in zip(self.first, self.nodes, other.first, other.nodes, strict=True)
        ]
        (x, y, z), (nx, ny, nz) = zip(*((low, high - low) for low, high in spans), strict=True)
        return Box((x, y, z), (nx, ny, nz))


def place_grid(model: Model, box: Box | None = None) -> Any:
    """Return where a model's grid lies, for the transfer kernels: the nodes in `box`, or all."""
    first, nodes = (box.first, box.nodes) if box else ((0, 0, 0), model.nodes)
    placed = lattice(model.precision)()
    placed.origin = precision(model.precision).vec3(*model.origin)
    placed.inv_dx = 1.0 / model.dx
    placed.first = wp.vec3i(*first)
    placed.nx, placed.ny, placed.nz = nodes
    below, above = walls_that_reflect(model)
    placed.below, placed.above = wp.vec3i(*below), wp.vec3i(*above)
    return placed


def walls_that_reflect(model: Model) -> tuple[list[int], list[int]]:
    """Return where walls are that reflect, the lower and the upper one along each axis; 0 where none is.

    Places are in halves of a cell from the grid's first node. A wall reflects only on nodes and half-way between them.
    """
    found: tuple[list[int], list[int]] = ([0, 0, 0], [0, 0, 0])
    for side, places in enumerate(model.boundary.mirrors):
        for axis, place in enumerate(places):
            halves = 2 * (place - model.origin[axis]) / model.dx if place is not None else 0.0
            if 1.5 < halves < 2 * model.nodes[axis] - 3.5 and abs(halves - round(halves)) < ON_NODE:
                found[side][axis] = round(halves)
    return found


def nodes_around(model: Model, low: np.ndarray, high: np.ndarray, margin: int, grain: int = 1) -> Box:
    """Return the nodes that particles between two corners [m], shape (3,), touch while none moves `margin` cells.

    It begins and ends at multiples of `grain`, or with the grid.
    """
    if not np.isfinite([low, high]).all():
        return Box((0, 0, 0), model.nodes)
    farthest = max(model.nodes)  # from the grid that matters; an exploded body may be beyond what an integer holds
    spans = []
    for origin, count, lowest, highest in zip(model.origin, model.nodes, low.tolist(), high.tolist(), strict=True):
        first = math.floor(min(max((lowest - origin) / model.dx - 0.5, -farthest), farthest)) - margin
        end = math.floor(min(max((highest - origin) / model.dx + 1.5, -farthest), farthest)) + margin
        first = min(max(first // grain * grain, 0), count - 3)
        spans.append((first, max(min(-(-end // grain) * grain, count - 1) - first, 2) + 1))
    firsts, counts = zip(*spans, strict=True)
    return Box(firsts, counts)
