"""Estimates: a measured number with its confidence interval."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from .plain import finite, or_nan

Values = NDArray[np.float64]
CONFIDENCE = 0.95
BLOCKS = {1: (16,), 2: (4, 4)}  # parts of a line, or of a plane, that are left out one at a time


class EstimateRecord(TypedDict):
    """An estimate as plain JSON; None where nothing could be measured."""

    value: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Estimate:
    """Hold a number and its 95 % interval; NaN where nothing could be measured."""

    value: float
    low: float
    high: float

    def record(self) -> EstimateRecord:
        """Return it as plain JSON."""
        return {"value": finite(self.value), "low": finite(self.low), "high": finite(self.high)}

    @classmethod
    def of_record(cls, record: EstimateRecord) -> Estimate:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(or_nan(record["value"]), or_nan(record["low"]), or_nan(record["high"]))


def jackknife(
    statistic: Callable[[Values], float], samples: Values, *, least: float = -np.inf, most: float = np.inf
) -> Estimate:
    """Measure a slice, and once more without each of 16 blocks of it: neighbours depend on each other, blocks hardly.

    The statistic takes samples, shape (u,) or (v, u), NaN where there is none. Delete-a-block jackknife: Kunsch 1989,
    Ann. Statist. 17(3), with Student's interval, cut off at `least` and `most`.
    """
    value = statistic(samples)
    parts = []
    for block in np.ndindex(BLOCKS[samples.ndim]):
        left = samples.copy()
        sides = zip(block, BLOCKS[samples.ndim], samples.shape, strict=True)
        left[tuple(slice(at * size // of, (at + 1) * size // of) for at, of, size in sides)] = np.nan
        parts.append(statistic(left))
    known = np.array(parts)[np.isfinite(parts)]
    if len(known) < 2 or not math.isfinite(value):
        return Estimate(value, math.nan, math.nan)
    deviation = math.sqrt((len(known) - 1) * float(np.mean((known - known.mean()) ** 2)))
    reach = deviation * float(stats.t.ppf((1 + CONFIDENCE) / 2, len(known) - 1))
    return Estimate(value, max(least, value - reach), min(most, value + reach))


def share(hits: int, tries: int) -> Estimate:
    """Return a share with its exact binomial interval (Clopper & Pearson 1934)."""
    if not tries:
        return Estimate(math.nan, math.nan, math.nan)
    interval = stats.binomtest(hits, tries).proportion_ci(CONFIDENCE)
    return Estimate(hits / tries, float(interval.low), float(interval.high))


def mean(values: Values, *, least: float = -np.inf, most: float = np.inf) -> Estimate:
    """Return the mean of independent values, NaN left out, with Student's interval."""
    known = values[np.isfinite(values)]
    if not len(known):
        return Estimate(math.nan, math.nan, math.nan)
    value = float(known.mean())
    if len(known) == 1:
        return Estimate(value, math.nan, math.nan)
    reach = float(stats.sem(known) * stats.t.ppf((1 + CONFIDENCE) / 2, len(known) - 1))
    return Estimate(value, max(least, value - reach), min(most, value + reach))
