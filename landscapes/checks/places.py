"""Special points of a box, which random points never hit: its centre, zeros, equal parameters, edges and corners."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Objective
from .probe import Lines, Probe
from .slopes import Judgement, Kind, Ladder, measure

STEPS = (1e-8, 1e-6, 1e-5, 1e-4, 1e-3)
AXES = 4  # at each place, drawn from all
NEARBY, NEAR = 8, 1e-6  # gradients around a place, and how far from it, whose range holds that at a kink
KINKED = 0.01  # of the largest component is what gradients around a kink differ by at least
INSIDE = 1e-9  # of the box: how far inside a bound a zero lies


def places(objective: Objective, seed: int) -> dict[str, Float[Tensor, " dim"]]:
    """Return the existing, distinct special points by name, in the unit cube."""
    space, dim = objective.space, objective.space.dim
    generator = torch.Generator().manual_seed(seed)
    drawn = 0.1 + 0.8 * torch.rand(dim, generator=generator, dtype=torch.float64)
    zero = space.to_unit(torch.zeros(dim, dtype=torch.float64))
    inside = (zero > INSIDE) & (zero < 1 - INSIDE)
    corner = (torch.rand(dim, generator=generator) < 0.5).double()
    found = {"the centre": torch.full_like(drawn, 0.5), "a corner": corner, "the opposite corner": 1 - corner}
    if bool(inside.any()):
        found["zero"] = torch.where(inside, zero, drawn)
        found["a zero"] = torch.where(torch.arange(dim) == int(inside.nonzero()[0]), zero, drawn)
    if dim > 1:
        value = space.from_unit(drawn)[0]
        alike = space.to_unit(value.expand(dim).clone())
        found["equal parameters"] = torch.where((alike > 0) & (alike < 1), alike, drawn)
        edge = drawn.clone()
        edge[0] = corner[0]
        found["an edge"] = edge
    for name, x in objective.special_places().items():
        found[name] = space.to_unit(torch.as_tensor(x, dtype=torch.float64))
    kept: dict[str, Tensor] = {}
    for name, u in found.items():
        if not any(torch.equal(u, other) for other in kept.values()):
            kept[name] = u.clamp(0, 1)
    return kept


def place_losses(dim: int) -> int:
    """Return the approximate number of losses that `measure_places` takes."""
    return 2 * len(STEPS) * 7 * min(AXES, dim)


def measure_places(probe: Probe, seed: int) -> tuple[tuple[str, ...], Ladder]:
    """Judge gradients at special points along some axes; returns the name of the point of each line, and the lines.

    At a kink, any gradient within the range of those around it is right.
    """
    found = places(probe.objective, seed)
    u, dim = torch.stack(list(found.values())), probe.objective.space.dim
    generator = torch.Generator().manual_seed(seed)
    axes = torch.randperm(dim, generator=generator)[:AXES].sort().values
    point = torch.arange(len(u)).repeat_interleave(len(axes))
    direction = torch.eye(dim, dtype=torch.float64)[axes].repeat(len(u), 1)
    lines = Lines.through(probe, u, direction, point, probe.gradient(u))
    ladder = measure(probe, lines, STEPS)
    judged = list(ladder.judged)
    for row in ladder.rows(Kind.WRONG):
        if _is_within_neighbours(probe, lines, row):
            judged[row] = Judgement(Kind.KINK, judged[row].exact)
    names = tuple(list(found)[one] for one in point.tolist())
    return names, Ladder(ladder.lines, ladder.steps, ladder.walked, tuple(judged))


def _is_within_neighbours(probe: Probe, lines: Lines, row: int) -> bool:
    """Return whether gradients around a point differ, as at a kink, and that of the point is within their range.

    Where several branches meet, a differentiation rule can take any mean of them: the range is that of all components.
    """
    generator = torch.Generator().manual_seed(row)
    off = torch.randn(NEARBY, lines.u.shape[1], generator=generator, dtype=torch.float64)
    found = probe.gradient((lines.u[row] + NEAR * off).clamp(0, 1))
    if found.grad is None:
        return False
    grads = (found.grad * probe.width)[found.has_gradient]
    if not len(grads):
        return False
    room, exact = KINKED * float(grads.abs().max()), float(lines.slope[row])
    varies = float((grads.amax(dim=0) - grads.amin(dim=0)).max()) > room
    return varies and min(0.0, float(grads.min())) - room <= exact <= max(0.0, float(grads.max())) + room
