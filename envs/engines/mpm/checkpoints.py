"""What MLS-MPM stores of an episode: the particles of an instant, the grids of a substep, a control step whole."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

import warp as wp

from ..runtime import precision
from .cells import Lists, segments
from .exact import LANES, SUMS
from .model import Box, Model, place_grid

T = TypeVar("T")

NOWHERE = Box((0, 0, 0), (0, 0, 0))


@dataclass(frozen=True, eq=False)
class Frame:
    """The state of a batch at one instant, or its adjoint: arrays [environment, particle]."""

    x: wp.array
    v: wp.array
    C: wp.array
    S: tuple[wp.array, ...]

    def arrays(self) -> tuple[wp.array, ...]:
        """Return every array of the frame."""
        return (self.x, self.v, self.C, *self.S)


@dataclass(frozen=True, eq=False)
class Grid:
    """What nodes hold in one substep, [environment, node]: momentum and mass, then velocity; or the adjoints."""

    m: wp.array
    v: wp.array


class Allocator:
    """Allocate arrays of zeros for up to `capacity` environments of a model, those of `columns` or without."""

    def __init__(self, model: Model, capacity: int, device: str, *, columns: bool = False) -> None:
        self.model, self.capacity, self.device, self.columns = model, capacity, device, columns
        self.types = precision(model.precision)
        self.keeps_affine_momentum = model.keeps_affine_momentum or not columns

    def array(self, dtype: Any, size: int) -> wp.array:
        """Return zeros [environment, element]."""
        return wp.zeros((self.capacity, size), dtype=dtype, device=self.device)

    def frame(self) -> Frame:
        """Return a frame of zeros."""
        types, count = self.types, self.model.particles
        x, v, C = (self.array(kind, count) for kind in (types.vec3, types.vec3, types.mat33))
        states = (self.array(b.material.state(self.model.precision), len(b.x)) for b in self.model.bodies)
        return Frame(x, v, C, tuple(states))

    def smoothed(self) -> dict[int, wp.array]:
        """Return zeros for the state of each body whose state is smoothed before a control step, by its number."""
        return {
            b: self.array(body.material.state(self.model.precision), len(body.x))
            for b, body in enumerate(self.model.bodies)
            if body.material.smoothing
        }

    def grid(self, cells: int) -> Grid:
        """Return a grid of zeros."""
        return Grid(self.nodes(cells), self.nodes(cells))

    def nodes(self, cells: int) -> wp.array:
        """Return zeros for four numbers of each node, [environment, node]."""
        return self.array(self.types.vec4, cells)

    def affine_momentum(self) -> wp.array:
        """Return zeros for A, [environment, particle]."""
        return self.array(self.types.mat33, self.model.particles)

    @cached_property
    def latest_affine_momentum(self) -> wp.array:
        """A of the latest substep, for all tapes together, where no material keeps it."""
        return self.affine_momentum()

    def lists(self, segments: int) -> Lists:
        """Return lists of no particles."""
        full: wp.array = wp.zeros(self.capacity, dtype=wp.int32, device=self.device)
        order = self.array(wp.int32, self.model.particles)
        return Lists(order, full, self.array(wp.vec4i, segments), self.array(wp.int32, segments))

    def paths(self) -> wp.array:
        """Return zeros [environment, step, slot]."""
        shape = self.capacity, self.model.steps + 1, self.model.boundary.slots
        return wp.zeros(shape, dtype=self.types.vec3, device=self.device)

    def sums(self) -> wp.array:
        """Return the sums that the adjoint of the tools is made of on a GPU, [environment and lane, sum]."""
        if self.device == "cpu":
            return wp.zeros((1, 1), dtype=wp.int64)
        count = 2 * self.model.boundary.slots * 3 * SUMS[self.model.precision]
        return wp.zeros((self.capacity * LANES, count), dtype=wp.int64, device=self.device)


def segment_room(box: Box) -> int:
    """Return how many segments to make room for where a box is needed."""
    return segments(box) * 5 // 4


class Cycle(list[T]):
    """A list that begins again behind its end."""

    def __getitem__(self, number: Any) -> Any:
        """Return an element by a number that may be beyond the end."""
        return super().__getitem__(number % len(self))


class Tape:
    """Hold one control step whole: frames between its ends, grids of its substeps, and where they lie.

    A is that of every substep where a material keeps it. Of what is smoothed before the step the state is there, and,
    of sums by columns, the `means` that nodes hold. Of a step in `pieces` it holds the frames at which these begin; for
    all else pieces share the room of one.
    """

    def __init__(self, allocator: Allocator, cells: int = 1, pieces: int = 1) -> None:
        model = allocator.model
        self.step = -1
        held = model.piece(pieces)
        inner = [allocator.frame() for _ in range(held - 1)]
        self.frames = [inner[s % held - 1] if s % held else allocator.frame() for s in range(1, model.substeps)]
        self.smoothed = allocator.smoothed()
        self.means = {b: allocator.nodes(cells) for b in self.smoothed if allocator.columns}
        self._kept = [allocator.affine_momentum() for _ in range(held if allocator.keeps_affine_momentum else 0)]
        self.A: Cycle[wp.array] = Cycle(self._kept or [allocator.latest_affine_momentum])
        self.grids: Cycle[Grid] = Cycle(allocator.grid(cells) for _ in range(held))
        self.lists: Cycle[Lists] = Cycle(allocator.lists(1) for _ in range(held if allocator.columns else 0))
        self.box, self.lattice = NOWHERE, place_grid(model)
        self._allocator = allocator

    @property
    def bytes(self) -> int:
        """What its arrays take."""
        frames = [array for frame in set(self.frames) for array in frame.arrays()]
        lists = [array for one in self.lists for array in one.arrays()]
        return sum(array.capacity for array in (*frames, *self.smoothed.values(), *self._kept, *self._nodes, *lists))

    def growth(self, box: Box) -> int:
        """Return the bytes that a box of nodes takes beyond those that are there, 0 where these suffice."""
        if box == self.box:
            return 0
        more_cells = self.room(box) - self._cells if self._cells < box.cells else 0
        more_segments = segment_room(box) - self._segments if self.lists and self._segments < segments(box) else 0
        return self._bytes_of(more_cells, more_segments)

    def bytes_on(self, box: Box) -> int:
        """Return the bytes that a tape like this takes that is made for a box of nodes."""
        more_segments = segment_room(box) - self._segments if self.lists else 0
        return self.bytes + self._bytes_of(self.room(box) - self._cells, more_segments)

    def start(self, checkpoint: Frame) -> Frame:
        """Return the frame that the control step starts from: the checkpoint, with the states that are smoothed."""
        return replace(checkpoint, S=tuple(self.smoothed.get(b, S) for b, S in enumerate(checkpoint.S)))

    def make_room(self, step: int, box: Box) -> None:
        """Become the place of a control step that runs on a box of nodes."""
        self.step = step
        if box == self.box:
            return
        self.step, self.box = -1, NOWHERE
        if self._cells < box.cells:
            for substep in range(len(self.grids)):
                self.grids[substep] = self._allocator.grid(0)  # the old one goes first
                self.grids[substep] = self._allocator.grid(self.room(box))
            for body in self.means:
                self.means[body] = self._allocator.nodes(0)
                self.means[body] = self._allocator.nodes(self.room(box))
        if self.lists and self._segments < segments(box):
            self.lists = Cycle(self._allocator.lists(segment_room(box)) for _ in self.lists)
        self.step, self.box, self.lattice = step, box, place_grid(self._allocator.model, box)

    @property
    def _cells(self) -> int:
        """How many nodes all its grids have room for."""
        return min(int(array.shape[1]) for array in self._nodes)

    @property
    def _nodes(self) -> list[wp.array]:
        """Every array of nodes."""
        return [*(array for grid in self.grids for array in (grid.m, grid.v)), *self.means.values()]

    @property
    def _segments(self) -> int:
        """How many segments all its lists have room for."""
        return min(int(lists.planes.shape[1]) for lists in self.lists)

    def room(self, box: Box) -> int:
        """Return how many nodes to make room for where a box is needed."""
        return int(min(box.cells * 5 // 4, self._allocator.model.cells))

    def _bytes_of(self, cells: int, segments: int) -> int:
        """Return the bytes of so many nodes of all its grids, and segments of all its lists."""
        size = int(wp.types.type_size_in_bytes(self._allocator.types.vec4))
        each = size * cells * len(self._nodes) + 4 * 5 * segments * len(self.grids)
        return each * self._allocator.capacity
