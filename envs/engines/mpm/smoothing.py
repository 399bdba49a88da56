"""Smoothing of a fluid's volume ratios: what differs between neighbouring particles without differing on the grid.

The J of a particle follows the divergence that it meets, and each particle meets another. The errors stay and bear
load as a solid does, so that a heavy body comes to rest in a fluid (volumetric locking). Before each control step J is
therefore averaged over the grid, as its logarithm beyond hydrostatic equilibrium, s = log J - slope y:

    s_i = sum w V s / sum w V,    log J' = log J + share (sum w s_i - s).

Fluid at rest keeps its J to round-off, uneven J is taken to its neighbours', and the fluid's volume stays.
"""

from itertools import product
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from .model import Model
from .scatter import nodes
from .smoothing_columns import smoothing_columns
from .smoothing_cpu import smoothing_on_cpu


class Smoother:
    """Smooth one body's volume ratios before a control step, and bring adjoints back."""

    def __init__(self, solver: Any, body: int) -> None:
        model, material = solver.model, solver.model.groups[body].material
        self.body, self.first, self.size = body, solver.first[body], solver.size(body)
        self.slope, self.share = hydrostatic_slope(model, body), material.smoothing
        self._prepare(solver)

    def run(self, solver: Any, step: int, batch: int) -> None:
        """Fill the tape's first state from the checkpoint's."""
        self._spread(solver, step, batch)
        inputs = [*solver.scatter.where(step, 0), self.first, self.slope, self.share, *self._particles(solver, step)]
        inputs += [*self._sums(solver, step), solver.tape(step).smoothed[self.body]]
        solver.launch(self.kernels.collect, self.size, batch, inputs)

    def run_back(self, solver: Any, step: int, batch: int, adjoint: Any) -> None:
        """Turn the adjoint of the tape's first state into that of the checkpoint's, and add to that of x."""
        amount, weight, adj_mean = self.nodes
        tape, (x, J) = solver.tape(step), self._particles(solver, step)
        adj_J, adj_x = adjoint.S[self.body], adjoint.x
        self._spread(solver, step, batch)
        solver.launch_on_box(self.kernels.clear, nodes, batch, [adj_mean])
        inputs = [tape.lattice, self.first, self.share, x, tape.smoothed[self.body], amount, weight]
        solver.launch(self.kernels.adjoint_collect, self.size, batch, [*inputs, adj_J, adj_x, adj_mean])
        inputs = [tape.lattice, self.first, self.slope, self.share, solver.orders[step].volume, x, J, *self.nodes]
        solver.launch(self.kernels.adjoint_spread, self.size, batch, [*inputs, adj_J, adj_x])

    def _prepare(self, solver: Any) -> None:
        self.kernels: Any = smoothing_on_cpu(solver.model.precision)
        room = solver.model.cells + 1  # a CPU reads and writes four numbers where three are meant
        self.nodes = [solver.allocator.array(solver.types.real, room) for _ in range(3)]  # amount, weight, adj_mean

    def _sums(self, solver: Any, step: int) -> list[Any]:
        """Return what `_spread` fills."""
        return self.nodes[:2]

    def _spread(self, solver: Any, step: int, batch: int) -> None:
        """Fill `amount` and `weight`."""
        sums = self._sums(solver, step)
        for values in sums:
            solver.launch_on_box(self.kernels.clear, nodes, batch, [values])
        inputs = [solver.tape(step).lattice, self.first, self.slope, solver.orders[step].volume]
        inputs += [*self._particles(solver, step), *sums]
        solver.launch(self.kernels.spread, self.size, batch, inputs)

    def _particles(self, solver: Any, step: int) -> tuple[Any, Any]:
        """Return all particles' x and the body's J at the step's beginning."""
        return solver.checkpoints[step].x, solver.checkpoints[step].S[self.body]


class ColumnSmoother(Smoother):
    """Do the same with sums by columns of cells, after the lists of the control step's first substep.

    The tape keeps what nodes hold, so that the way back need not add it up again.
    """

    def run_back(self, solver: Any, step: int, batch: int, adjoint: Any) -> None:
        """Turn the adjoint of the tape's first state into that of the checkpoint's, and add to that of x."""
        tape, (x, J), nodes = solver.tape(step), self._particles(solver, step), self._sums(solver, step)
        adj_J, adj_x = adjoint.S[self.body], adjoint.x
        J_new = tape.smoothed[self.body]
        solver.scatter.walk(self.kernels.spread_adjoint, step, 0, batch, [self.first, self.share, x, J_new, adj_J])
        solver.scatter.add_up(self.kernels.add_up_adjoint, step, 0, batch, nodes)
        inputs = [*solver.scatter.where(step, 0), self.first, self.slope, self.share, solver.orders[step].volume]
        solver.launch(self.kernels.adjoint_gather, self.size, batch, [*inputs, x, J, J_new, *nodes, adj_J, adj_x])

    def _prepare(self, solver: Any) -> None:
        self.kernels = smoothing_columns(solver.model.precision, solver.scatter.team)

    def _sums(self, solver: Any, step: int) -> list[Any]:
        """Return what nodes hold of the body."""
        return [solver.tape(step).means[self.body]]

    def _spread(self, solver: Any, step: int, batch: int) -> None:
        inputs = [self.first, self.slope, solver.orders[step].volume, *self._particles(solver, step)]
        solver.scatter.walk(self.kernels.spread, step, 0, batch, inputs)
        solver.scatter.add_up(self.kernels.add_up, step, 0, batch, self._sums(solver, step))


def hydrostatic_slope(model: Model, body: int) -> float:
    """Return by how much log J of a fluid at rest grows with height [1/m]."""
    material: Any = model.groups[body].material
    return float(material.density * model.gravity / material.bulk)


def smooth_volume_ratios(
    model: Model, body: int, x: Float[Tensor, "batch particle 3"], J: Float[Tensor, "batch particle"]
) -> Float[Tensor, "batch particle"]:
    """Return the volume ratios J of one body whose particles are at `x` [m] in the model's order, smoothed.

    This is what the kernels do, written in torch, which differentiates it by x and J.
    """
    slope, share = hydrostatic_slope(model, body), model.groups[body].material.smoothing
    volume = torch.from_numpy(model.groups[body].volume).to(x)
    node, weight = _stencil(model, x)
    beyond = J.log() - slope * x[:, :, 1]
    total = _sum_at_nodes(model, node, weight * volume[:, None])
    amount = _sum_at_nodes(model, node, weight * (volume * beyond)[:, :, None])
    mean = amount / torch.where(total > 0, total, 1.0)
    averaged = (weight * mean.gather(1, node.flatten(1)).view_as(weight)).sum(dim=2)
    return (J.log() + share * (averaged - beyond)).exp()


def _stencil(model: Model, x: Float[Tensor, "batch particle 3"]) -> tuple[Tensor, Float[Tensor, "batch particle 27"]]:
    """Return the numbers of the 27 nodes around each particle, and their weights."""
    s = (x - x.new_tensor(model.origin)) / model.dx
    nodes = torch.tensor(model.nodes, device=x.device)
    base = (s.detach() - 0.5).floor().long().clamp_min(0).minimum(nodes - 3)
    f = s - base
    along = torch.stack([(1.5 - f) ** 2 / 2, 0.75 - (f - 1) ** 2, (f - 0.5) ** 2 / 2], dim=3)
    weight = torch.einsum("bpi,bpj,bpk->bpijk", *along.unbind(dim=2)).flatten(2)
    offsets = torch.tensor(list(product(range(3), repeat=3)), device=x.device)
    i, j, k = (base[:, :, None] + offsets).unbind(dim=3)
    return (i * model.nodes[1] + j) * model.nodes[2] + k, weight


def _sum_at_nodes(
    model: Model, node: Tensor, values: Float[Tensor, "batch particle 27"]
) -> Float[Tensor, "batch node"]:
    """Add up what particles give their nodes."""
    return values.new_zeros(len(values), model.cells).scatter_add(1, node.flatten(1), values.flatten(1))
