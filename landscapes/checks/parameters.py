"""Find the parameters by which a gradient is wrong: along axes if there are few, by halving groups if many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..objective import Evaluation
from .probe import Lines, Probe
from .slopes import BAD, UNJUDGED, Judgement, Kind, Ladder, measure

STEPS = (1e-8, 1e-6, 1e-4, 1e-3, 1e-2, 1e-1)
RATIO_STEP = 1e-2  # of the box: the step of the slopes that the table compares gradients with
AXIS_LINES = 80  # along axes, at most
LINES_EACH, FEW_AXES, FEWEST_LINES = 6, 10, 12  # for each of few parameters, and in all
AXES_AT_MOST = 40  # parameters of which every one is walked along
BLAMED_POINTS = 3  # at which groups of parameters are halved
FEW_GROUPS = 8  # of which nearly all are wrong where all parameters are
NEARLY_ALL = 0.8
MOST_GROUPS = 32  # wrong ones, of which halves are looked at


@dataclass(frozen=True)
class ParameterRow:
    """One line of the table of parameters.

    `zero` is the share of points whose component is exactly 0. `ratio` is the median of the component over the slope
    along a hundredth of the box, NaN where not measured; `walked` and `wrong` count lines along the axis.
    """

    parameter: str
    zero: float
    ratio: float
    walked: int
    wrong: int
    verdict: str


def walk_axes(probe: Probe, u: Float[Tensor, "batch dim"], found: Evaluation, seed: int) -> Ladder:
    """Walk along axes through some of the points: of every parameter, or of some if there are many."""
    dim, generator = u.shape[1], torch.Generator().manual_seed(seed)
    usable = found.loss.isfinite().nonzero().flatten()
    if not len(usable):
        usable = torch.arange(len(u))
    dead = never_moves(found, dim)
    count = axis_lines(dim)
    shuffled = torch.randperm(dim, generator=generator)
    if dim > AXES_AT_MOST:  # those whose gradient is always 0 first
        shuffled = torch.cat([shuffled[dead[shuffled]], shuffled[~dead[shuffled]]])
    axis = shuffled.repeat(-(-count // dim))[:count]
    point = usable[torch.randperm(len(usable), generator=generator)].repeat(-(-count // len(usable)))[:count]
    return along(probe, u, found, point, axis)


def axis_lines(dim: int) -> int:
    """Return the number of lines along axes."""
    return min(AXIS_LINES, max(FEWEST_LINES, min(dim, AXES_AT_MOST) * 2, LINES_EACH * min(dim, FEW_AXES)))


def along(probe: Probe, u: Tensor, found: Evaluation, point: Tensor, axis: Tensor) -> Ladder:
    """Judge lines along the given axes, each through the given point."""
    direction = torch.eye(u.shape[1], dtype=torch.float64)[axis]
    direction = torch.where(u[point] > 0.5, -1.0, 1.0) * direction
    lines = Lines.through(probe, u, direction, point, found)
    return measure(probe, lines, STEPS)


def never_moves(found: Evaluation, dim: int) -> Bool[Tensor, " dim"]:
    """Return the parameters whose gradient component is always exactly 0."""
    if found.grad is None:
        return torch.zeros(dim, dtype=torch.bool)
    known = found.grad[found.has_gradient]
    return (known == 0).all(dim=0) if len(known) else torch.zeros(dim, dtype=torch.bool)


def find_detached(probe: Probe, u: Float[Tensor, "batch dim"], found: Evaluation) -> tuple[set[int], set[int]]:
    """Return parameters whose gradient is always 0 although losses depend on them: smoothly, and in steps."""
    dead = never_moves(found, u.shape[1])
    rows = found.has_gradient.nonzero().flatten()[:BLAMED_POINTS]
    if not bool(dead.any()) or not len(rows) or u.shape[1] <= AXES_AT_MOST:
        return set(), set()
    detached: set[int] = set()
    stepped: set[int] = set()
    for row in rows.tolist():
        groups = [dead.nonzero().flatten().tolist()]
        detached |= halve(probe, u, found, row, groups, lambda one: one.kind == Kind.WRONG) or set()
        stepped |= halve(probe, u, found, row, groups, lambda one: one.kind == Kind.ZERO and one.moves) or set()
    return detached, stepped - detached


def blame(probe: Probe, u: Float[Tensor, "batch dim"], found: Evaluation, wrong: Sequence[int]) -> set[int] | None:
    """Return the parameters by which gradients at some of the points are wrong; None where nearly all are."""
    dim = u.shape[1]
    groups = [part.tolist() for part in torch.arange(dim).chunk(min(dim, FEW_GROUPS))]
    everywhere, blamed = 0, set[int]()
    for row in wrong[:BLAMED_POINTS]:
        one = halve(probe, u, found, row, groups, lambda one: one.kind in BAD)
        everywhere += one is None
        blamed |= one or set()
    return None if everywhere > len(wrong[:BLAMED_POINTS]) / 2 or not blamed else blamed


def halve(
    probe: Probe,
    u: Float[Tensor, "batch dim"],
    found: Evaluation,
    row: int,
    groups: list[list[int]],
    is_wrong: Callable[[Judgement], bool],
) -> set[int] | None:
    """Halve groups of parameters as long as moving a whole group shows a wrong slope; None where most do."""
    first = True
    blamed: set[int] = set()
    while groups:
        judged = _judge_groups(probe, u, found, row, groups)
        wrong = [group for group, one in zip(groups, judged, strict=True) if is_wrong(one)]
        if (first and len(groups) >= 3 and len(wrong) >= NEARLY_ALL * len(groups)) or len(wrong) > MOST_GROUPS:
            return None
        first = False
        blamed |= {group[0] for group in wrong if len(group) == 1}
        cuts = [(group, len(group) // 2) for group in wrong if len(group) > 1]
        groups = [half for group, middle in cuts for half in (group[:middle], group[middle:])]
    return blamed


def _judge_groups(
    probe: Probe, u: Tensor, found: Evaluation, row: int, groups: Sequence[Sequence[int]]
) -> tuple[Judgement, ...]:
    """Judge lines through one point, along which all parameters of a group move and no others."""
    direction = torch.zeros(len(groups), u.shape[1], dtype=torch.float64)
    inward = torch.where(u[row] > 0.5, -1.0, 1.0).double()
    for number, group in enumerate(groups):
        direction[number, list(group)] = inward[list(group)]
    point = torch.full((len(groups),), row)
    return measure(probe, Lines.through(probe, u, direction, point, found), STEPS).judged


def table(
    names: Sequence[str], found: Evaluation, axes: Ladder, blamed: set[int], stepped: set[int]
) -> tuple[ParameterRow, ...]:
    """Return a row for each parameter."""
    grad = found.grad[found.has_gradient] if found.grad is not None else torch.zeros(0, len(names))
    differences = axes.differences[axes.steps.index(RATIO_STEP)]
    ratios = torch.where(differences != 0, axes.lines.slope / differences, torch.nan)
    rows = []
    for axis, name in enumerate(names):
        lines = axes.axis == axis
        ratio = ratios[lines & ratios.isfinite()]
        judged = axes.along(axis)
        wrong = sum(one.kind in BAD for one in judged)
        zero = float((grad[:, axis] == 0).double().mean()) if len(grad) else float("nan")
        verdict = _verdict(judged, wrong or (axis in blamed), zero, axis in stepped)
        value = float(ratio.quantile(0.5)) if len(ratio) else float("nan")
        rows.append(ParameterRow(name, zero, value, len(judged), wrong, verdict))
    return tuple(rows)


WRONG = ("wrong", DETACHED := "gradient 0, and the loss is not flat")
STEPPED = "gradient 0, and the loss moves in steps"
AGREES = "agrees"


def _verdict(judged: Sequence[Judgement], wrong: int | bool, zero: float, stepped: bool) -> str:
    if wrong:
        return DETACHED if zero == 1 else WRONG[0]
    if stepped or (zero == 1 and any(one.moves for one in judged)):
        return STEPPED
    if not judged:
        return "moved with others only"
    if zero == 1:
        return "the loss does not depend on it"
    if all(one.kind in UNJUDGED for one in judged):
        return "cannot be judged"
    return AGREES
