"""What a race's runs say: ranks, who beats whom, best loss against cost, targets reached, and what that took.

Everything is over the seeds of a method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from .bootstrap import Array, interval
from .comparison import Difference, Superiority, differences, superiorities
from .curves import COSTS, Curve, Tables, curve, final_losses
from .targets import Shares, Targets, hits, running_times, targets


@dataclass(frozen=True)
class Rank:
    """How a method came off in the end: ranks are 1 for the best, ties share theirs; NaN where there is none.

    `wins` counts the seeds in which no method was better; `unsuccessful` those without one successful episode; `failed`
    the episodes that failed; `forwards` (forward equivalents) and
    `seconds` are the mean cost of a run.
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
    """All figures of a race: ranks, the best first, how every two methods compare, targets, and by method curves.

    `ecdf` is the share of pairs of target and seed reached, `running_times` the expected running time for each target
    [episodes], `curves` the mean best loss against each of `COSTS`.
    """

    ranks: list[Rank]
    differences: list[Difference]
    superiorities: list[Superiority]
    targets: Targets
    ecdf: dict[str, Shares]
    running_times: dict[str, Array]
    curves: dict[str, dict[str, Curve]]

    @classmethod
    def of(cls, tables: Tables, best_known: float | None = None) -> RaceStatistics:
        """Compute the figures of runs; `best_known` is the least loss that is known from elsewhere."""
        goals = targets(tables, best_known)
        return cls(
            ranks=ranks(tables),
            differences=differences(tables),
            superiorities=superiorities(tables),
            targets=goals,
            ecdf={method: Shares.of(hits(runs, goals)) for method, runs in tables.items()},
            running_times={method: running_times(runs, goals) for method, runs in tables.items()},
            curves={cost: {method: curve(runs, cost) for method, runs in tables.items()} for cost in COSTS},
        )


def ranks(tables: Tables) -> list[Rank]:
    """Return how every method came off, the best mean rank first; within a seed, runs without success are last."""
    from scipy.stats import rankdata

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
        forwards=float(np.mean([run["forwards"][-1] for run in runs])),
        seconds=float(np.mean([run["seconds"][-1] for run in runs])),
    )
