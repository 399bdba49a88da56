"""Smoothing of a fluid's volume ratios: what differs between neighbouring particles without differing on the grid.

The J of a particle follows the divergence that it meets, and each particle meets another. The errors stay and bear
load as a solid does, so that a heavy body comes to rest in a fluid (volumetric locking). Before each control step J is
therefore averaged over the grid, as its logarithm beyond hydrostatic equilibrium, s = log J - slope y:

    s_i = sum w V s / sum w V,    log J' = log J + share (sum w s_i - s).

Fluid at rest keeps its J to round-off, uneven J is taken to its neighbours', and the fluid's volume stays.
"""

from functools import cache
from itertools import product
from types import SimpleNamespace
from typing import Any, no_type_check

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..runtime import determinism, precision
from .model import Model
from .stencil import lattice, stencil


@cache
@no_type_check
def smoothing_kernels(name: str, *, deterministic: bool = False) -> SimpleNamespace:
    """Return the kernels `clear, spread, collect, adjoint_collect, adjoint_spread` of one precision."""
    types = precision(name)
    real, vec3 = types.real, types.vec3
    module = f"gradscape.smoothing.{name}{'.deterministic' if deterministic else ''}"
    wp.set_module_options({"deterministic": determinism(deterministic)}, module)
    Lattice, spline = lattice(name), stencil(name)
    base_node, weights, weight_slopes = spline.base_node, spline.weights, spline.weight_slopes

    @wp.func(module=module)
    def inverse(weight: real):
        # A particle in the middle of a cell gives the farthest of its nodes nothing, and others may not meet these.
        return wp.where(weight > real(0.0), real(1.0) / weight, real(0.0))

    @wp.kernel(module=module, enable_backward=False)
    def clear(values: wp.array2d[real]):
        e, i = wp.tid()
        values[e, i] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def spread(
        lattice: Lattice,
        first: int,
        slope: real,
        volume: wp.array2d[real],
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
    ):
        """Scatter V s and V."""
        e, p = wp.tid()
        q = first + p
        s = (x[e, q] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        beyond = wp.log(J[e, p]) - slope * x[e, q][1]
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                for k in range(3):
                    w = wx[i] * wy[j] * wz[k] * volume[e, q]
                    wp.atomic_add(amount, e, row + k, w * beyond)
                    wp.atomic_add(weight, e, row + k, w)

    @wp.kernel(module=module, enable_backward=False)
    def collect(
        lattice: Lattice,
        first: int,
        slope: real,
        share: real,
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
        J_new: wp.array2d[real],
    ):
        """Gather the nodes' means and take J so far towards them."""
        e, p = wp.tid()
        q = first + p
        s = (x[e, q] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        mean = real(0.0)
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                for k in range(3):
                    mean += wx[i] * wy[j] * wz[k] * amount[e, row + k] * inverse(weight[e, row + k])
        here = wp.log(J[e, p])
        J_new[e, p] = wp.exp(here + share * (mean - (here - slope * x[e, q][1])))

    @wp.kernel(module=module, enable_backward=False)
    def adjoint_collect(
        lattice: Lattice,
        first: int,
        share: real,
        x: wp.array2d[vec3],
        J_new: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
        adj_J: wp.array2d[real],
        adj_x: wp.array2d[vec3],
        adj_mean: wp.array2d[real],
    ):
        """Scatter the adjoints of the nodes' means; add to adj_x, turn adj_J from that of J' into that of log J'."""
        e, p = wp.tid()
        q = first + p
        s = (x[e, q] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        dx_, dy_, dz_ = weight_slopes(f[0]), weight_slopes(f[1]), weight_slopes(f[2])
        g = adj_J[e, p] * J_new[e, p]
        steep = vec3()
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                for k in range(3):
                    mean = amount[e, row + k] * inverse(weight[e, row + k])
                    steep += mean * vec3(dx_[i] * wy[j] * wz[k], wx[i] * dy_[j] * wz[k], wx[i] * wy[j] * dz_[k])
                    wp.atomic_add(adj_mean, e, row + k, wx[i] * wy[j] * wz[k] * share * g)
        adj_x[e, q] = adj_x[e, q] + (share * g * lattice.inv_dx) * steep
        adj_J[e, p] = g

    @wp.kernel(module=module, enable_backward=False)
    def adjoint_spread(
        lattice: Lattice,
        first: int,
        slope: real,
        share: real,
        volume: wp.array2d[real],
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
        adj_mean: wp.array2d[real],
        adj_J: wp.array2d[real],
        adj_x: wp.array2d[vec3],
    ):
        """Gather the adjoint of s; add to adj_x, turn adj_J from that of log J' into that of J."""
        e, p = wp.tid()
        q = first + p
        s = (x[e, q] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        dx_, dy_, dz_ = weight_slopes(f[0]), weight_slopes(f[1]), weight_slopes(f[2])
        beyond = wp.log(J[e, p]) - slope * x[e, q][1]
        adj_s = real(0.0)
        steep = vec3()
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                for k in range(3):
                    share_of_one = inverse(weight[e, row + k])
                    a = adj_mean[e, row + k] * share_of_one
                    off = a * (beyond - amount[e, row + k] * share_of_one)
                    adj_s += wx[i] * wy[j] * wz[k] * a
                    steep += off * vec3(dx_[i] * wy[j] * wz[k], wx[i] * dy_[j] * wz[k], wx[i] * wy[j] * dz_[k])
        g = adj_J[e, p]
        adj_s = volume[e, q] * adj_s - share * g
        adj_x[e, q] = adj_x[e, q] + (volume[e, q] * lattice.inv_dx) * steep - vec3(real(0.0), slope * adj_s, real(0.0))
        adj_J[e, p] = (g + adj_s) / J[e, p]

    return SimpleNamespace(
        clear=clear,
        spread=spread,
        collect=collect,
        adjoint_collect=adjoint_collect,
        adjoint_spread=adjoint_spread,
    )


class Smoother:
    """Smooth one body's volume ratios before a control step, and bring adjoints back."""

    def __init__(self, solver: Any, body: int, *, deterministic: bool) -> None:
        model, material = solver.model, solver.model.bodies[body].material
        self.body, self.first, self.size = body, solver.first[body], solver.size(body)
        self.slope, self.share = hydrostatic_slope(model, body), material.smoothing
        self.kernels = smoothing_kernels(model.precision, deterministic=deterministic)
        types = precision(model.precision)
        self.amount, self.weight, self.adj_mean = (solver.allocator.array(types.real, model.cells) for _ in range(3))

    def run(self, solver: Any, step: int, batch: int) -> None:
        """Fill the tape's first state from the checkpoint's."""
        self._spread(solver, step, batch)
        x, J = solver.checkpoints[step].x, solver.checkpoints[step].S[self.body]
        tape = solver.tape(step)
        inputs = [tape.lattice, self.first, self.slope, self.share, x, J, self.amount, self.weight]
        solver.launch(self.kernels.collect, self.size, batch, [*inputs, tape.smoothed[self.body]])

    def run_back(self, solver: Any, step: int, batch: int, adjoint: Any) -> None:
        """Turn the adjoint of the tape's first state into that of the checkpoint's, and add to that of x."""
        self._spread(solver, step, batch)
        tape, checkpoint = solver.tape(step), solver.checkpoints[step]
        x, J, adj_J = checkpoint.x, checkpoint.S[self.body], adjoint.S[self.body]
        nodes = solver.boxes[step].cells
        solver.launch(self.kernels.clear, nodes, batch, [self.adj_mean], nodes=True)
        inputs = [tape.lattice, self.first, self.share, x, tape.smoothed[self.body], self.amount, self.weight]
        inputs += [adj_J, adjoint.x, self.adj_mean]
        solver.launch(self.kernels.adjoint_collect, self.size, batch, inputs)
        inputs = [tape.lattice, self.first, self.slope, self.share, solver.orders[step].volume, x, J]
        inputs += [self.amount, self.weight, self.adj_mean, adj_J, adjoint.x]
        solver.launch(self.kernels.adjoint_spread, self.size, batch, inputs)

    def _spread(self, solver: Any, step: int, batch: int) -> None:
        nodes = solver.boxes[step].cells
        for values in (self.amount, self.weight):
            solver.launch(self.kernels.clear, nodes, batch, [values], nodes=True)
        x, J = solver.checkpoints[step].x, solver.checkpoints[step].S[self.body]
        inputs = [solver.tape(step).lattice, self.first, self.slope, solver.orders[step].volume, x, J]
        solver.launch(self.kernels.spread, self.size, batch, [*inputs, self.amount, self.weight])


def hydrostatic_slope(model: Model, body: int) -> float:
    """Return by how much log J of a fluid at rest grows with height [1/m]."""
    material: Any = model.bodies[body].material
    return float(material.density * model.gravity / material.bulk)


def smooth_volume_ratios(
    model: Model, body: int, x: Float[Tensor, "batch particle 3"], J: Float[Tensor, "batch particle"]
) -> Float[Tensor, "batch particle"]:
    """Return the volume ratios J of one body whose particles are at `x` [m] in the model's order, smoothed.

    This is what the kernels do, written in torch, which differentiates it by x and J.
    """
    slope, share = hydrostatic_slope(model, body), model.bodies[body].material.smoothing
    volume = torch.from_numpy(model.bodies[body].volume).to(x)
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
