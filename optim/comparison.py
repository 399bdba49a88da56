"""Two methods against each other: the difference of their mean final losses, and who has the lesser one how often."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .bootstrap import Array, percentiles, weights
from .curves import Tables, final_losses

LEVEL = 0.05  # of error, over all pairs of a race together
EXACT = 10_000  # pairs of seeds up to which the rank test counts arrangements


@dataclass(frozen=True)
class Difference:
    """The mean final loss of `first` less that of `second`, with its interval: below zero, `first` is better."""

    first: str
    second: str
    mean: float
    low: float
    high: float

    derived = ("better",)

    @property
    def better(self) -> str | None:
        """The method whose lead the interval leaves no doubt about, None where it includes zero or there is none."""
        return self.first if self.high < 0 else self.second if self.low > 0 else None

    @property
    def reversed(self) -> Difference:
        """The same difference, seen from the second method."""
        return Difference(self.second, self.first, -self.mean, -self.high, -self.low)


@dataclass(frozen=True)
class Superiority:
    """The probability that `first` ends with a lesser loss than `second`, each with a seed of its own; a tie is half.

    A run without success ends behind all others. `p` is that of the rank test of Mann and Whitney that neither is
    ahead, `corrected` the same after Holm's correction for all pairs of the race.
    """

    first: str
    second: str
    probability: float
    p: float
    corrected: float

    derived = ("better",)

    @property
    def better(self) -> str | None:
        """The method that is ahead at a level of 5 % over all pairs of the race together, None where neither is."""
        if not self.corrected < LEVEL:
            return None
        return self.first if self.probability > 0.5 else self.second

    @property
    def reversed(self) -> Superiority:
        """The same, seen from the second method."""
        return replace(self, first=self.second, second=self.first, probability=1 - self.probability)


def differences(tables: Tables) -> list[Difference]:
    """Return the difference of every two methods; seeds are resampled apart, since they are not pairs."""
    pairs = itertools.combinations(zip(tables, final_losses(tables), strict=True), 2)
    return [difference(first, a, second, b) for (first, a), (second, b) in pairs]


def difference(first: str, a: Array, second: str, b: Array) -> Difference:
    """Return the difference of two methods from their final losses, shapes (seed,)."""
    random = np.random.default_rng(0)
    shares = np.hstack([weights(len(a), random), -weights(len(b), random)])
    low, high = percentiles(np.concatenate([a, b]), shares)
    if min(len(a), len(b)) == 1:
        low = high = np.array(np.nan)
    return Difference(first, second, float(a.mean() - b.mean()), float(low), float(high))


def superiorities(tables: Tables) -> list[Superiority]:
    """Return how every two methods stand to each other, in the order of `differences`."""
    pairs = list(itertools.combinations(zip(tables, final_losses(tables), strict=True), 2))
    ps = [rank_test(a, b) for (_, a), (_, b) in pairs]
    return [
        Superiority(first, second, win_probability(a, b), p, corrected)
        for ((first, a), (second, b)), p, corrected in zip(pairs, ps, holm(ps), strict=True)
    ]


def win_probability(a: Array, b: Array) -> float:
    """Return the share of pairs in which a loss of `a` is less than one of `b`, shapes (seed,); a tie is half a win.

    This is the probability of superiority, Mann and Whitney's U by the number of pairs (Vargha & Delaney 2000).
    """
    a, b = _placed(a)[:, None], _placed(b)
    return float(((a < b) + 0.5 * (a == b)).mean())


def rank_test(a: Array, b: Array) -> float:
    """Return the two-sided p of Mann and Whitney's rank test, by scipy: exact without ties, else with their correction.

    It is 1 where all losses are the same.
    """
    from scipy.stats import mannwhitneyu

    a, b = _placed(a), _placed(b)
    both = np.concatenate([a, b])
    distinct = len(np.unique(both))
    if distinct == 1:
        return 1.0
    exact = distinct == len(both) and len(a) * len(b) <= EXACT
    return float(mannwhitneyu(a, b, alternative="two-sided", method="exact" if exact else "asymptotic").pvalue)


def holm(ps: Sequence[float]) -> list[float]:
    """Return p-values corrected for that there are several of them (Holm 1979): the chance of one error in all."""
    order = np.argsort(ps, kind="stable")
    scaled = np.array(ps)[order] * np.arange(len(ps), 0, -1)
    found = np.empty(len(ps))
    found[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return list(map(float, found))


def _placed(losses: Array) -> NDArray[np.float64]:
    """Return losses to be ordered, infinite where a run had no success."""
    return np.where(np.isfinite(losses), losses, np.inf)
