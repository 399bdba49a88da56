"""Smoothing of a fluid's volume ratios: what differs between neighbouring particles without differing on the grid.

The J of a particle follows the divergence that it meets, and each particle meets another. The errors stay and bear
load as a solid does, so that a heavy body comes to rest in a fluid (volumetric locking). Before each control step J is
therefore averaged over the grid, as its logarithm beyond hydrostatic equilibrium, s = log J - slope y:

    s_i = sum w V s / sum w V,    log J' = log J + share (sum w s_i - s).

Fluid at rest keeps its J to round-off, uneven J is taken to its neighbours', and the fluid's volume stays.
"""

from functools import cache, partial
from itertools import product
from types import SimpleNamespace
from typing import Any, no_type_check

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from .. import cpp
from ..runtime import Ints, fill_struct, precision
from .columns import PARTS, SEGMENT, Team, list_functions, list_struct, walker, walking_kernel
from .model import Model
from .scatter import nodes
from .stencil import gatherers, lattice, layout, stencil


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
        inputs = [*solver.scatter.where(step, 0), self._fluid(solver, step), *self._sums(solver, step)]
        solver.launch(self.kernels.collect, self.size, batch, inputs)

    def run_back(self, solver: Any, step: int, batch: int, adjoint: Any) -> None:
        """Turn the adjoint of the tape's first state into that of the checkpoint's, and add to that of x."""
        self._spread(solver, step, batch)
        solver.launch_on_box(self.kernels.clear, nodes, batch, [self.nodes[2]])
        inputs = [solver.tape(step).lattice, self._fluid(solver, step), *self.nodes, adjoint.S[self.body], adjoint.x]
        solver.launch(self.kernels.adjoint_collect, self.size, batch, inputs)
        solver.launch(self.kernels.adjoint_spread, self.size, batch, inputs)

    def _prepare(self, solver: Any) -> None:
        self.kernels: Any = smoothing_kernels(solver.model.precision)
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
        inputs = [solver.tape(step).lattice, self._fluid(solver, step), *sums]
        solver.launch(self.kernels.spread, self.size, batch, inputs)

    def _fluid(self, solver: Any, step: int) -> Any:
        """Return the body at a step's beginning as kernels take it."""
        before, after = solver.checkpoints[step], solver.tape(step).smoothed[self.body]
        values = {"first": self.first, "slope": self.slope, "share": self.share, "J_new": after}
        values |= {"volume": solver.orders[step].volume, "x": before.x, "J": before.S[self.body]}
        return fill_struct(smoothed_struct(solver.model.precision), values)


class ColumnSmoother(Smoother):
    """Do the same with sums by columns of cells, after the lists of the control step's first substep.

    The tape keeps what nodes hold, so that the way back need not add it up again.
    """

    def run_back(self, solver: Any, step: int, batch: int, adjoint: Any) -> None:
        """Turn the adjoint of the tape's first state into that of the checkpoint's, and add to that of x."""
        nodes, fluid, adj_J = self._sums(solver, step), self._fluid(solver, step), adjoint.S[self.body]
        solver.scatter.walk(self.kernels.spread_adjoint, step, 0, batch, [fluid, adj_J])
        solver.scatter.add_up(self.kernels.add_up_adjoint, step, 0, batch, nodes)
        inputs = [*solver.scatter.where(step, 0), fluid, *nodes, adj_J, adjoint.x]
        solver.launch(self.kernels.adjoint_gather, self.size, batch, inputs)

    def _prepare(self, solver: Any) -> None:
        self.kernels = smoothing_columns(solver.model.precision, solver.scatter.team)

    def _sums(self, solver: Any, step: int) -> list[Any]:
        """Return what nodes hold of the body."""
        return [solver.tape(step).means[self.body]]

    def _spread(self, solver: Any, step: int, batch: int) -> None:
        solver.scatter.walk(self.kernels.spread, step, 0, batch, [self._fluid(solver, step)])
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


@cache
@no_type_check
def smoothed_struct(name: str) -> Any:
    """Return the struct of a body whose volume ratios are smoothed, in one precision."""
    real, (Reals, Vectors, _, _) = precision(name).real, precision(name).rows

    @partial(wp.struct, module=f"gradscape.smoothed.{name}")
    class Smoothed:
        """`volume` and `x` cover all particles; those of the body begin at `first`. J and J' cover the body alone."""

        first: int
        slope: real
        share: real
        volume: Reals
        x: Vectors
        J: Reals
        J_new: Reals

    return Smoothed


@cache
@no_type_check
def smoothing_kernels(name: str) -> SimpleNamespace:
    """Return `clear, spread, collect, adjoint_collect, adjoint_spread`, kernels of one precision for a CPU."""
    real, (numbers, vectors, _, _), module = precision(name).real, precision(name).rows, f"gradscape.smoothing.{name}"

    @wp.kernel(module=cpp.module(module), enable_backward=False)
    def clear(values: numbers):
        e, i = wp.tid()
        values[e, i] = real(0.0)

    declare = partial(cpp.kernel_in_rows, module)
    given = {"lattice": lattice(name), "fluid": smoothed_struct(name), "amount": numbers, "weight": numbers}
    adjoints = {"adj_mean": numbers, "adj_J": numbers, "adj_x": vectors}
    return SimpleNamespace(
        clear=clear,
        # Scatter V s and V.
        spread=declare("smoothing_spread", **given),
        # Gather the nodes' means and take J so far towards them.
        collect=declare("smoothing_collect", **given),
        # Scatter the adjoints of the nodes' means; add to adj_x, turn adj_J from that of J' into that of log J'.
        adjoint_collect=declare("smoothing_adjoint_collect", **given, **adjoints),
        # Gather the adjoint of s; add to adj_x, turn adj_J from that of log J' into that of J.
        adjoint_spread=declare("smoothing_adjoint_spread", **given, **adjoints),
    )


@cache
@no_type_check
def smoothing_columns(name: str, team: Team) -> SimpleNamespace:
    """Return `spread, add_up, collect, spread_adjoint, add_up_adjoint, adjoint_gather`, kernels for a GPU.

    A node holds its mean s_i, its part a_i of the adjoint of s, a_i s_i, and 1 / sum w V.

    Those that spread take threads in a `team`; particles of other bodies in the same cells give nothing. `collect` and
    `adjoint_gather` are over [environment, particle of the body].
    """
    types, lies, sums_of = precision(name), layout(name), gatherers(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    Reals, Vectors, Nodes, _ = types.rows
    Lattice, Fluid, Lists = lattice(name), smoothed_struct(name), list_struct()
    base_node, at_nodes = stencil(name).base_node, walker(name, sloping=False).at_nodes
    gather, from_base, take_node = sums_of.gather, sums_of.from_base, list_functions().take_node
    module = cpp.module(f"gradscape.smoothing.{name}.columns.{team.lanes}")
    read_number, read_vector = lies.read_number, lies.read_vector
    read_node, write_node = lies.read_node, lies.write_node

    @cpp.func_native(template=[SEGMENT, PARTS])
    def add_up_node(lattice: Lattice, planes: Ints, parts: Nodes, e: int, node: int) -> vec4: ...

    @wp.func(module=module)
    def at(lattice: Lattice, starts: Ints, nodes: Nodes, e: int, x: vec3, q: vec3):
        """Return the sums of `gathers` at x, of what nodes hold, and of the slopes of w times its product with q."""
        base = base_node((x - lattice.origin) * lattice.inv_dx, lattice)
        f = from_base(x, base, lattice)
        return gather(lattice, starts, nodes, e, base - lattice.first, f, q, mat33(), real(0.0))

    @wp.func(module=module)
    def given_volume(lattice: Lattice, fluid: Fluid, e: int, p: int):
        """Return what a particle gives to its nodes of V s and V."""
        given = at_nodes(lattice, read_vector(fluid.x, e, p))
        if p >= fluid.first and p < fluid.first + fluid.J.shape[1]:
            V, J = read_number(fluid.volume, e, p), read_number(fluid.J, e, p - fluid.first)
            given.q = vec3(V * (wp.log(J) - fluid.slope * read_vector(fluid.x, e, p)[1]), V, real(0.0))
        return given

    @wp.func(module=module)
    def given_adjoint(lattice: Lattice, fluid: Fluid, adj_J_new: Reals, e: int, p: int):
        """Return what a particle gives to its nodes of the adjoints of their means, from that of J'."""
        given = at_nodes(lattice, read_vector(fluid.x, e, p))
        if p >= fluid.first and p < fluid.first + fluid.J_new.shape[1]:
            adj_log = read_number(adj_J_new, e, p - fluid.first) * read_number(fluid.J_new, e, p - fluid.first)
            given.q = vec3(fluid.share * adj_log, real(0.0), real(0.0))
        return given

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def add_up(lattice: Lattice, lists: Lists, parts: Nodes, nodes: Nodes):
        """Set the nodes' means, and what these are shared by."""
        e, i = wp.tid()
        node = take_node(lists, e, i)
        if node < 0:
            return
        total = add_up_node(lattice, lists.planes, parts, e, node)
        # A particle in the middle of a cell gives the farthest of its nodes nothing, and others may not meet these.
        inverse = wp.where(total[1] > real(0.0), real(1.0) / total[1], real(0.0))
        write_node(nodes, e, i, vec4(total[0] * inverse, real(0.0), real(0.0), inverse))

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def collect(lattice: Lattice, starts: Ints, fluid: Fluid, nodes: Nodes):
        """Gather the nodes' means and take J so far towards them."""
        e, p = wp.tid()
        there = read_vector(fluid.x, e, fluid.first + p)
        sums = at(lattice, starts, nodes, e, there, vec3())
        here = wp.log(read_number(fluid.J, e, p))
        fluid.J_new[e, p] = wp.exp(here + fluid.share * (sums[0][0] - (here - fluid.slope * there[1])))

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def add_up_adjoint(lattice: Lattice, lists: Lists, parts: Nodes, nodes: Nodes):
        """Set the nodes' parts of the adjoint of s."""
        e, i = wp.tid()
        node = take_node(lists, e, i)
        if node < 0:
            return
        held = read_node(nodes, e, i)
        a = add_up_node(lattice, lists.planes, parts, e, node)[0] * held[3]
        write_node(nodes, e, i, vec4(held[0], a, a * held[0], held[3]))

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def adjoint_gather(lattice: Lattice, starts: Ints, fluid: Fluid, nodes: Nodes, adj_J: Reals, adj_x: Vectors):
        """Gather the nodes' means and the adjoint of s; add to adj_x, turn adj_J from that of J' into that of J."""
        e, p = wp.tid()
        q, share = fluid.first + p, fluid.share
        there = read_vector(fluid.x, e, q)
        ratio, V = read_number(fluid.J, e, p), read_number(fluid.volume, e, q)
        beyond = wp.log(ratio) - fluid.slope * there[1]
        g = read_number(adj_J, e, p) * read_number(fluid.J_new, e, p)
        sums = at(lattice, starts, nodes, e, there, vec3(share * g, V * beyond, -V))
        adj_s = V * sums[0][1] - share * g
        change = lattice.inv_dx * sums[4] - vec3(real(0.0), fluid.slope * adj_s, real(0.0))
        adj_x[e, q] = read_vector(adj_x, e, q) + change
        adj_J[e, p] = (g + adj_s) / ratio

    return SimpleNamespace(
        spread=walking_kernel("smoothing_columns.spread", name, team, given_volume, sloping=False),
        add_up=add_up,
        collect=collect,
        spread_adjoint=walking_kernel("smoothing_columns.spread_adjoint", name, team, given_adjoint, sloping=False),
        add_up_adjoint=add_up_adjoint,
        adjoint_gather=adjoint_gather,
    )
