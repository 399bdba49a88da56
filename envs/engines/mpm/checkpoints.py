"""What MLS-MPM stores of an episode: the particles of an instant, the grids of a substep, a control step whole."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import warp as wp

from ..runtime import fill_struct, precision
from .boundaries import LANES, SUMS
from .columns import arrays_of, list_struct
from .model import Box, Model, place_grid
from .stencil import particles

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

    @cached_property
    def particles(self) -> Any:
        """x, v and C as kernels take them."""
        vec3: Any = self.x.dtype
        return fill_struct(particles(vec3._wp_scalar_type_.__name__), {"x": self.x, "v": self.v, "C": self.C})


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

    def array(self, dtype: Any, size: int) -> wp.array:
        """Return zeros [environment, element]."""
        return wp.zeros((self.capacity, size), dtype=dtype, device=self.device)

    def frame(self) -> Frame:
        """Return a frame of zeros."""
        types, count = self.types, self.model.particles
        x, v, C = (self.array(kind, count) for kind in (types.vec3, types.vec3, types.mat33))
        states = (self.array(b.material.state(self.model.precision), len(b.x)) for b in self.model.groups)
        return Frame(x, v, C, tuple(states))

    def smoothed(self) -> dict[int, wp.array]:
        """Return zeros for the state of each body whose state is smoothed before a control step, by its number."""
        return {
            b: self.array(body.material.state(self.model.precision), len(body.x))
            for b, body in enumerate(self.model.groups)
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
        """A of the latest substep, for all tapes together, where sums are made by columns."""
        return self.affine_momentum()

    def lists(self, room: "Sizes") -> Any:
        """Return `Lists` of no particles."""
        sizes = {"order": self.model.particles, "planes": room.segments, "starts": room.columns}
        sizes |= {"nodes": room.nodes, "touched": 2}
        arrays = {field: self.array(wp.int32, size) for field, size in sizes.items()}
        arrays["full"] = wp.zeros(self.capacity, dtype=wp.int32, device=self.device)
        arrays["walks"] = self.array(wp.vec4i, 1 + room.nodes // 2)  # each has two nodes at least
        return fill_struct(list_struct(), arrays)

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


class Sizes(NamedTuple):
    """How many nodes, and by columns of cells how many columns and segments, arrays have places for."""

    nodes: int
    columns: int
    segments: int


def spare(count: int) -> int:
    """Return how many to make room for where so many are needed."""
    return count * 5 // 4


class Cycle(list[T]):
    """A list that begins again behind its end."""

    def __getitem__(self, number: Any) -> Any:
        """Return an element by a number that may be beyond the end."""
        return super().__getitem__(number % len(self))


class Tape:
    """Hold one control step whole: frames between its ends, grids of its substeps, and where they lie.

    A is that of every substep, by columns of the latest alone. Of what is smoothed before the step the state is there,
    and, of sums by columns, the `means` that nodes hold. Of a step in `pieces` it holds the frames at which these
    begin; for all else pieces share the room of one.
    """

    def __init__(self, allocator: Allocator, cells: int = 1, pieces: int = 1) -> None:
        model, columns = allocator.model, int(allocator.columns)  # arrays of nothing are none to Warp
        self._room = room = Sizes(cells, columns, columns)
        self.step = -1
        held = model.piece(pieces)
        inner = [allocator.frame() for _ in range(held - 1)]
        self.frames = [inner[s % held - 1] if s % held else allocator.frame() for s in range(1, model.substeps)]
        self.smoothed = allocator.smoothed()
        self.means = {b: allocator.nodes(cells) for b in self.smoothed if allocator.columns}
        self._kept = [allocator.affine_momentum() for _ in range(0 if allocator.columns else held)]
        self.A: Cycle[wp.array] = Cycle(self._kept or [allocator.latest_affine_momentum])
        self.grids: Cycle[Grid] = Cycle(allocator.grid(cells) for _ in range(held))
        self.lists: Cycle[Any] = Cycle(allocator.lists(room) for _ in range(held if allocator.columns else 0))
        self.box, self.lattice = NOWHERE, place_grid(model)
        self._allocator = allocator

    @property
    def bytes(self) -> int:
        """What its arrays take."""
        frames = [array for frame in set(self.frames) for array in frame.arrays()]
        lists = [array for one in self.lists for array in arrays_of(one)]
        return sum(array.capacity for array in (*frames, *self.smoothed.values(), *self._kept, *self._nodes, *lists))

    def growth(self, needed: Sizes) -> int:
        """Return the bytes that what is needed takes beyond what is there, 0 where that suffices."""
        return self._bytes_of(self._grown(needed)) - self._bytes_of(self._room)

    def bytes_on(self, needed: Sizes) -> int:
        """Return the bytes that a tape like this takes that is made for what is needed."""
        return self.bytes + self._bytes_of(self._spare(needed)) - self._bytes_of(self._room)

    def start(self, checkpoint: Frame) -> Frame:
        """Return the frame that the control step starts from: the checkpoint, with the states that are smoothed."""
        return replace(checkpoint, S=tuple(self.smoothed.get(b, S) for b, S in enumerate(checkpoint.S)))

    def make_room(self, step: int, box: Box, needed: Sizes) -> None:
        """Become the place of a control step that runs on a box of nodes, and needs so much room for it."""
        grown, less = self._grown(needed), self._room
        if box == self.box and grown == less:
            self.step = step
            return
        self.step, self.box, self._room = -1, NOWHERE, Sizes(0, 0, 0)  # should this be interrupted
        if grown.nodes > less.nodes:
            for substep in range(len(self.grids)):
                self.grids[substep] = self._allocator.grid(0)  # the old one goes first
                self.grids[substep] = self._allocator.grid(grown.nodes)
            for body in self.means:
                self.means[body] = self._allocator.nodes(0)
                self.means[body] = self._allocator.nodes(grown.nodes)
        if grown != less and self.lists:
            self.lists = Cycle(self._allocator.lists(grown) for _ in self.lists)
        self.step, self.box, self._room = step, box, grown
        self.lattice = place_grid(self._allocator.model, box)

    @property
    def cells(self) -> int:
        """How many nodes its grids have room for."""
        return self._room.nodes

    def room(self, nodes: int) -> int:
        """Return how many nodes to make room for where so many are needed."""
        return min(spare(nodes), self._allocator.model.cells)

    @property
    def _nodes(self) -> list[wp.array]:
        """Every array of nodes."""
        return [*(array for grid in self.grids for array in (grid.m, grid.v)), *self.means.values()]

    def _grown(self, needed: Sizes) -> Sizes:
        """Return what there has to be room for, of which what is there may be enough."""
        each = zip(self._room, needed, self._spare(needed), strict=True)
        return Sizes(*(more if less < enough else less for less, enough, more in each))

    def _spare(self, needed: Sizes) -> Sizes:
        """Return how much room to make where so much is needed."""
        return Sizes(self.room(needed.nodes), needed.columns * 3 // 2, needed.segments * 3 // 2)

    def _bytes_of(self, room: Sizes) -> int:
        """Return the bytes of so much room in all its grids and lists."""
        size = int(wp.types.type_size_in_bytes(self._allocator.types.vec4))
        integers = room.nodes + room.columns + room.segments + 4 * (1 + room.nodes // 2)
        each = size * room.nodes * len(self._nodes) + 4 * integers * len(self.lists)
        return each * self._allocator.capacity
