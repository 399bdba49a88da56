"""Estimates: a measured number with its confidence interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Values = NDArray[np.float64]
CONFIDENCE = 0.95
RESAMPLES = 200  # of a bootstrap
BLOCKS = {1: (16,), 2: (4, 4)}  # parts of a line, or of a plane, that are left out one at a time


@dataclass(frozen=True)
class Estimate:
    """A number and its 95 % interval; NaN where nothing could be measured."""

    value: float
    low: float
    high: float


UNKNOWN = Estimate(math.nan, math.nan, math.nan)


def exactly(value: float) -> Estimate:
    """Return a number without an interval: it describes only these samples, or they are too few for one."""
    return Estimate(value, math.nan, math.nan)


@dataclass(frozen=True)
class Line:
    """A line fitted to points by least squares, and the standard error of its slope, 0 for two points."""

    slope: float
    intercept: float
    standard_error: float


def fit_line(x: ArrayLike, y: ArrayLike) -> Line:
    """Fit y = slope x + intercept to two or more points. Raises ValueError where all of x are the same."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    if len(np.unique(x)) < 2:
        raise ValueError(f"fit_line needs points at two or more x; got {len(x)} at {np.unique(x).tolist()}")
    (variance, covariance), (_, spread) = np.cov(x, y, bias=True)
    slope = covariance / variance
    correlation = min(1.0, abs(covariance) / np.sqrt(variance * spread)) if spread > 0 else 1.0
    left = (1 - correlation**2) * spread / variance / (len(x) - 2) if len(x) > 2 else 0.0
    return Line(float(slope), float(y.mean() - slope * x.mean()), math.sqrt(left))


def student(freedom: ArrayLike, level: float = (1 + CONFIDENCE) / 2) -> Any:
    """Return the quantile of Student's distribution at a level, by default the upper end of a 95 % interval."""
    from scipy.special import stdtrit  # scipy.stats, which has it too, takes four times as long to import

    return stdtrit(freedom, level)


def jackknife(
    statistic: Callable[[Values], float], samples: Values, *, least: float = -np.inf, most: float = np.inf
) -> Estimate:
    """Measure a slice, and once more without each of its 16 blocks: neighbours depend on each other, blocks hardly.

    The statistic takes samples, shape (u,) or (v, u), NaN where there is none. Delete-a-block jackknife: Kunsch 1989,
    Ann. Statist. 17(3), with Student's interval, truncated to `least` and `most`.
    """
    value = statistic(samples)
    parts = []
    for block in np.ndindex(BLOCKS[samples.ndim]):
        left = samples.copy()
        sides = zip(block, BLOCKS[samples.ndim], samples.shape, strict=True)
        left[tuple(slice(at * size // of, (at + 1) * size // of) for at, of, size in sides)] = np.nan
        parts.append(statistic(left))
    return from_parts(value, parts, least=least, most=most)


def from_parts(value: float, parts: Sequence[float], *, least: float = -np.inf, most: float = np.inf) -> Estimate:
    """Return a number with the jackknife's interval, from values without each part of the samples; NaN is ignored."""
    known = np.array(parts)[np.isfinite(parts)]
    if len(known) < 2 or not math.isfinite(value):
        return exactly(value)
    reach = math.sqrt((len(known) - 1) * float(np.var(known))) * float(student(len(known) - 1))
    return Estimate(value, max(least, value - reach), min(most, value + reach))


def exact_share(found: Estimate, tries: int) -> Estimate:
    """Return a share of dependent tries with an exact interval instead of its symmetric one.

    It is the binomial interval (Clopper & Pearson 1934) of the number of independent tries with the same variance: Korn
    & Graubard 1998, Survey Methodology 24(2). A share of 0 or 1 does not vary, and has the interval of all tries. A
    value without an interval is returned unchanged.
    """
    value, reach = found.value, max(found.value - found.low, found.high - found.value)
    if not math.isfinite(reach):
        return found
    normal = float(student(math.inf))
    count = value * (1 - value) * (normal / reach) ** 2 if reach > 0 else float(tries)
    count = min(count, float(tries))
    return Estimate(value, *_binomial(value * count, count))


def share(hits: int, tries: int) -> Estimate:
    """Return a share with its exact binomial interval (Clopper & Pearson 1934)."""
    if not tries:
        return UNKNOWN
    return Estimate(hits / tries, *_binomial(hits, tries))


def clustered_share(hits: Values, clusters: Sequence[NDArray[np.intp]]) -> Estimate:
    """Return the share of hits among tries, shape (try,), with an interval for tries that are alike within clusters.

    `clusters` are the cluster numbers of each try, by one or several groupings. Of several, the one with the least
    information counts. Without any, the tries are a complete enumeration, so there is no interval. The interval is the
    exact binomial one of the number of independent tries with the same variance, corrected for few clusters: Korn &
    Graubard 1998, Survey Methodology 24(2). Where no two clusters differ, that number is the number of clusters.
    """
    tries = len(hits)
    if not tries:
        return UNKNOWN
    value = float(hits.mean())
    if not clusters:
        return exactly(value)
    count = min(_independent(hits, one) for one in clusters)
    return Estimate(value, *(_binomial(value * count, count) if count > 0 else (0.0, 1.0)))


def _independent(hits: Values, cluster: NDArray[np.intp]) -> float:
    """Return the number of independent tries that would measure a share as precisely as those of clusters."""
    names, of = np.unique(cluster, return_inverse=True)
    if len(names) < 2:
        return 0.0
    value = hits.mean()
    sums = np.bincount(of, hits - value)
    variance = len(names) / (len(names) - 1) * float(np.square(sums).sum()) / len(hits) ** 2
    spread = value * (1 - value)
    count = min(len(hits), spread / variance) if variance > 0 and spread > 0 else float(len(names))
    ratio = float(student(len(hits) - 1)) / float(student(len(names) - 1))
    return float(count * ratio**2)


def _binomial(hits: float, tries: float) -> tuple[float, float]:
    """Return the ends of the exact interval, also for numbers that are not integers."""
    from scipy.special import betaincinv

    tail = (1 - CONFIDENCE) / 2
    low = float(betaincinv(hits, tries - hits + 1, tail)) if hits > 0 else 0.0
    high = float(betaincinv(hits + 1, tries - hits, 1 - tail)) if hits < tries else 1.0
    return low, high


def upper_bound(hits: int, tries: int) -> float:
    """Return the largest share consistent with this few hits, one-sided (Clopper & Pearson 1934); 1 for no tries."""
    if hits >= tries:
        return 1.0
    from scipy.special import betaincinv

    return float(betaincinv(hits + 1, tries - hits, CONFIDENCE))


def mean(values: Values, *, least: float = -np.inf, most: float = np.inf) -> Estimate:
    """Return the mean of independent values, without NaN, with Student's interval."""
    known = values[np.isfinite(values)]
    if not len(known):
        return UNKNOWN
    value = float(known.mean())
    if len(known) == 1:
        return exactly(value)
    reach = float(known.std(ddof=1)) / math.sqrt(len(known)) * float(student(len(known) - 1))
    return Estimate(value, max(least, value - reach), min(most, value + reach))


def middle_95(value: float, drawn: ArrayLike) -> Estimate:
    """Return a number with the middle 95 % of bootstrap draws, shape (resample,)."""
    low, high = np.quantile(np.asarray(drawn), ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return Estimate(value, float(low), float(high))


def ratio(value: float, whole: float) -> float:
    """Return a ratio; zero is 0 of any whole, and nothing else is a share of zero."""
    return value / whole if whole > 0 else 0.0 if value == 0 else math.nan


def gradient_error(grad: Values, reference: Values) -> tuple[Values, Values]:
    """Return cosine and relative error of each gradient, shapes (point,); two that are exactly zero agree."""
    sizes = np.linalg.norm(grad, axis=-1), np.linalg.norm(reference, axis=-1)
    both = (sizes[0] == 0) & (sizes[1] == 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        units = [np.nan_to_num(g / size[:, None]) for g, size in zip((grad, reference), sizes, strict=True)]
        off = np.linalg.norm(grad - reference, axis=-1) / sizes[1]
    return np.where(both, 1.0, (units[0] * units[1]).sum(axis=-1)), np.where(both, 0.0, off)


def spearman(a: Values, b: Values) -> Values:
    """Return Spearman's rank correlation along the last axis, NaN where one side has a single value."""
    from scipy.stats import rankdata

    ranks = [rankdata(side, axis=-1) for side in (a, b)]
    ranks = [rank - rank.mean(axis=-1, keepdims=True) for rank in ranks]
    with np.errstate(invalid="ignore"):
        found: Values = (ranks[0] * ranks[1]).sum(-1) / np.sqrt((ranks[0] ** 2).sum(-1) * (ranks[1] ** 2).sum(-1))
    return found


def median_of(values: Values) -> Values:
    """Return the median along the last axis."""
    return np.asarray(np.median(values, axis=-1))


def p95_of(values: Values) -> Values:
    """Return the 95th percentile along the last axis: the next larger value, not interpolated."""
    return np.asarray(np.quantile(values, 0.95, axis=-1, method="higher"))
