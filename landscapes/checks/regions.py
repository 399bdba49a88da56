"""Describe where gradients are wrong, by the simplest valid rule: an interval of one parameter, or of two."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from .diagnosis import Region

FEWEST = 3  # points, wrong or right, from which a rule is told
CLEARLY = 3.0  # logarithm of how many times more choices there are than rules, where a rule is no chance
WORST = 0.3  # of the rarer kind is what a rule may put on the wrong side
AT_END = 0.02  # of a feature's range is what an interval may lack of its end
CANDIDATES = 6  # features whose pairs are tried
Points = NDArray[np.float64]


@dataclass(frozen=True)
class _Interval:
    """An interval of a feature that contains most wrong points and few others."""

    feature: int
    low: float
    high: float
    score: int

    def holds(self, values: Points) -> NDArray[np.bool_]:
        """Return which points are inside it."""
        found: NDArray[np.bool_] = (values[:, self.feature] >= self.low) & (values[:, self.feature] <= self.high)
        return found


def find_region(
    values: Points, names: Sequence[str], wrong: NDArray[np.bool_], events: Mapping[str, Points] | None = None
) -> Region | None:
    """Return the simplest rule that separates wrong points from others; None where all are wrong, or no rule fits.

    `values` has shape (point, parameter), in the parameters' own units. `events` are event counts at each point,
    features like parameters.
    """
    few = min(int(wrong.sum()), int((~wrong).sum()))
    if few < FEWEST:
        return None
    counts = events or {}
    features, labels = np.column_stack([values, *counts.values()]), [*names, *counts]
    spans = np.ptp(features, axis=0)
    single = [_best_interval(features, feature, wrong) for feature in range(len(labels))]
    single = sorted(single, key=lambda one: -one.score)
    best: tuple[float, list[_Interval]] = (_error(features, single[:1], wrong), single[:1])
    if best[0] > WORST * few / len(wrong) / 3:
        for first, second in permutations(_narrowest(features, wrong), 2):
            pair = _best_pair(features, first, second, wrong)
            error = _error(features, pair, wrong)
            if error < best[0] - 1.5 / len(wrong):  # a second condition has to be worth it
                best = (error, pair)
    error, intervals = best
    if error > WORST * few / len(wrong) or _fits_by_chance(len(wrong), few, len(labels), len(intervals)):
        return None
    rules = []
    for one in intervals:
        kept = wrong.copy()
        for other in intervals:
            if other is not one:
                kept |= ~other.holds(features)  # right points that another condition leaves out
        rules.append(_describe(one, features, labels, kept, spans))
    rule = " and ".join(rules)
    return Region(rule, tuple(labels[one.feature] for one in intervals), error, len(wrong))


def _fits_by_chance(points: int, few: int, features: int, conditions: int) -> bool:
    """Return whether some rule would separate this few points by chance: there are more rules than choices."""
    choices = math.lgamma(points + 1) - math.lgamma(few + 1) - math.lgamma(points - few + 1)
    rules = conditions * math.log(features * points**2 / 2)
    return choices < rules + CLEARLY


def _narrowest(features: Points, wrong: NDArray[np.bool_]) -> list[int]:
    """Return the features with the fewest right points within the span of the wrong ones."""
    low, high = features[wrong].min(axis=0), features[wrong].max(axis=0)
    right = features[~wrong]
    within = ((right >= low) & (right <= high)).sum(axis=0)
    return [int(one) for one in np.argsort(within, kind="stable")[:CANDIDATES]]


def _best_pair(features: Points, first: int, other: int, wrong: NDArray[np.bool_]) -> list[_Interval]:
    """Return intervals of two features with wrong points and few others: the span of one, then each in turn."""
    at = features[wrong, first]
    one = _Interval(first, float(at.min()), float(at.max()), 0)
    for _ in range(2):
        inside = one.holds(features)
        two = _best_interval(features[inside], other, wrong[inside])
        inside = two.holds(features)
        if not inside.any():
            break
        one = _best_interval(features[inside], first, wrong[inside])
    return [one, two]


def _best_interval(features: Points, feature: int, wrong: NDArray[np.bool_]) -> _Interval:
    """Return the interval with the largest excess of wrong over right points (the largest sum of a run)."""
    order = np.argsort(features[:, feature], kind="stable")
    gains = np.where(wrong[order], 1, -1)
    best, low, high, total, start = 0, 0, -1, 0, 0
    for place, gain in enumerate(gains.tolist()):
        if total <= 0:
            total, start = 0, place
        total += gain
        if total > best:
            best, low, high = total, start, place
    if high < low:
        return _Interval(feature, np.inf, -np.inf, 0)
    found = features[order, feature]
    return _Interval(feature, float(found[low]), float(found[high]), best)


def _error(features: Points, intervals: Sequence[_Interval], wrong: NDArray[np.bool_]) -> float:
    inside = np.ones(len(wrong), dtype=bool)
    for one in intervals:
        inside &= one.holds(features)
    return float((inside != wrong).mean())


def _describe(
    one: _Interval, features: Points, labels: Sequence[str], wrong: NDArray[np.bool_], spans: NDArray[np.float64]
) -> str:
    """Write an interval; an end without right points beyond it is left out."""
    values, label = features[:, one.feature], labels[one.feature]
    right = values[~wrong]
    below, above = right[right < one.low], right[right > one.high]
    span = float(spans[one.feature]) or 1.0
    if len(above) and float(values.max()) - one.high < AT_END * span:
        above = above[:0]
    if len(below) and one.low - float(values.min()) < AT_END * span:
        below = below[:0]
    low, high = (_rounded(value, span) for value in (one.low, one.high))
    if not len(above) and not len(below):
        return f"{label} between {low} and {high}"
    if not len(above):
        return f"{label} > {_rounded((float(below.max()) + one.low) / 2, span)}"
    if not len(below):
        return f"{label} < {_rounded((float(above.min()) + one.high) / 2, span)}"
    return f"{label} between {low} and {high}"


def _rounded(value: float, span: float) -> str:
    """Write a number to a hundredth of its range."""
    digits = max(0, 2 - int(np.floor(np.log10(span))))
    return f"{value:z.{digits}f}" if digits <= 9 and abs(value) < 1e6 else f"{value:.3g}"
