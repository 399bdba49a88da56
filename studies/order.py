"""The order of convergence of losses as one setting is refined, their limit, and the floor of their differences.

Levels are ordered from coarse to fine, each with a width h > 0 (a time step, the width of a cell). If the error has an
order p, L(h) = L + a h^p, three levels give p, and two give L (Richardson 1911). Otherwise there is no result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from ..landscapes.plain import finite
from ..landscapes.statistics import CONFIDENCE
from .samples import RESAMPLES, Bootstrap

Array = NDArray[np.float64]
Verdict = Literal["converges", "does not converge", "unmoved", "too few levels"]
MAX_ORDER, MIN_ORDER, TINY = 16.0, -8.0, 1e-9  # orders that are looked for, and what counts as zero
ROUNDS = 30  # of correcting an order for levels that are not equally far apart
UNMOVED = 1e-9  # of the losses' spread: less than that is rounding
STALLED = 0.2  # what two refinements have to win, or differences have stopped to fall
MIN_POINTS = 3  # points that an interval needs


@dataclass(frozen=True)
class Shapes:
    """Count the behaviour of the last two differences of points, by their ratio R (Stern et al. 2001).

    `monotone`: 0 < R < 1; `oscillating`: -1 < R < 0; `growing`: |R| at least 1; `still`: the finer one is zero.
    """

    monotone: int
    oscillating: int
    growing: int
    still: int


@dataclass(frozen=True, eq=False)
class Order:
    """The order of convergence from three levels or more.

    `pooled` is the order of the medians of |difference| over the points with its bootstrap interval, `per_point` the
    order from each point's last three levels, NaN where they have none, shape (point,).
    """

    verdict: Verdict
    pooled: Bootstrap
    per_point: Float[NDArray[np.float64], " point"]
    shapes: Shapes


def measure_order(widths: Sequence[float], losses: Array, *, scale: float, seed: int) -> Order:
    """Measure the order of `losses`, shape (level, point), NaN where a point failed.

    It uses the points that succeed in the finest three levels, and the levels at which all these points succeed.
    `scale` is the reference of differences, the spread of the losses. Intervals are percentile bootstraps over the
    points. Losses converge if the whole interval is above zero; if all differences are rounding, they are unmoved.
    Raises ValueError where the widths do not decrease from level to level.
    """
    if any(fine >= coarse for coarse, fine in pairwise(widths)) or min(widths) <= 0:
        raise ValueError(f"levels must go from coarse to fine, with positive widths; got {list(widths)}")
    losses = losses[:, np.isfinite(losses[-3:]).all(axis=0)]
    first = next(k for k in range(len(losses)) if np.isfinite(losses[k:]).all())
    widths, losses = widths[first:], losses[first:]
    moves = np.abs(np.diff(losses, axis=0))
    shapes = _count_shapes(np.diff(losses[-3:], axis=0)) if len(losses) > 2 else Shapes(0, 0, 0, 0)
    per_point = np.array([point_order(widths[-3:], one) for one in losses[-3:].T]) if len(losses) > 2 else np.empty(0)
    if losses.shape[1] and (moves <= UNMOVED * scale).all():
        return Order("unmoved", Bootstrap(None, None, None), per_point, shapes)
    if len(losses) < 3 or losses.shape[1] < MIN_POINTS:
        return Order("too few levels", Bootstrap(None, None, None), per_point, shapes)
    pooled = _bootstrap_order(widths, moves, seed)
    converges = pooled.low is not None and pooled.low > 0
    return Order("converges" if converges else "does not converge", pooled, per_point, shapes)


def point_order(widths: Sequence[float], losses: Array) -> float:
    """Return the order from three levels of one point, by the sizes of their two differences; NaN for none."""
    coarse, fine = np.abs(np.diff(losses))
    return solve_order(widths, float(coarse), float(fine))


def solve_order(widths: Sequence[float], coarse: float, fine: float) -> float:
    """Return p with (h0^p - h1^p) / (h1^p - h2^p) = coarse / fine, for any ratios of the widths.

    NaN where a difference is not positive; negative where differences grow.
    """
    from scipy.optimize import brentq

    if not (coarse > 0 and fine > 0 and math.isfinite(coarse) and math.isfinite(fine)):
        return math.nan
    first, second = math.log(widths[0] / widths[1]), math.log(widths[1] / widths[2])

    def excess(order: float) -> float:
        return _log_move(order, first) + order * second - _log_move(order, second) - math.log(coarse / fine)

    if excess(MIN_ORDER) > 0:
        return MIN_ORDER
    return MAX_ORDER if excess(MAX_ORDER) < 0 else float(brentq(excess, MIN_ORDER, MAX_ORDER, xtol=1e-9))


def fit_order(widths: Sequence[float], moves: Array) -> Array:
    """Fit the order p of moves a (h_k^p - h_k+1^p), shape (move, *batch), by least squares of logarithms.

    With equal ratios of widths, that is the slope of the moves over the widths. Otherwise the slope is corrected until
    it is stable. NaN where a move is not positive. Two moves give the order of `solve_order`.
    """
    steps = np.log(np.asarray(widths[:-1]) / np.asarray(widths[1:]))
    at = np.log(np.asarray(widths[:-1]))
    at = (at - at.mean()).reshape(-1, *[1] * (moves.ndim - 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        heights = np.log(np.where(moves > 0, moves, np.nan))
    order = np.ones(moves.shape[1:])
    for _ in range(ROUNDS):
        slope = (at * (heights - _log_share(order, steps))).sum(axis=0) / (at**2).sum()
        before, order = order, np.clip(slope, MIN_ORDER, MAX_ORDER)
        if np.nanmax(np.abs(order - before), initial=0.0) < TINY:
            break
    return order


def extrapolate(widths: Sequence[float], losses: Array, order: float) -> Array:
    """Return Richardson's limit of each point from its two finest levels, shape (point,).

    Raises ValueError where the order is not positive: then there is no limit.
    """
    if not order > 0:
        raise ValueError(f"extrapolation needs a positive order; got {order}")
    limits: Array = losses[-1] + (losses[-1] - losses[-2]) / np.expm1(order * math.log(widths[-2] / widths[-1]))
    return limits


def find_floor(differences: Sequence[float | None], verdict: Verdict) -> float | None:
    """Return the lower limit of the differences from level to level, None where they still fall.

    It is the least of them, where nothing converges, or where the last two refinements together gain less than a fifth.
    """
    known = [one for one in differences if one is not None]
    if not known or verdict == "too few levels":
        return None
    stalled = len(known) > 2 and known[-1] > known[-3] * (1 - STALLED)
    return min(known) if stalled or verdict == "does not converge" else None


def choose_order(verdict: Verdict, found: Bootstrap, designed: float | None) -> float | None:
    """Return the order for extrapolation: the designed one where the interval contains it, else the observed one.

    None where nothing converges.
    """
    if verdict != "converges" or found.value is None or found.low is None:
        return None
    high = math.inf if found.high is None else found.high
    return designed if designed is not None and found.low <= designed <= high else found.value


def _log_share(order: Array, steps: Array) -> Array:
    """Return log of (1 - r^-p) / p for each step log r between levels, shape (move, *batch)."""
    exponent = steps.reshape(-1, *[1] * order.ndim) * np.where(np.abs(order) < TINY, TINY, order)
    return np.asarray(np.log(-np.expm1(-exponent) / exponent) + np.log(steps).reshape(-1, *[1] * order.ndim))


def _log_move(order: float, step: float) -> float:
    """Return the logarithm of |e^(p s) - 1| / |p|, which has a limit where the order p is zero."""
    if abs(order * step) < 1e-12:
        return math.log(step)
    return math.log(abs(math.expm1(order * step)) / abs(order))


def _bootstrap_order(widths: Sequence[float], moves: Array, seed: int) -> Bootstrap:
    """Return the order of the medians of `moves`, shape (move, point), and those of resampled points."""
    rows = np.random.default_rng(seed).integers(moves.shape[1], size=(RESAMPLES, moves.shape[1]))
    again = fit_order(widths, np.median(moves[:, rows], axis=-1))
    value = float(fit_order(widths, np.median(moves, axis=-1)))
    if not np.isfinite(value) or np.isnan(again).mean() > 1 - CONFIDENCE:
        return Bootstrap(finite(value), None, None)
    ends = np.nanquantile(again, ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return Bootstrap(value, *(finite(float(end)) for end in ends))


def _count_shapes(differences: Array) -> Shapes:
    coarse, fine = differences
    still = fine == 0
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(still, 0.0, fine / coarse)
    growing = ~still & ((np.abs(ratio) >= 1) | ~np.isfinite(ratio))
    left = ~still & ~growing
    counts = (left & (ratio > 0), left & (ratio < 0), growing, still)
    return Shapes(*(int(kind.sum()) for kind in counts))
