"""Examine the gradients of an objective: at random points, at special places, by every parameter; where, and why.

The number of points finds a defect in a given share of the box with 95 % probability. They are spread evenly (a
scrambled Sobol sequence), so that no slab of that width lies between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.quasirandom import SobolEngine

from ..objective import Evaluation
from ..statistics import Estimate, share
from . import parameters as by_parameter
from .diagnosis import Region
from .parameters import ParameterRow
from .places import measure_places, place_losses
from .probe import Lines, Probe
from .regions import find_region
from .slopes import BAD, STEPS, UNJUDGED, Judgement, Kind, Ladder, directions, measure

CONFIDENCE = 0.95
FEWEST_POINTS = 4
MOST_TIMES = 3  # as many points are drawn where some cannot be judged
FEW_WRONG = 4  # points, of which more are drawn to see where they are
INNER_GRADIENTS = 250  # of the smoothed gradient, and around places
AXIS_POINTS = 6  # at which all axes are walked where gradients are wrong
ALL_AXES = 40  # parameters, at most, of which all are walked there,
MANY_AXES, FEW_POINTS = 200, 2  # and of so many at fewer points


def points_for(power: float) -> int:
    """Return how many random points find a defect in a share of the box with 95 % probability."""
    return max(FEWEST_POINTS, math.ceil(math.log(1 - CONFIDENCE) / math.log1p(-power)))


def could_be_missed(judged: int) -> float:
    """Return the largest share of the box in which this many points can miss a defect, at 95 %."""
    return 1.0 if judged == 0 else 1 - (1 - CONFIDENCE) ** (1 / judged)


@dataclass(frozen=True)
class Share:
    """The number of wrong ones among the judged points, the interval of their share, and what could be missed.

    `low` and `high` bound the share of the box with 95 % (Clopper & Pearson 1934). A defect in less than `missed` of
    the box could be undetected.
    """

    wrong: int
    judged: int
    points: int
    low: float
    high: float
    missed: float

    @classmethod
    def of(cls, judged: Sequence[Judgement]) -> Share:
        """Count points."""
        told = [one for one in judged if one.kind not in UNJUDGED]
        wrong = sum(one.kind in BAD for one in told)
        found: Estimate = share(wrong, len(told))
        return cls(wrong, len(told), len(judged), found.low, found.high, could_be_missed(len(told)))

    def describe(self) -> str:
        """Give it in words: "wrong at 42 % (30 to 55 %) of 64 points"."""
        value = self.wrong / self.judged if self.judged else math.nan
        return f"{percent(value)} ({percent(self.low, bare=True)} to {percent(self.high)}) of {self.judged} points"


def percent(value: float, *, bare: bool = False) -> str:
    """Write a share in percent, with a decimal below one percent."""
    found = f"{100 * value:.1f}" if 0 < value < 0.01 else f"{100 * value:.0f}"
    return found if bare else f"{found} %"


@dataclass(eq=False)
class Examination:
    """All measurements of the gradients of one objective."""

    probe: Probe
    seed: int
    u: Float[Tensor, "point dim"]
    found: Evaluation
    random: Ladder
    places: tuple[tuple[str, ...], Ladder]
    axes: Ladder
    at_wrong: Ladder | None = None
    blamed: set[int] | None = field(default_factory=set)
    stepped: set[int] = field(default_factory=set)
    region: Region | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.probe.objective.space.names

    @property
    def share(self) -> Share:
        """The share of wrong random points."""
        return Share.of(self.random.judged)

    def rows(self, *kinds: Kind) -> list[int]:
        """Return the random points of some kinds."""
        return self.random.rows(*kinds)

    def describe_place(self, row: int) -> str:
        """Describe the error along a line through a special place."""
        (names, ladder), one = self.places, self.places[1].judged[row]
        axis, loss = int(ladder.axis[row]), float(ladder.lines.loss[row])
        if one.kind == Kind.NAN:
            return f"the gradient is NaN at {names[row]}, where the loss is {loss:.4g}"
        sides = [side.value for side in (one.behind, one.ahead) if side is not None]
        rise = " and ".join(f"{value:.3g}" for value in sides) or f"{one.slope.value:.3g}" if one.slope else "otherwise"
        gradient = f"by {self.names[axis]}, the gradient is {one.exact:.3g}"
        return f"at {names[row]}, {gradient}, but the loss rises by {rise} to either side"

    def parameters(self) -> tuple[ParameterRow, ...]:
        """Return the table of parameters."""
        return by_parameter.table(self.names, self.found, self.axes, self.blamed or set(), self.stepped)

    def table(self) -> tuple[dict[str, float | None], ...]:
        """Return a row for each step of the ladder: the comparison of gradients with differences over it."""
        differences, exact = self.random.differences.numpy(), self.random.lines.slope.numpy()
        rows = []
        for step, slope in zip(self.random.steps, differences, strict=True):
            known = np.isfinite(slope) & np.isfinite(exact)
            a, d = exact[known], slope[known]
            with np.errstate(invalid="ignore", divide="ignore"):
                cosine = float(a @ d / (np.linalg.norm(a) * np.linalg.norm(d))) if len(a) else math.nan
                errors = np.abs(a - d) / np.maximum(np.abs(a), np.abs(d))
            error = float(np.median(errors[np.isfinite(errors)])) if np.isfinite(errors).any() else math.nan
            sign = float((np.sign(a) == np.sign(d)).mean()) if len(a) else math.nan
            told = {"step": step, "compared": len(a), "failed": len(exact) - len(a), "cosine": cosine, "sign": sign}
            row = {**told, "error": error}
            rows.append({name: value if math.isfinite(value) else None for name, value in row.items()})
        return tuple(rows)


def evaluations(dim: int, power: float) -> tuple[int, int]:
    """Return the approximate numbers of losses alone and with gradients that `examine` takes for a right gradient."""
    points = 2 ** math.ceil(math.log2(points_for(power)))
    axes = 2 * len(by_parameter.STEPS) * by_parameter.axis_lines(dim)
    return 2 * len(STEPS) * points + axes + place_losses(dim), 2 * points + INNER_GRADIENTS


def examine(probe: Probe, power: float, seed: int, say: Callable[[str], None] = lambda text: None) -> Examination:
    """Judge gradients at random points, at special places and by every parameter; examine wrong ones further."""
    say("gradients at random points")
    engine = SobolEngine(probe.objective.space.dim, scramble=True, seed=seed)  # type: ignore[no-untyped-call]
    wanted = points_for(power)
    drawn = 2 ** math.ceil(math.log2(wanted))
    u, found, ladder = _random(probe, engine, drawn, seed)
    while len(u) / 2 <= Share.of(ladder.judged).judged < wanted and len(u) < MOST_TIMES * wanted:
        # where most could not be judged, more would not tell more
        u, found, ladder = _more(probe, engine, drawn, seed, (u, found, ladder))
    wrong = sum(one.kind in BAD for one in ladder.judged)
    if 0 < wrong < FEW_WRONG and len(u) < MOST_TIMES * wanted:
        u, found, ladder = _more(probe, engine, drawn, seed, (u, found, ladder))
    say("gradients at special places")
    places = measure_places(probe, seed)
    say("gradients by each parameter")
    axes = by_parameter.walk_axes(probe, u, found, seed)
    result = Examination(probe, seed, u, found, ladder, places, axes)
    say("where gradients are wrong")
    _look_closer(result)
    return result


Drawn = tuple[Tensor, Evaluation, Ladder]


def _random(probe: Probe, engine: SobolEngine, count: int, seed: int) -> Drawn:
    u = engine.draw(count, dtype=torch.float64)
    found = probe.gradient(u)
    grad = torch.zeros_like(u) if found.grad is None else (found.grad * probe.width).nan_to_num()
    sensitivity = grad.abs().quantile(0.5, dim=0)
    along = directions(u.shape[1], u, sensitivity, seed)
    return u, found, measure(probe, Lines.through(probe, u, along, torch.arange(len(u)), found), STEPS)


def _more(probe: Probe, engine: SobolEngine, count: int, seed: int, before: Drawn) -> Drawn:
    """Draw the same number of points once more."""
    u, found, ladder = _random(probe, engine, count, seed + len(before[0]))
    first, lines = before[2], ladder.lines
    steps = tuple(sorted({*first.steps, *ladder.steps}))
    joined = Lines(*(torch.cat([getattr(first.lines, one), getattr(lines, one)]) for one in lines.__dataclass_fields__))
    joined = replace(joined, point=torch.arange(len(joined)))
    walked = torch.cat([one.on(steps) for one in (first, ladder)], dim=2)
    both = Evaluation.join([before[1], found], dim=u.shape[1], grad=found.grad is not None)
    return torch.cat([before[0], u]), both, Ladder(joined, steps, walked, first.judged + ladder.judged)


def _look_closer(result: Examination) -> None:
    """Find the parameters by which gradients are wrong, and the region."""
    probe, dim = result.probe, result.u.shape[1]
    wrong = result.rows(Kind.WRONG)
    detached, result.stepped = by_parameter.find_detached(probe, result.u, result.found)
    dead = by_parameter.never_moves(result.found, dim)
    for axis in dead.nonzero().flatten().tolist():
        lines = result.axes.along(axis)
        if any(one.moves for one in lines) and all(one.kind not in BAD for one in lines):
            result.stepped.add(axis)
    rows = result.axes.rows(Kind.WRONG)
    seen = {int(result.axes.axis[row]) for row in rows}
    if wrong and dim > ALL_AXES:
        result.blamed = by_parameter.blame(probe, result.u, result.found, wrong)
    elif seen or wrong:
        result.blamed = seen
    if result.blamed is not None:
        result.blamed |= detached
    if wrong or rows:
        points = wrong[:AXIS_POINTS] or [int(result.axes.lines.point[row]) for row in rows][:AXIS_POINTS]
        _walk_at_wrong(result, points)
    _find_region(result)


def _walk_at_wrong(result: Examination, points: Sequence[int]) -> None:
    """Walk along axes at points with a wrong gradient: all axes, or the blamed ones, or some."""
    dim = result.u.shape[1]
    generator = torch.Generator().manual_seed(result.seed)
    axes = torch.arange(dim)
    if ALL_AXES < dim <= MANY_AXES and result.blamed is None:
        points = points[:FEW_POINTS]
    elif dim > ALL_AXES:
        blamed = sorted(result.blamed or [])
        axes = torch.tensor(blamed[:ALL_AXES]) if blamed else torch.randperm(dim, generator=generator)[:ALL_AXES]
    rows = torch.tensor(list(points)).repeat_interleave(len(axes))
    found = by_parameter.along(result.probe, result.u, result.found, rows, axes.repeat(len(points)))
    result.at_wrong = found
    if dim <= ALL_AXES:
        seen = {int(found.axis[row]) for row in found.rows(Kind.WRONG)}
        result.blamed = None if len(seen) == dim else (result.blamed or set()) | seen
    elif result.blamed is not None and len(result.blamed) == dim:
        result.blamed = None


def _find_region(result: Examination) -> None:
    objective, judged = result.probe.objective, result.random.judged
    kind = Kind.NAN if result.rows(Kind.NAN) else Kind.WRONG
    known = [row for row, one in enumerate(judged) if one.kind not in (*UNJUDGED, *BAD) or one.kind == kind]
    wrong = np.array([judged[row].kind == kind for row in known], dtype=bool)
    if not wrong.any() or wrong.all():
        return
    x = objective.space.from_unit(result.u[known])
    try:
        counts = {f"the number of {name}": count.double().numpy() for name, count in objective.events(x).items()}
    except Exception:  # what only some can say is not worth a check
        counts = {}
    values = objective.space.to_values(x).numpy()
    result.region = find_region(values, result.names, wrong, counts)
