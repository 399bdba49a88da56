"""What a race's runs say: best loss against cost, shares of targets reached, ranks, and who beats whom.

Everything is over the seeds of a method. Intervals are 95 % percentile-bootstrap intervals of a mean: the percentiles
2.5 and 97.5 of the means of 10 000 resamples of the seeds (Efron & Tibshirani 1993, section 13.3). There is none for a
single seed. They are too narrow where seeds are few: of normal samples of 3, 5, 10 and 30 they cover the true mean in
about 75, 84, 91 and 93 % of cases; and of two equal methods with 3, 5 or 10 seeds each, one is called better in about
20, 10 and 7 % of cases.

A failed episode costs what any other does and improves nothing. Before its first success a run has no best loss (NaN),
so the mean over seeds begins where the last of them has had a success.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.stats import rankdata

from .base import Kind
from .runs.arrays import FORWARD_EQUIVALENTS, stored_record

COSTS = ("episodes", FORWARD_EQUIVALENTS, "seconds")
RESAMPLES = 10_000
PERCENTILES = (2.5, 97.5)  # of the resampled means, where an interval ends
TARGETS = 50
DECADE = 10.0  # targets and axes are logarithmic where losses are positive and span at least this factor
COLUMNS_AT_ONCE = 128  # columns resampled together, to bound memory

Array = NDArray[np.float64]
Tables = Mapping[str, Sequence[xr.Dataset]]  # method -> one run's table per seed, all of the same length


@dataclass(frozen=True, eq=False)
class Curve:
    """The mean of the best loss over seeds as a step function of a cost: `mean[i]` from `cost[i]` on."""

    cost: Array
    mean: Array
    low: Array
    high: Array


@dataclass(frozen=True, eq=False)
class Targets:
    """Losses to reach, the hardest first; `easiest` says what the last one is, `spacing` is log or linear."""

    loss: Array
    spacing: str
    easiest: str


@dataclass(frozen=True)
class Rank:
    """How a method came off in the end: ranks are 1 for the best, ties share theirs; NaN where there is none.

    `wins` counts the seeds in which no method was better; `unsuccessful` those without one successful episode; `failed`
    the episodes that failed; `forward_equivalents` and `seconds` are the mean cost of a run.
    """

    method: str
    rank: float
    rank_low: float
    rank_high: float
    wins: int
    final: tuple[float, ...]
    mean: float
    low: float
    high: float
    unsuccessful: int
    failed: int
    forward_equivalents: float
    seconds: float


@dataclass(frozen=True)
class Difference:
    """The mean final loss of `first` less that of `second`, with its interval: below zero, `first` is better."""

    first: str
    second: str
    mean: float
    low: float
    high: float

    @property
    def better(self) -> str | None:
        """The method whose lead the interval leaves no doubt about, None where it includes zero or there is none."""
        return self.first if self.high < 0 else self.second if self.low > 0 else None

    @property
    def reversed(self) -> Difference:
        """The same difference, seen from the second method."""
        return Difference(self.second, self.first, -self.mean, -self.high, -self.low)


@dataclass(frozen=True)
class Shares:
    """The share of targets reached as a step function of episodes: `share[i]` from `episodes[i]` on."""

    episodes: list[float]
    share: list[float]

    @classmethod
    def of(cls, hits: Array) -> Shares:
        """Return the share of hits, NaN where there is none, that had come by each episode."""
        reached = np.sort(hits[np.isfinite(hits)])
        return cls(reached.tolist(), (np.arange(1, len(reached) + 1) / hits.size).tolist())


@dataclass(frozen=True, eq=False)
class RaceStatistics:
    """All figures of a race: ranks, the best first, differences of every two methods, targets, and by method curves.

    `ecdf` is the share of pairs of target and seed reached, `curves` the mean best loss against each of `COSTS`.
    """

    ranks: list[Rank]
    differences: list[Difference]
    targets: Targets
    ecdf: dict[str, Shares]
    curves: dict[str, dict[str, Curve]]

    @classmethod
    def of(cls, tables: Tables) -> RaceStatistics:
        """Compute the figures of runs."""
        goals = targets(tables)
        curves = {cost: {method: curve(runs, cost) for method, runs in tables.items()} for cost in COSTS}
        ecdf = {method: Shares.of(hits(runs, goals)) for method, runs in tables.items()}
        return cls(ranks(tables), differences(tables), goals, ecdf, curves)

    def record(self) -> dict[str, Any]:
        """Return the figures as JSON has them."""
        return {
            "ranks": [stored_record(rank) for rank in self.ranks],
            "differences": [asdict(one) | {"better": one.better} for one in self.differences],
            "targets": asdict(self.targets) | {"loss": self.targets.loss.tolist()},
            "ecdf": {method: asdict(shares) for method, shares in self.ecdf.items()},
            "curves": {
                cost: {
                    method: {key: values.tolist() for key, values in asdict(one).items()} for method, one in by.items()
                }
                for cost, by in self.curves.items()
            },
        }


def best_so_far(loss: Array) -> Array:
    """Return the least loss up to each episode, NaN before the first success."""
    return np.fmin.accumulate(loss)


def interval(values: Array) -> tuple[Array, Array]:
    """Return the interval of the mean over the first axis (seeds), NaN for a single seed or where a value is."""
    return _percentiles(values, _weights(len(values), np.random.default_rng(0)))


def curve(runs: Sequence[xr.Dataset], cost: str) -> Curve:
    """Return a method's curve against one of `COSTS`, from its first value to where the first run ends."""
    spent = [run[cost].to_numpy().astype(float) for run in runs]
    best = [best_so_far(run["loss"].to_numpy()) for run in runs]
    changes = [s[np.flatnonzero(np.diff(b, prepend=np.nan) != 0)] for s, b in zip(spent, best, strict=True)]
    start = max((_first(s, b) for s, b in zip(spent, best, strict=True)), default=np.inf)
    end = min(s[-1] for s in spent)
    grid = np.unique(np.concatenate([*changes, [end]]))
    grid = grid[(grid >= start) & (grid <= end)]
    values = np.stack([b[np.searchsorted(s, grid, side="right") - 1] for s, b in zip(spent, best, strict=True)])
    return Curve(grid, values.mean(axis=0), *interval(values))


def targets(tables: Tables) -> Targets:
    """Return 50 losses from the best that any run reached to the median of random points, as COCO spaces them.

    Without the method `random` the easiest is the median of the first loss of each run. They are spaced by their
    logarithms where all are positive and span a decade, else evenly. There is none where every episode failed.
    """
    losses = np.concatenate([run["loss"].to_numpy() for runs in tables.values() for run in runs])
    if not np.isfinite(losses).any():
        return Targets(np.empty(0), "linear", "no episode succeeded")
    low = float(np.nanmin(losses))
    high, easiest = _easiest(tables)
    if not high > low:
        return Targets(np.array([low]), "linear", easiest)
    spaced, spacing = (np.geomspace, "log") if low > 0 and high >= DECADE * low else (np.linspace, "linear")
    return Targets(spaced(low, high, TARGETS), spacing, easiest)


def hits(runs: Sequence[xr.Dataset], goals: Targets) -> Array:
    """Return the episodes after which each target was first reached, shape (seed, target), NaN where it never was."""
    found = np.full((len(runs), len(goals.loss)), np.nan)
    for row, run in zip(found, runs, strict=True):
        best, episodes = best_so_far(run["loss"].to_numpy()), run["episodes"].to_numpy()
        reached = best[:, None] <= goals.loss
        where = reached.any(axis=0)
        row[where] = episodes[reached.argmax(axis=0)[where]]
    return found


def final_losses(tables: Tables) -> Array:
    """Return the best loss of every run, shape (method, seed), NaN where no episode succeeded."""
    return np.array([[best_so_far(run["loss"].to_numpy())[-1] for run in runs] for runs in tables.values()])


def ranks(tables: Tables) -> list[Rank]:
    """Return how every method came off, the best mean rank first; within a seed, runs without success are last."""
    final = final_losses(tables)
    comparable = np.where(np.isfinite(final), final, np.inf)
    places = rankdata(comparable, method="average", axis=0)
    won = np.isfinite(final) & (comparable == comparable.min(axis=0))
    found = [
        _rank(method, runs, places[row], won[row], final[row]) for row, (method, runs) in enumerate(tables.items())
    ]
    return sorted(found, key=lambda rank: (rank.rank, rank.method))


def _rank(method: str, runs: Sequence[xr.Dataset], places: Array, won: NDArray[np.bool_], final: Array) -> Rank:
    (rank_low, rank_high), (low, high) = interval(places), interval(final)
    return Rank(
        method=method,
        rank=float(places.mean()),
        rank_low=float(rank_low),
        rank_high=float(rank_high),
        wins=int(won.sum()),
        final=tuple(map(float, final)),
        mean=float(final.mean()),
        low=float(low),
        high=float(high),
        unsuccessful=int(np.isnan(final).sum()),
        failed=sum(int(np.isnan(run["loss"]).sum()) for run in runs),
        forward_equivalents=float(np.mean([run[FORWARD_EQUIVALENTS][-1] for run in runs])),
        seconds=float(np.mean([run["seconds"][-1] for run in runs])),
    )


def differences(tables: Tables) -> list[Difference]:
    """Return the difference of every two methods; seeds are resampled apart, since they are not pairs."""
    pairs = itertools.combinations(zip(tables, final_losses(tables), strict=True), 2)
    return [difference(first, a, second, b) for (first, a), (second, b) in pairs]


def difference(first: str, a: Array, second: str, b: Array) -> Difference:
    """Return the difference of two methods from their final losses, shapes (seed,)."""
    random = np.random.default_rng(0)
    weights = np.hstack([_weights(len(a), random), -_weights(len(b), random)])
    low, high = _percentiles(np.concatenate([a, b]), weights)
    if min(len(a), len(b)) == 1:
        low = high = np.array(np.nan)
    return Difference(first, second, float(a.mean() - b.mean()), float(low), float(high))


def _weights(seeds: int, random: np.random.Generator) -> Array:
    """Return how often each seed is in each resample, as a share, shape (resample, seed)."""
    return random.multinomial(seeds, np.full(seeds, 1 / seeds), RESAMPLES) / seeds


def _percentiles(values: Array, weights: Array) -> tuple[Array, Array]:
    columns = values.reshape(len(values), -1)
    ends = np.full((2, columns.shape[1]), np.nan)
    known = np.flatnonzero(np.isfinite(columns).all(axis=0)) if len(values) > 1 else np.empty(0, int)
    for start in range(0, len(known), COLUMNS_AT_ONCE):
        some = known[start : start + COLUMNS_AT_ONCE]
        ends[:, some] = np.percentile(weights @ columns[:, some], PERCENTILES, axis=0)
    return ends[0].reshape(values.shape[1:]), ends[1].reshape(values.shape[1:])


def _first(spent: Array, best: Array) -> float:
    """Return what the first success had cost, infinity without one."""
    successes = np.flatnonzero(np.isfinite(best))
    return float(spent[successes[0]]) if len(successes) else np.inf


def _easiest(tables: Tables) -> tuple[float, str]:
    random = [run["loss"].to_numpy()[run["kind"].to_numpy() == Kind.RANDOM] for run in tables.get("random", ())]
    drawn = np.concatenate(random) if random else np.empty(0)
    if np.isfinite(drawn).any():
        return float(np.nanmedian(drawn)), "median loss of the random points"
    firsts = [run["loss"].to_numpy() for runs in tables.values() for run in runs]
    begun = [loss[np.isfinite(loss)][0] for loss in firsts if np.isfinite(loss).any()]
    return float(np.median(begun)), "median of the first loss of each run"
