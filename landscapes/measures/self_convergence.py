"""Whether a scene's reference is one: how far its losses move as each knob is refined, and what is left to win."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..plain import finite
from .convergence import UNMOVED, Order, choose_order, extrapolate, find_floor, fit_order, measure_order
from .convergence_record import ConvergenceRule, KnobConvergence, Level, Move, Remainder
from .fidelity import Bootstrap, gradient_error, median_of, p95_of

Array = NDArray[np.float64]
JOINT, PRECISION = "joint", "precision"
TENTH = 0.1  # of what standard is off: a reference that moves by less is one


@dataclass(frozen=True, eq=False)
class Values:
    """Hold what a level says at the points, NaN where it failed.

    `loss` [loss unit], shape (point,); `grad` [loss unit / width of the box], shape (point, dim); `seconds` an episode
    with gradient takes in batches [s].
    """

    loss: Array
    grad: Array
    seconds: float

    def arrays(self) -> dict[str, Any]:
        """Return what `Values.of_arrays` takes, for a file."""
        return {"loss": self.loss, "grad": self.grad, "seconds": np.asarray(self.seconds)}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Values:
        """Rebuild values from their `arrays`."""
        return cls(arrays["loss"], arrays["grad"], float(arrays["seconds"]))


@dataclass(frozen=True, eq=False)
class Ladder:
    """Hold the levels of one knob, from coarse to fine, what they say, and the order that the scene is built for."""

    knob: str
    levels: Sequence[Level]
    values: Sequence[Values]
    designed: float | None

    @property
    def widths(self) -> list[float]:
        """The width of each level."""
        return [level.width for level in self.levels]

    @property
    def losses(self) -> Array:
        """The losses, shape (level, point)."""
        return np.array([one.loss for one in self.values])


@dataclass(frozen=True)
class Scale:
    """Say how differences are told: as shares of the `spread` of losses, from a `seed`; `off` is standard's error."""

    spread: float
    off: Bootstrap
    seed: int

    def meets(self, moved: float | None) -> bool | None:
        """Say whether a movement is rounding or within a tenth of standard's error, None where one is not known."""
        if self.off.value is None:
            return None
        return moved is not None and moved <= max(TENTH * self.off.value, UNMOVED)


def error(values: Array, reference: Array) -> Array:
    """Return |difference| at the points where the reference has a loss, infinite where only it has one."""
    known = np.isfinite(reference)
    return np.nan_to_num(np.abs(values - reference)[known], nan=np.inf)


def sum_up(errors: Array, spread: float, seed: int) -> tuple[Bootstrap, Bootstrap]:
    """Return the median and the 95th percentile of errors, as shares of the spread."""
    median, p95 = (Bootstrap.of(of, errors, seed=seed).share(spread) for of in (median_of, p95_of))
    return median, p95


def conclude(ladder: Ladder, reference: str, scale: Scale) -> tuple[KnobConvergence, Order]:
    """Say what a knob's levels show; one of them is the `reference`."""
    order = measure_order(ladder.widths, ladder.losses, scale=scale.spread, seed=scale.seed)
    moves = [_move(ladder, place, scale) for place in range(len(ladder.levels) - 1)]
    place = [level.name for level in ladder.levels].index(reference)
    beyond = moves[place:]
    met = [scale.meets(move.p95.value) for move in beyond]
    found = KnobConvergence(
        knob=ladder.knob,
        levels=tuple(ladder.levels),
        moves=tuple(moves),
        verdict=order.verdict,
        order=order.pooled,
        per_point=tuple(finite(float(one)) for one in order.per_point),
        shapes=order.shapes,
        designed=ladder.designed,
        floor=find_floor([move.median.value for move in moves], order.verdict),
        moved=beyond[0].p95 if beyond else None,
        met=met[0] if met else None,
        met_from=next((move.coarse for move, yes in zip(beyond, met, strict=True) if yes), None),
    )
    return found, order


def _move(ladder: Ladder, place: int, scale: Scale) -> Move:
    coarse, fine = ladder.values[place : place + 2]
    levels = ladder.levels[place : place + 2]
    both = np.isfinite(coarse.loss) & np.isfinite(fine.loss)
    cosine, off = gradient_error(coarse.grad[both], fine.grad[both])
    known = [Bootstrap.of(median_of, one, seed=scale.seed) for one in (cosine, off)]
    either = np.isfinite(coarse.loss) | np.isfinite(fine.loss)
    errors = np.nan_to_num(np.abs(coarse.loss - fine.loss)[either], nan=np.inf)
    median, p95 = sum_up(errors, scale.spread, scale.seed)
    names = levels[0].name, levels[1].name
    return Move(*names, levels[0].width, median, p95, known[0], known[1], int(both.sum()))


def judge(knobs: Sequence[KnobConvergence], scale: Scale) -> ConvergenceRule:
    """Apply the rule: refining a reference moves losses by rounding, or by less than a tenth of standard's error."""
    known = [one for one in knobs if one.knob != PRECISION and one.moved is not None]
    worst = max(known, key=_moved, default=None)
    met = [one.met for one in known]
    return ConvergenceRule(
        scale.off,
        worst.moved if worst else None,
        worst.knob if worst else None,
        None if not met or None in met else all(met),
        tuple(one.knob for one in known if one.met is False),
    )


def _moved(knob: KnobConvergence) -> float:
    value = knob.moved.value if knob.moved else None
    return np.inf if value is None else value


def counted(ladders: Sequence[Ladder]) -> list[Ladder]:
    """Return the ladders whose limits add up to that of the scene: the joint one alone where there is one."""
    joint = [one for one in ladders if one.knob == JOINT]
    return joint or [one for one in ladders if one.knob != PRECISION]


def estimate_remainders(
    ladders: Sequence[tuple[Ladder, Order]], named: Mapping[str, Array], reference: Array, scale: Scale
) -> tuple[Remainder, ...]:
    """Estimate how far `named` losses are from Richardson's limit, shape (point,) each.

    Corrections of the knobs add up to leading order. Orders are measured anew for each draw of the bootstrap, but where
    the designed ones are taken. Empty where some knob has no limit.
    """
    corrections = [_Correction.of(ladder, order, reference, scale) for ladder, order in ladders]
    if not corrections or any(one is None for one in corrections):
        return ()
    every = [one for one in corrections if one is not None]
    rows = np.flatnonzero(np.isfinite(np.array([reference, *(one.ladder.losses[-1] for one in every)])).all(axis=0))
    rows = rows[np.isfinite(np.array([one.at(rows, rows) for one in every])).all(axis=0)]
    left = {name: _left(every, rows, losses, reference, scale) for name, losses in named.items()}
    return tuple(Remainder(name, median, p95) for name, (median, p95) in left.items())


def _left(
    every: Sequence[_Correction], rows: NDArray[np.int64], losses: Array, reference: Array, scale: Scale
) -> list[Bootstrap]:
    known: dict[bytes, Array] = {}  # both statistics are of the same draws

    def errors(drawn: NDArray[np.int64]) -> Array:
        if drawn.tobytes() not in known:
            limit = reference[drawn] + sum(one.at(drawn, drawn) for one in every)
            known[drawn.tobytes()] = np.nan_to_num(np.abs(losses[drawn] - limit), nan=np.inf)
        return known[drawn.tobytes()]

    def of(statistic: Any) -> Any:
        return lambda drawn: np.apply_along_axis(lambda one: statistic(errors(one)), -1, drawn)

    places: Any = rows  # of points, drawn as samples are
    return [Bootstrap.of(of(one), places, seed=scale.seed).share(scale.spread) for one in (median_of, p95_of)]


@dataclass(frozen=True, eq=False)
class _Correction:
    """Hold what leads from the reference to the limit of one knob; `by` is a fixed order, None to measure it anew."""

    ladder: Ladder
    by: float | None
    still: bool
    reference: Array

    @classmethod
    def of(cls, ladder: Ladder, order: Order, reference: Array, scale: Scale) -> _Correction | None:
        by = choose_order(order, ladder.designed)
        if order.verdict == "unmoved":
            return cls(ladder, None, True, reference)
        return None if by is None else cls(ladder, by if by == ladder.designed else None, False, reference)

    def at(self, rows: NDArray[np.int64], drawn: NDArray[np.int64]) -> Array:
        """Return the correction at points, by the order that the points `drawn` show."""
        losses, widths = self.ladder.losses, self.ladder.widths
        if self.still:
            return np.asarray(losses[-1][rows] - self.reference[rows])
        order = self.by or self._order(drawn)
        if not order > 0:  # a draw that shows none is as far off as can be
            return np.full(len(rows), np.inf)
        return np.asarray(extrapolate(widths, losses[:, rows], order) - self.reference[rows])

    def _order(self, drawn: NDArray[np.int64]) -> float:
        losses = self.ladder.losses[:, drawn]
        losses = losses[:, np.isfinite(losses[-3:]).all(axis=0)]
        first = next(k for k in range(len(losses)) if np.isfinite(losses[k:]).all())
        moves = np.median(np.abs(np.diff(losses[first:], axis=0)), axis=-1)
        return float(fit_order(self.ladder.widths[first:], moves))
