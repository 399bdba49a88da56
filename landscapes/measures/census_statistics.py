"""How the measures of a census spread over its slices, and what they depend on: point, cut, resolution, fidelity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..statistics import CONFIDENCE, Estimate
from .classify import WORDS

Array = NDArray[np.float64]
RESAMPLES = 999
ROUNDING = 1e-9  # of a measure, below which it does not vary
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@dataclass(frozen=True)
class Spread:
    """Hold how a measure is distributed over the slices: its quantiles, and its median with a 95 % interval."""

    quantiles: tuple[float, ...]
    median: Estimate


@dataclass(frozen=True)
class Parts:
    """Hold what shares of a measure's variance over slices go with what; NaN where it does not vary or is not known.

    `base` and `cut` are what the point and the cut do by themselves, `both` what is left: what they do together.
    `resolution` and `fidelity` are the variance that measuring otherwise adds, as shares of the same variance.
    """

    base: float
    cut: float
    both: float
    resolution: float
    fidelity: float


def bootstrap(places: Sequence[tuple[int, int]], *, seed: int) -> NDArray[np.int64]:
    """Draw how often each slice counts, shape (resample, slice): base points and cuts are drawn, each by themselves.

    Slices that share a point or a cut depend on each other (pigeonhole bootstrap: Owen 2007, Ann. Appl. Stat. 1(2)).
    Where there is but one of either it is kept.
    """
    generator, at = np.random.default_rng(seed), np.array(places)
    counts = [
        generator.multinomial(many, np.full(many, 1 / many), size=RESAMPLES)
        if many > 1
        else np.ones((RESAMPLES, 1), int)
        for many in at.max(axis=0) + 1
    ]
    return np.asarray(counts[0][:, at[:, 0]] * counts[1][:, at[:, 1]], dtype=np.int64)


def word_shares(words: Sequence[Sequence[str]], drawn: NDArray[np.int64]) -> dict[str, Estimate]:
    """Return the share of slices that each word fits, with the percentile interval of the resamples."""
    return {word: _share(np.array([word in one for one in words], dtype=float), drawn) for word in WORDS}


def _share(hits: Array, drawn: NDArray[np.int64]) -> Estimate:
    weights = drawn.sum(axis=1)
    found = (drawn @ hits)[weights > 0] / weights[weights > 0]
    return Estimate(float(hits.mean()), *_interval(found))


def spread(values: Array, drawn: NDArray[np.int64]) -> Spread:
    """Return how the values of a measure are distributed, NaN left out."""
    known = np.isfinite(values)
    if not known.any():
        return Spread((np.nan,) * len(QUANTILES), Estimate(np.nan, np.nan, np.nan))
    middle = Estimate(float(np.median(values[known])), *_interval(_medians(values[known], drawn[:, known])))
    return Spread(tuple(float(one) for one in np.quantile(values[known], QUANTILES)), middle)


def _medians(values: Array, drawn: NDArray[np.int64]) -> Array:
    """Return the median of each resample in which there are values: the mean of the one or two in its middle."""
    order = np.argsort(values, kind="stable")
    upto = np.cumsum(drawn[:, order], axis=1)  # how many of a resample there are up to each value
    upto = upto[upto[:, -1] > 0]
    last = upto[:, -1:] - 1
    below, above = (values[order][(upto <= at).sum(axis=1)] for at in (last // 2, (last + 1) // 2))
    return np.asarray((below + above) / 2)


def _interval(found: Array) -> tuple[float, float]:
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(found, [tail, 1 - tail])
    return float(low), float(high)


def divide(table: Array, halved: Array, others: Mapping[int, float], places: Sequence[tuple[int, int]]) -> Parts:
    """Divide the variance of a measure, shape (base, cut), by what the slices differ in.

    Two-way random effects without repetition, by mean squares (Searle, Casella & McCulloch 1992, section 4.3), shares
    below zero cut off. `halved` is the measure at half the resolution, `others` that of some slices, by their numbers
    among `places`, at another fidelity: half the mean square of a difference is the variance that either adds.
    """
    values = np.array([table[place] for place in places])
    total = float(np.nanvar(values, ddof=1)) if np.isfinite(values).sum() > 1 else 0.0
    if not total > (ROUNDING * np.nanmax(np.abs(values), initial=0.0)) ** 2:
        return Parts(*(np.nan,) * 5)
    other = np.array([others.get(number, np.nan) for number in range(len(values))])
    added = [_added(values, one) / total for one in (np.array([halved[place] for place in places]), other)]
    base, cut, both = _components(table)
    whole = base + cut + both
    shares = [one / whole if whole > 0 else np.nan for one in (base, cut, both)]
    return Parts(*shares, *added)


def _added(values: Array, others: Array) -> float:
    squares = np.square(values - others)
    return float(np.nanmean(squares) / 2) if np.isfinite(squares).any() else np.nan


def _components(table: Array) -> tuple[float, float, float]:
    """Return the variance components of rows, columns and the rest; NaN where a cell is missing or there is one row."""
    rows, columns = table.shape
    if not np.isfinite(table).all() or min(rows, columns) < 2:
        return np.nan, np.nan, np.nan
    by_row, by_column, mean = table.mean(axis=1), table.mean(axis=0), table.mean()
    rest = table - by_row[:, None] - by_column + mean
    error = float(np.square(rest).sum() / ((rows - 1) * (columns - 1)))
    base = (columns * float(by_row.var(ddof=1)) - error) / columns
    cut = (rows * float(by_column.var(ddof=1)) - error) / rows
    return max(base, 0.0), max(cut, 0.0), error
