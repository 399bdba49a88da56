"""The backward pass of MLS-MPM: the adjoints of the states of particles, control step by control step, and of tools."""

import weakref
from collections.abc import Mapping
from typing import Any

import torch
import warp as wp

from ..runtime import load, to_torch
from .checkpoints import Frame
from .exact import settle_kernel
from .stencil import lattice


class Adjoint:
    """Hold the adjoint arrays of a solver and run its backward pass."""

    def __init__(self, solver: Any) -> None:
        self.solver = weakref.proxy(solver)  # which holds this: a cycle would keep a GPU's memory until it is collected
        self.new, self.old = solver.allocator.frame(), solver.allocator.frame()
        self.A = None if solver.columns else solver.allocator.affine_momentum()
        self.grid = solver.allocator.grid(max(tape.cells for tape in solver.tapes))
        self.tools = solver.allocator.paths()
        self.tools_by_axis: Any = wp.from_torch(to_torch(self.tools), requires_grad=False)
        self.settle = settle_kernel(solver.model.precision)  # of a GPU, where nodes do not add to the adjoint itself
        load([self.settle] if solver.device != "cpu" else [], solver.device)
        # Adjoints that nobody wants, but Warp their place.
        self.structs = lattice(solver.model.precision)(), type(solver.boundary)()

    def run(self, adj_x: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """Return the adjoint of the tools, shape (batch, step + 1, slot, 3)."""
        solver, batch = self.solver, len(next(iter(adj_x.values())))
        for array in (*self.new.arrays(), self.tools, solver.sums):
            array.zero_()
        solver.scatter.begin()
        for step in reversed(range(max(adj_x))):
            if step + 1 in adj_x:
                x = to_torch(self.new.x)[:batch]
                x += solver.orders[step + 1].from_model(adj_x[step + 1].to(x))
            if solver.tape(step).step != step:
                solver.advance(step, batch)
            self._retreat(step, batch)
        return to_torch(self.tools)[:batch].clone()

    def _retreat(self, step: int, batch: int) -> None:
        solver = self.solver
        if self.grid.m.shape[1] < solver.tape(step).cells:
            self.grid = solver.allocator.grid(solver.tape(step).cells)
            solver.launches.clear(lambda key: key[0] == "backward")
        ends = (self.new, self.old) if solver.model.substeps % 2 else (self.old, self.new)  # as often exchanged
        key = "backward", step, batch, id(self.new)
        solver.launch_again(key, step, batch, lambda: self._substeps(step, batch))
        self.new, self.old = ends  # launches that are kept exchange nothing here
        if solver.pieces > 1:
            solver.tape(step).step = -1  # it holds the first piece now

    def _substeps(self, step: int, batch: int) -> None:
        solver, count = self.solver, self.solver.model.substeps
        solver.sorter.unsort(self.new, self.old, solver.orders[step + 1], batch)
        self.new, self.old = self.old, self.new
        length = solver.model.piece(solver.pieces)
        for first in reversed(range(0, count, length)):
            piece = range(first, min(first + length, count))
            if piece.stop < count:
                solver.substeps(step, batch, piece)
            self._substeps_back(step, batch, piece)
        for smoother in solver.smoothers:
            smoother.run_back(solver, step, batch, self.new)
        if solver.device != "cpu":
            solver.launch(self.settle, 6 * solver.model.boundary.slots, batch, [step, solver.sums, self.tools_by_axis])

    def _substeps_back(self, step: int, batch: int, substeps: range) -> None:
        solver, frames = self.solver, self.solver.frames(step)
        for s in reversed(substeps):
            solver.scatter.adjoint_g2p(step, s, frames[s], self.new, self.grid.v, self.old.x, batch)
            self._adjoint_velocity(step, s, batch)
            self._adjoint_p2g(step, s, frames[s], batch)
            self.new, self.old = self.old, self.new

    def _adjoint_velocity(self, step: int, substep: int, batch: int) -> None:
        solver = self.solver
        inputs = solver.velocity_inputs(step, substep)
        adjoints = [*self.structs, *[None] * 6, self.tools, None, self.grid.m, self.grid.v]
        adjoints += [None] * (len(inputs) - len(adjoints))
        how = {"adj_inputs": adjoints, "adj_outputs": [], "adjoint": True}
        solver.launch_at_nodes(solver.velocity, step, batch, inputs, **how)

    def _adjoint_p2g(self, step: int, substep: int, frame: Frame, batch: int) -> None:
        """Launch the adjoint of p2g, and those of the materials after it or as its continuation."""
        solver, tape, old, new = self.solver, self.solver.tape(step), self.old, self.new
        if not solver.columns:
            given = [tape.lattice, solver.orders[step].mass, frame.x, frame.v, tape.A[substep]]
            inputs = [*given, self.grid.m, old.x, old.v, self.A]
            solver.launch(solver.kernels.adjoint_p2g, solver.model.particles, batch, inputs)
        for b, (_, adjoint) in enumerate(solver.materials):
            inputs = [*solver.material_inputs(b, step, frame), new.S[b]]
            if solver.columns:
                given = [frame.x, frame.v, self.grid.m, old.v, tape.grids[substep].v, new.x, new.v, new.C, old.x]
                inputs = [*solver.scatter.where(step, substep), *given, *inputs]
            else:
                inputs += [self.A]
            with solver.beside_others(b):
                solver.launch(adjoint, solver.size(b), batch, [*inputs, old.S[b], old.C])
        solver.launches.join()
