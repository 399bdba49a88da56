"""Statistics of a race's runs: ranks, who is ahead of whom, best loss against cost, targets reached, and running times.

Everything is over the seeds of a method. A failed episode costs as much as any other and improves nothing. Before its
first success a run has no best loss (NaN), so a mean over seeds begins when the last of them has succeeded.

Intervals are 95 % percentile intervals by the bootstrap: the percentiles 2.5 and 97.5 of the means of 10 000 resamples
of the seeds (Efron & Tibshirani 1993, section 13.3). There is none for a single seed. With few seeds they are too
narrow: of normal samples of 3, 5, 10 and 30 they cover the true mean in about 75, 84, 91 and 93 % of cases. So no
interval decides who is better. Only the rank test does, corrected for all pairs of the race.

A gradient costs more than a loss. So ranks exist twice: after the same number of episodes, and within the same cost in
forward equivalents, the smallest total of any run of the race.

Targets are 51 losses between the best known loss and the median of random points, spaced by their logarithms, as COCO
spaces 51 precisions between 10^-8 and 10^2 (Hansen et al. 2021, section 3).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..landscapes.plain import finite
from .base import Kind

RESAMPLES = 10_000
PERCENTILES = (2.5, 97.5)  # of the resampled means, where an interval ends
COLUMNS_AT_ONCE = 128  # columns resampled together, to bound memory
COSTS = ("episodes", "forwards", "seconds")
LEVEL = 0.05  # of error, over all pairs of a race together
EXACT = 10_000  # pairs of seeds up to which the rank test counts arrangements
TARGETS = 51
EVERY = 10  # of them, where some stand for all
HARDEST = 1e-8  # at least, against the easiest: what COCO's hardest precision is to 1

Array = NDArray[np.float64]
Tables = Mapping[str, Sequence[xr.Dataset]]  # method -> one run's table per seed, all of the same length


def interval(values: Array) -> tuple[Array, Array]:
    """Return the interval of the mean over the first axis (seeds), NaN for a single seed or where a value is NaN."""
    return percentiles(values, weights(len(values), np.random.default_rng(0)))


def weights(seeds: int, random: np.random.Generator) -> Array:
    """Return how often each seed is in each resample, as a share, shape (resample, seed)."""
    return random.multinomial(seeds, np.full(seeds, 1 / seeds), RESAMPLES) / seeds


def percentiles(values: Array, weights: Array) -> tuple[Array, Array]:
    """Return the ends of the interval of weighted sums over the first axis (seeds), NaN where a value is NaN."""
    columns = values.reshape(len(values), -1)
    ends = np.full((2, columns.shape[1]), np.nan)
    known = np.flatnonzero(np.isfinite(columns).all(axis=0)) if len(values) > 1 else np.empty(0, int)
    for start in range(0, len(known), COLUMNS_AT_ONCE):
        some = known[start : start + COLUMNS_AT_ONCE]
        ends[:, some] = np.percentile(weights @ columns[:, some], PERCENTILES, axis=0)
    return ends[0].reshape(values.shape[1:]), ends[1].reshape(values.shape[1:])


@dataclass(frozen=True, eq=False)
class Curve:
    """The mean of the best loss over seeds as a step function of a cost: `mean[i]` from `cost[i]` on."""

    cost: Array
    mean: Array
    low: Array
    high: Array


def best_so_far(loss: Array) -> Array:
    """Return the lowest loss up to each episode, NaN before the first success."""
    return np.fmin.accumulate(loss)


def final_losses(tables: Tables, forwards: float = np.inf) -> Array:
    """Return the best loss of every run within a cost [forward equivalents], shape (method, seed), NaN for none."""
    return np.array([[_best_within(run, forwards) for run in runs] for runs in tables.values()])


def _best_within(run: xr.Dataset, forwards: float) -> float:
    loss = run["loss"].to_numpy()[~(run["forwards"].to_numpy() > forwards)]
    return float(best_so_far(loss)[-1]) if len(loss) else np.nan


def least_spent(tables: Tables) -> float:
    """Return the smallest total cost of any run [forward equivalents], up to which all runs can be compared."""
    return min(float(run["forwards"][-1]) for runs in tables.values() for run in runs)


def curve(runs: Sequence[xr.Dataset], cost: str) -> Curve:
    """Return a method's curve against one of `COSTS`, from its first value to the end of the shortest run."""
    spent = [run[cost].to_numpy().astype(float) for run in runs]
    best = [best_so_far(run["loss"].to_numpy()) for run in runs]
    changes = [s[np.flatnonzero(np.diff(b, prepend=np.nan) != 0)] for s, b in zip(spent, best, strict=True)]
    start = max((_first(s, b) for s, b in zip(spent, best, strict=True)), default=np.inf)
    end = min(s[-1] for s in spent)
    grid = np.unique(np.concatenate([*changes, [end]]))
    grid = grid[(grid >= start) & (grid <= end)]
    values = np.stack([b[np.searchsorted(s, grid, side="right") - 1] for s, b in zip(spent, best, strict=True)])
    return Curve(grid, values.mean(axis=0), *interval(values))


def _first(spent: Array, best: Array) -> float:
    """Return the cost of the first success, infinity without one."""
    successes = np.flatnonzero(np.isfinite(best))
    return float(spent[successes[0]]) if len(successes) else np.inf


@dataclass(frozen=True)
class Difference:
    """The mean final loss of `first` minus that of `second`, with its interval, which shows its size.

    `Superiority` decides whether one of them is better.
    """

    first: str
    second: str
    mean: float
    low: float
    high: float

    @property
    def reversed(self) -> Difference:
        """The same difference, seen from the second method."""
        return Difference(self.second, self.first, -self.mean, -self.high, -self.low)


@dataclass(frozen=True)
class Superiority:
    """The probability that `first` ends with a lower loss than `second`, each with its own seed; a tie counts half.

    A run without success ends behind all others. `p` is that of Mann and Whitney's rank test that neither is ahead;
    `corrected` is the same after Holm's correction for all pairs of the race.
    """

    first: str
    second: str
    probability: float
    p: float
    corrected: float

    derived = ("better",)

    @property
    def better(self) -> str | None:
        """The method that is ahead at a level of 5 % over all pairs of the race; None: not distinguishable."""
        if not self.corrected < LEVEL:
            return None
        return self.first if self.probability > 0.5 else self.second

    @property
    def reversed(self) -> Superiority:
        """The same, seen from the second method."""
        return replace(self, first=self.second, second=self.first, probability=1 - self.probability)


def differences(tables: Tables) -> list[Difference]:
    """Return the difference of all pairs of methods; seeds are resampled independently, because they are not pairs."""
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


@dataclass(frozen=True)
class Lead:
    """The leader of a race: the method with the best mean rank, and the others that it is not ahead of (`rivals`).

    It is first only if there are none. `p` is the largest corrected p of its comparisons, NaN for a single method.
    """

    method: str
    rivals: tuple[str, ...]
    p: float

    derived = ("is_first",)

    @classmethod
    def of(cls, methods: Sequence[str], pairs: Sequence[Superiority]) -> Lead:
        """Return the lead among methods, the best mean rank first."""
        best, *others = methods
        found = {one.second: one for one in seen_from(best, pairs)}
        rivals = tuple(other for other in others if found[other].better != best)
        return cls(best, rivals, max((one.corrected for one in found.values()), default=np.nan))

    @property
    def is_first(self) -> bool:
        """Whether the method is ahead of every other one after the correction for all pairs."""
        return not self.rivals and not np.isnan(self.p)

    def describe(self) -> str:
        """Name the first method, or those not distinguishable from the method with the best mean rank."""
        if np.isnan(self.p):
            return f"{self.method} raced alone"
        if self.is_first:
            return f"{self.method} is first: ahead of every other method (corrected p at most {self.p:.2g})"
        return (
            f"no method is first: {self.method} has the best mean rank, "
            f"not distinguishable from {', '.join(self.rivals)} (corrected p up to {self.p:.2g})"
        )

    def summarise(self) -> str:
        """Give the same in one line, for a picture."""
        if self.is_first or not self.rivals:
            return self.describe()
        others = f"{len(self.rivals)} others" if len(self.rivals) > 1 else self.rivals[0]
        return f"none is first: {self.method}, of the best mean rank, is not distinguishable from {others}"


def seen_from(method: str, pairs: Sequence[Superiority]) -> list[Superiority]:
    """Return the comparison of a method with each of the others."""
    return [one for pair in pairs for one in (pair, pair.reversed) if one.first == method]


def not_told_from(method: str, methods: Sequence[str], pairs: Sequence[Superiority]) -> tuple[str, ...]:
    """Return the methods that are not distinguishable from one after the correction, in their order."""
    undecided = {one.second for one in seen_from(method, pairs) if one.better is None}
    return tuple(other for other in methods if other in undecided)


@dataclass(frozen=True)
class MeanRank:
    """The mean rank of a method over seeds, 1 for the best, with its interval."""

    method: str
    rank: float
    low: float
    high: float


@dataclass(frozen=True)
class EqualCost:
    """Compare methods at the same cost, `forwards` [forward equivalents]: their ranks, the best first, and pairs.

    Pairs are those of `Superiority`, corrected among themselves.
    """

    forwards: float
    ranks: tuple[MeanRank, ...]
    pairs: tuple[Superiority, ...]

    derived = ("lead",)

    @classmethod
    def of(cls, tables: Tables) -> EqualCost:
        """Compare runs within the smallest total cost of any of them."""
        forwards = least_spent(tables)
        return cls.within(forwards, list(tables), final_losses(tables, forwards))

    @classmethod
    def within(cls, forwards: float, methods: Sequence[str], final: Array) -> EqualCost:
        """Compare the best losses of methods within a cost, shape (method, seed)."""
        ranks = [
            MeanRank(method, float(places.mean()), *map(float, interval(places)))
            for method, places in zip(methods, seed_ranks(final), strict=True)
        ]
        best_first = sorted(ranks, key=lambda one: (one.rank, one.method))
        return cls(forwards, tuple(best_first), tuple(superiorities(dict(zip(methods, final, strict=True)))))

    @property
    def lead(self) -> Lead:
        """The leader at this cost."""
        return Lead.of([one.method for one in self.ranks], self.pairs)


def superiorities(final: Mapping[str, Array]) -> list[Superiority]:
    """Return the comparison of all pairs of methods by their final losses, in the order of `differences`."""
    pairs = list(itertools.combinations(final.items(), 2))
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


def seed_ranks(final: Array) -> Array:
    """Return the rank of each method within each seed, 1 for the least loss, ties shared, the last without success."""
    from scipy.stats import rankdata

    found: Array = rankdata(_placed(final), method="average", axis=0)
    return found


def holm(ps: Sequence[float]) -> list[float]:
    """Return p-values corrected for multiple tests (Holm 1979): the chance of a single error among all."""
    order = np.argsort(ps, kind="stable")
    scaled = np.array(ps)[order] * np.arange(len(ps), 0, -1)
    found = np.empty(len(ps))
    found[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return list(map(float, found))


def _placed(losses: Array) -> NDArray[np.float64]:
    """Return losses for ordering, infinite where a run had no success."""
    return np.where(np.isfinite(losses), losses, np.inf)


@dataclass(frozen=True, eq=False)
class Targets:
    """Losses to reach, the hardest first; `easiest` describes the last one, `spacing` is log or linear.

    `best_known` is the lowest known loss, of the race or from elsewhere, NaN where no episode succeeded.
    """

    loss: Array
    spacing: str
    easiest: str
    best_known: float = np.nan

    @property
    def some(self) -> list[int]:
        """The numbers of the targets to show where there is no room for all: every tenth, with both ends."""
        return list(range(0, len(self.loss), EVERY))


@dataclass(frozen=True)
class Shares:
    """The share of targets reached as a step function of episodes: `share[i]` from `episodes[i]` on."""

    episodes: list[float]
    share: list[float]

    @classmethod
    def of(cls, hits: Array) -> Shares:
        """Return the share of hits reached by each episode, NaN where there is none."""
        reached = np.sort(hits[np.isfinite(hits)])
        return cls(reached.tolist(), (np.arange(1, len(reached) + 1) / hits.size).tolist())


def targets(tables: Tables, best_known: float | None = None) -> Targets:
    """Return 51 losses from the best known to the median of random points, spaced by their logarithms.

    The best known is the lowest of the race, or `best_known` if that is lower. Without the method `random`, the easiest
    is the median of the first loss of each run. The hardest is the best known loss. If that is not negative but below
    10^-8 of the easiest, the hardest is 10^-8 of the easiest. If a loss is negative or the easiest is zero, there are
    no logarithms, and the targets are spaced evenly. There is none where every episode failed.
    """
    losses = np.concatenate([run["loss"].to_numpy() for runs in tables.values() for run in runs])
    if not np.isfinite(losses).any():
        return Targets(np.empty(0), "linear", "no episode succeeded")
    low = best = float(np.nanmin([*losses, np.nan if best_known is None else best_known]))
    high, easiest = _easiest(tables)
    if not high > low:
        return Targets(np.array([low]), "linear", easiest, best)
    if low < 0:
        return Targets(np.linspace(low, high, TARGETS), "linear", easiest, best)
    return Targets(np.geomspace(max(low, HARDEST * high), high, TARGETS), "log", easiest, best)


def hits(runs: Sequence[xr.Dataset], goals: Targets) -> Array:
    """Return the episodes after which each target was first reached, shape (seed, target), NaN if never."""
    found = np.full((len(runs), len(goals.loss)), np.nan)
    for row, run in zip(found, runs, strict=True):
        best, episodes = best_so_far(run["loss"].to_numpy()), run["episodes"].to_numpy()
        reached = best[:, None] <= goals.loss
        where = reached.any(axis=0)
        row[where] = episodes[reached.argmax(axis=0)[where]]
    return found


def running_times(runs: Sequence[xr.Dataset], goals: Targets) -> Array:
    """Return a method's expected running time (ERT) for each target [episodes], infinite where no run reached it.

    ERT is the total cost of all runs until the target, successful or not, divided by the number of runs that reached
    it: the cost of restarts until the first success (Hansen et al. 2021, section 4).
    """
    reached = hits(runs, goals)
    spent = np.array([[float(run["episodes"][-1])] for run in runs])
    total = np.where(np.isfinite(reached), reached, spent).sum(axis=0)
    successes = np.isfinite(reached).sum(axis=0)
    times: Array = np.divide(total, successes, out=np.full(len(goals.loss), np.inf), where=successes > 0)
    return times


def times_record(times: Array) -> list[float | None]:
    """Return running times as JSON numbers with six digits; None for targets that were never reached."""
    return [finite(float(f"{one:.6g}")) for one in times]


def _easiest(tables: Tables) -> tuple[float, str]:
    random = [run["loss"].to_numpy()[run["kind"].to_numpy() == Kind.RANDOM] for run in tables.get("random", ())]
    drawn = np.concatenate(random) if random else np.empty(0)
    if np.isfinite(drawn).any():
        return float(np.nanmedian(drawn)), "median loss of the random points"
    firsts = [run["loss"].to_numpy() for runs in tables.values() for run in runs]
    begun = [loss[np.isfinite(loss)][0] for loss in firsts if np.isfinite(loss).any()]
    return float(np.median(begun)), "median of the first loss of each run"


@dataclass(frozen=True)
class Rank:
    """A method's final result: ranks are 1 for the best, ties share theirs; NaN where there is none.

    `wins` counts the seeds in which no method was better, `unsuccessful` those without a successful episode, and
    `failed` the failed episodes. `forwards` (forward equivalents) and `seconds` are the mean cost of a run.
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
    forwards: float
    seconds: float


@dataclass(frozen=True, eq=False)
class RaceStatistics:
    """All figures of a race: ranks, the best first, comparisons of all pairs of methods, targets, and curves by method.

    `equal_cost` has ranks and comparisons at equal forward equivalents; all others are at equal episodes. `ecdf` is the
    share of pairs of target and seed reached, `running_times` the expected running time for each target [episodes],
    `curves` the mean best loss against each of `COSTS`.
    """

    ranks: list[Rank]
    differences: list[Difference]
    superiorities: list[Superiority]
    equal_cost: EqualCost
    targets: Targets
    ecdf: dict[str, Shares]
    running_times: dict[str, Array]
    curves: dict[str, dict[str, Curve]]

    derived = ("lead",)

    @classmethod
    def of(cls, tables: Tables, best_known: float | None = None) -> RaceStatistics:
        """Compute the figures of runs; `best_known` is the lowest loss known from elsewhere."""
        goals = targets(tables, best_known)
        return cls(
            ranks=ranks(tables),
            differences=differences(tables),
            superiorities=superiorities(dict(zip(tables, final_losses(tables), strict=True))),
            equal_cost=EqualCost.of(tables),
            targets=goals,
            ecdf={method: Shares.of(hits(runs, goals)) for method, runs in tables.items()},
            running_times={method: running_times(runs, goals) for method, runs in tables.items()},
            curves={cost: {method: curve(runs, cost) for method, runs in tables.items()} for cost in COSTS},
        )

    @property
    def lead(self) -> Lead:
        """The leader after the whole budget of episodes."""
        return Lead.of([one.method for one in self.ranks], self.superiorities)


def ranks(tables: Tables) -> list[Rank]:
    """Return each method's final result, the best mean rank first; within a seed, runs without success are last."""
    final = final_losses(tables)
    comparable, places = _placed(final), seed_ranks(final)
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
        forwards=float(np.mean([run["forwards"][-1] for run in runs])),
        seconds=float(np.mean([run["seconds"][-1] for run in runs])),
    )
