"""What particles give to nodes, p2g and the adjoint of g2p: added in place on a CPU, by columns of cells on a GPU."""

from __future__ import annotations

import abc
import weakref
from functools import partial
from operator import attrgetter
from typing import Any

import warp as wp

from ..runtime import fill_struct, load
from .checkpoints import Frame, spare
from .columns import (
    CPU_TEAM,
    GPU_TEAM,
    PARTS,
    SEGMENT,
    SIZES,
    STRETCH,
    cell_kernels,
    column_kernels,
    count_struct,
    segments,
    whole_warps,
)
from .model import Box

nodes = attrgetter("cells")  # of a box


class Scatter(abc.ABC):
    """The scatters of a solver, each as launches of the control step under way."""

    def __init__(self, solver: Any) -> None:
        self.solver = weakref.proxy(solver)  # which holds this

    def make_room(self, box: Box) -> bool:
        """Make room for a box of nodes, and say whether arrays were replaced."""
        return False

    def begin(self) -> None:  # noqa: B027 -- in place there is nothing to forget,
        """Forget what a run that was interrupted has left."""

    def list_particles(  # noqa: B027 -- nor to list
        self, step: int, substep: int, frame: Frame, batch: int, *, counted: bool
    ) -> None:
        """Find out where particles are, before a substep; g2p may have `counted` them already."""

    def where(self, step: int, substep: int) -> list[Any]:
        """Return what says where nodes are in grids, as kernels that gather take it."""
        return [self.solver.tape(step).lattice]

    def counting(self, counted: bool) -> list[Any]:
        """Return what g2p takes so as to count particles where it moves them to."""
        return []

    @abc.abstractmethod
    def p2g(self, step: int, substep: int, frame: Frame, batch: int) -> None:
        """Fill the substep's grid with momentum and mass, but for what nodes have to add up themselves."""

    @abc.abstractmethod
    def adjoint_g2p(
        self, step: int, substep: int, frame: Frame, new: Frame, grid_v: wp.array, adj_x: wp.array, batch: int
    ) -> None:
        """Fill the adjoint of the grid's velocity likewise, from those of the frame `new`.

        In place, it sets that of x; by columns, what gathers the adjoint of p2g does so.
        """

    def to_add_up(self, step: int, substep: int) -> list[Any]:
        """Return what nodes add up themselves, as their kernel takes it."""
        return []


class InPlace(Scatter):
    """Every particle adds to its nodes, in the order of particles."""

    def p2g(self, step: int, substep: int, frame: Frame, batch: int) -> None:
        """Fill the substep's grid with momentum and mass."""
        solver, tape = self.solver, self.solver.tape(step)
        grid = tape.grids[substep].m
        self._clear(grid, step, batch)
        inputs = [tape.lattice, solver.orders[step].mass, frame.x, frame.v, tape.A[substep], grid]
        solver.launch(solver.kernels.p2g, solver.model.particles, batch, inputs)

    def adjoint_g2p(
        self, step: int, substep: int, frame: Frame, new: Frame, grid_v: wp.array, adj_x: wp.array, batch: int
    ) -> None:
        """Fill the adjoint of the grid's velocity, and set that of x, from those of the frame `new`."""
        solver, tape = self.solver, self.solver.tape(step)
        self._clear(grid_v, step, batch)
        inputs = [tape.lattice, solver.model.dt, frame.x, tape.grids[substep].v, new.x, new.v, new.C, grid_v, adj_x]
        solver.launch(solver.kernels.adjoint_g2p, solver.model.particles, batch, inputs)

    def _clear(self, grid: wp.array, step: int, batch: int) -> None:
        """Zero what a control step uses of a grid, by numpy: torch would spread it over threads that others want."""
        solver, values = self.solver, grid.numpy()[:batch]
        solver.launches.call(lambda: values[:, : solver.boxes[step].cells].fill(0.0))


class ByColumns(Scatter):
    """Warps walk columns of cells, and nodes add up what columns give them: one order of sums, whatever the batch."""

    def __init__(self, solver: Any) -> None:
        super().__init__(solver)
        model, device, allocator = solver.model, solver.device, solver.allocator
        self.team = CPU_TEAM if device == "cpu" else GPU_TEAM
        self.kernels = column_kernels(model.precision, self.team)
        self.listing = cell_kernels(model.precision)
        load([self.kernels.p2g, self.listing.count], device)
        fixed = {"used": 2, "sizes": SIZES} | dict.fromkeys(("cells", "numbers", "arrived"), model.particles)
        self.fixed = {field: allocator.array(wp.int32, count) for field, count in fixed.items()}
        self._allocate(1)

    def make_room(self, box: Box) -> bool:
        """Make room for a box of nodes, and say whether arrays were replaced."""
        if segments(box) * PARTS <= self.parts.shape[1]:
            return False
        self._allocate(0)  # the old ones go first
        self._allocate(spare(segments(box)))
        return True

    def begin(self) -> None:
        """Forget what a run that was interrupted has left."""
        for array in (self.counts.counts, self.counts.used, self.counts.sizes, self.counts.spans):
            array.zero_()

    def list_particles(self, step: int, substep: int, frame: Frame, batch: int, *, counted: bool) -> None:
        """Find out where particles are, before a substep; g2p may have `counted` them already."""
        solver, tape, kernels = self.solver, self.solver.tape(step), self.listing
        lists, count = tape.lists[substep], solver.model.particles
        if not counted:
            solver.launch(kernels.count, count, batch, [tape.lattice, frame.x, self.counts])
        inputs = [tape.lattice, self.counts, lists]
        by_segment, by_column = lambda box: whole_warps(segments(box)), lambda box: whole_warps(max(count, box.columns))
        solver.launch_on_box(kernels.place_segments, by_segment, batch, [*inputs, self.stretch(batch)])
        solver.launch_on_box(kernels.place, by_column, batch, inputs)
        solver.launch(kernels.tidy, count, batch, [*inputs, solver.needed])

    def where(self, step: int, substep: int) -> list[Any]:
        """Return what says where nodes are in grids, as kernels that gather take it."""
        tape = self.solver.tape(step)
        return [tape.lattice, tape.lists[substep].starts]

    def counting(self, counted: bool) -> list[Any]:
        """Return what g2p takes so as to count particles where it moves them to."""
        return [self.counts, int(counted)]

    def p2g(self, step: int, substep: int, frame: Frame, batch: int) -> None:
        """Make parts of what nodes get of momentum and mass."""
        inputs = [self.solver.orders[step].mass, frame.particles, self.solver.tape(step).A[substep]]
        self.walk(self.kernels.p2g, step, substep, batch, inputs)

    def adjoint_g2p(
        self, step: int, substep: int, frame: Frame, new: Frame, grid_v: wp.array, adj_x: wp.array, batch: int
    ) -> None:
        """Make parts of the adjoint of the grid's velocity, from those of the frame `new`."""
        inputs = [self.solver.model.dt, frame.x, new.particles]
        self.walk(self.kernels.adjoint_g2p, step, substep, batch, inputs)

    def walk(self, kernel: Any, step: int, substep: int, batch: int, inputs: list[Any]) -> None:
        """Launch a kernel that leaves parts of sums at nodes, after the substep's lists."""
        tape = self.solver.tape(step)
        given = [tape.lattice, batch, tape.lists[substep], *inputs, self.parts]
        self.solver.launch_on_box(kernel, partial(self.team.threads, stretch=self.stretch(batch)), batch, given)

    def stretch(self, batch: int) -> int:
        """Return how many planes a walk leaves."""
        return STRETCH if self.solver.small(batch) else SEGMENT

    def add_up(self, kernel: Any, step: int, substep: int, batch: int, grids: list[wp.array]) -> None:
        """Launch a kernel that adds up the parts at nodes."""
        inputs = [self.solver.tape(step).lattice, *self.to_add_up(step, substep), *grids]
        self.solver.launch_at_nodes(kernel, step, batch, inputs)

    def to_add_up(self, step: int, substep: int) -> list[Any]:
        """Return what nodes add up themselves, as their kernel takes it."""
        return [self.solver.tape(step).lists[substep], self.parts]

    def _allocate(self, count: int) -> None:
        """Allocate what so many segments take."""
        allocator = self.solver.allocator
        self.parts: wp.array = allocator.array(allocator.types.vec4, count * PARTS)
        walks = count * (SEGMENT // STRETCH)
        kinds = {"counts": (wp.int32, count * SEGMENT), "places": (wp.vec2i, count * SEGMENT)}
        kinds |= {"found": (wp.vec4i, walks), "ranks": (wp.int32, walks)}
        kinds |= {"spans": (wp.int32, count * 2)}  # of columns, of which there are no more
        sized = {field: allocator.array(kind, size) for field, (kind, size) in kinds.items()}
        self.counts = fill_struct(count_struct(), self.fixed | sized)
