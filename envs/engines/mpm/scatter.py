"""What particles give to nodes, p2g and the adjoint of g2p: added in place on a CPU, by columns of cells on a GPU."""

from __future__ import annotations

import weakref
from typing import Any, Protocol

import warp as wp

from ..runtime import load
from .cells import Lister, Lists, segments
from .checkpoints import Frame
from .columns import PARTS, column_kernels
from .model import Box

LANES = 32  # threads that walk a segment together on a GPU


class Scatter(Protocol):
    """The scatters of a solver, each as launches of the control step under way."""

    def make_room(self, box: Box) -> bool:
        """Make room for a box of nodes, and say whether arrays were replaced."""

    def list_particles(self, step: int, substep: int, frame: Frame, batch: int) -> None:
        """Find out where particles are, before a substep."""

    def p2g(self, step: int, substep: int, frame: Frame, batch: int) -> None:
        """Fill the substep's grid with momentum and mass."""

    def adjoint_g2p(
        self, step: int, substep: int, frame: Frame, new: Frame, grid_v: wp.array, adj_x: wp.array, batch: int
    ) -> None:
        """Fill the adjoint of the grid's velocity, and set that of x, from those of the frame `new`."""


class InPlace:
    """Every particle adds to its nodes, in the order of particles."""

    def __init__(self, solver: Any) -> None:
        self.solver = weakref.proxy(solver)

    def make_room(self, box: Box) -> bool:
        """Make room for a box of nodes, and say whether arrays were replaced."""
        return False

    def list_particles(self, step: int, substep: int, frame: Frame, batch: int) -> None:
        """Find out where particles are, before a substep."""

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
        self._clear(grid_v, step, batch)
        launch_adjoint_g2p(self.solver, step, substep, frame, new, grid_v, adj_x, batch)

    def _clear(self, grid: wp.array, step: int, batch: int) -> None:
        """Zero what a control step uses of a grid, by numpy: torch would spread it over threads that others want."""
        solver, values = self.solver, grid.numpy()[:batch]
        solver.launches.call(lambda: values[:, : solver.boxes[step].cells].fill(0.0))


class ByColumns:
    """Warps walk columns of cells, and nodes add up what columns give them: one order of sums, whatever the batch."""

    def __init__(self, solver: Any) -> None:
        model, device = solver.model, solver.device
        self.solver = weakref.proxy(solver)
        self.lister = Lister(model.precision, model.particles, solver.capacity, device)
        self.kernels = column_kernels(model.precision)
        load([self.kernels.p2g, self.lister.kernels.label], device)
        self.lanes = 1 if device == "cpu" else LANES
        self.parts = self._room(1)

    def make_room(self, box: Box) -> bool:
        """Make room for a box of nodes, and say whether arrays were replaced."""
        wanted = segments(box) * PARTS
        if wanted <= self.parts.shape[1]:
            return False
        self.parts = self._room(0)  # the old one goes first
        self.parts = self._room(wanted * 5 // 4)
        return True

    def list_particles(self, step: int, substep: int, frame: Frame, batch: int) -> None:
        """Find out where particles are, before a substep."""
        solver, tape, lister = self.solver, self.solver.tape(step), self.lister
        lists: Lists = tape.lists[substep]
        count = solver.model.particles
        solver.launch(lister.kernels.label, count, batch, [tape.lattice, frame.x, lister.keys, lister.places])
        solver.launches.call(lambda: lister.sort(solver.boxes[step], batch))
        solver.launch_on_box(lister.kernels.forget, segments, step, batch, [tape.lattice, lists.first, lists.end])
        inputs = [tape.lattice, lister.keys, lister.places, lists.order, lists.first, lists.end]
        solver.launch(lister.kernels.list_cells, count, batch, inputs)

    def p2g(self, step: int, substep: int, frame: Frame, batch: int) -> None:
        """Fill the substep's grid with momentum and mass."""
        tape = self.solver.tape(step)
        inputs = [self.solver.orders[step].mass, frame.x, frame.v, tape.A[substep]]
        self.walk(self.kernels.p2g, step, substep, batch, inputs)
        self.add_up(self.kernels.add_up, step, substep, batch, [tape.grids[substep].m])

    def adjoint_g2p(
        self, step: int, substep: int, frame: Frame, new: Frame, grid_v: wp.array, adj_x: wp.array, batch: int
    ) -> None:
        """Fill the adjoint of the grid's velocity, and set that of x, from those of the frame `new`."""
        launch_adjoint_g2p(self.solver, step, substep, frame, new, grid_v, adj_x, batch)
        inputs = [self.solver.model.dt, frame.x, new.x, new.v, new.C]
        self.walk(self.kernels.adjoint_g2p, step, substep, batch, inputs)
        self.add_up(self.kernels.add_up, step, substep, batch, [grid_v])

    def walk(self, kernel: Any, step: int, substep: int, batch: int, inputs: list[Any]) -> None:
        """Launch a kernel that leaves parts of sums at nodes, after the substep's lists."""
        tape = self.solver.tape(step)
        lists: Lists = tape.lists[substep]
        given = [tape.lattice, self.lanes, lists.order, lists.first, lists.end, *inputs, self.parts]
        self.solver.launch_on_box(kernel, self._threads, step, batch, given)

    def add_up(self, kernel: Any, step: int, substep: int, batch: int, grids: list[wp.array]) -> None:
        """Launch a kernel that adds up the parts at nodes."""
        tape = self.solver.tape(step)
        inputs = [tape.lattice, tape.lists[substep].end, self.parts, *grids]
        self.solver.launch_on_box(kernel, nodes, step, batch, inputs)

    def _threads(self, box: Box) -> int:
        return segments(box) * self.lanes

    def _room(self, parts: int) -> wp.array:
        array: wp.array = self.solver.allocator.array(self.solver.types.vec4, parts)
        return array


def nodes(box: Box) -> int:
    """Return the number of nodes of a box."""
    return box.cells


def launch_adjoint_g2p(
    solver: Any, step: int, substep: int, frame: Frame, new: Frame, grid_v: wp.array, adj_x: wp.array, batch: int
) -> None:
    """Launch the transfers' adjoint of g2p."""
    tape = solver.tape(step)
    inputs = [tape.lattice, solver.model.dt, frame.x, tape.grids[substep].v, new.x, new.v, new.C, grid_v, adj_x]
    solver.launch(solver.kernels.adjoint_g2p, solver.model.particles, batch, inputs)
