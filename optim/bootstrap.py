"""Bootstrap intervals of means over seeds.

They are 95 % percentile intervals: the percentiles 2.5 and 97.5 of the means of 10 000 resamples of the seeds (Efron &
Tibshirani 1993, section 13.3). There is none for a single seed. They are too narrow where seeds are few: of normal
samples of 3, 5, 10 and 30 they cover the true mean in about 75, 84, 91 and 93 % of cases; and of two equal methods with
3, 5 or 10 seeds each, one is called better in about 20, 10 and 7 % of cases.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 10_000
PERCENTILES = (2.5, 97.5)  # of the resampled means, where an interval ends
COLUMNS_AT_ONCE = 128  # columns resampled together, to bound memory

Array = NDArray[np.float64]


def interval(values: Array) -> tuple[Array, Array]:
    """Return the interval of the mean over the first axis (seeds), NaN for a single seed or where a value is."""
    return percentiles(values, weights(len(values), np.random.default_rng(0)))


def weights(seeds: int, random: np.random.Generator) -> Array:
    """Return how often each seed is in each resample, as a share, shape (resample, seed)."""
    return random.multinomial(seeds, np.full(seeds, 1 / seeds), RESAMPLES) / seeds


def percentiles(values: Array, weights: Array) -> tuple[Array, Array]:
    """Return the ends of the interval of weighted sums over the first axis (seeds), NaN where a value is."""
    columns = values.reshape(len(values), -1)
    ends = np.full((2, columns.shape[1]), np.nan)
    known = np.flatnonzero(np.isfinite(columns).all(axis=0)) if len(values) > 1 else np.empty(0, int)
    for start in range(0, len(known), COLUMNS_AT_ONCE):
        some = known[start : start + COLUMNS_AT_ONCE]
        ends[:, some] = np.percentile(weights @ columns[:, some], PERCENTILES, axis=0)
    return ends[0].reshape(values.shape[1:]), ends[1].reshape(values.shape[1:])
