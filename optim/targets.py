"""Losses to reach, as COCO sets them, and what it took to reach them.

Targets are 51 losses between the best that is known and the median of random points, spaced by their logarithms, as
COCO spaces 51 precisions between 10^-8 and 10^2 (Hansen et al. 2021, section 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from ..landscapes.plain import finite
from .base import Kind
from .bootstrap import Array
from .curves import Tables, best_so_far

TARGETS = 51
EVERY = 10  # of them, where some stand for all
HARDEST = 1e-8  # at least, against the easiest: what COCO's hardest precision is to 1


@dataclass(frozen=True, eq=False)
class Targets:
    """Losses to reach, the hardest first; `easiest` says what the last one is, `spacing` is log or linear.

    `best_known` is the least loss that is known, of the race or from elsewhere, NaN where no episode succeeded.
    """

    loss: Array
    spacing: str
    easiest: str
    best_known: float = np.nan

    @property
    def some(self) -> list[int]:
        """The numbers of those that are shown where there is no room for all: every tenth, both ends among them."""
        return list(range(0, len(self.loss), EVERY))


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


def targets(tables: Tables, best_known: float | None = None) -> Targets:
    """Return 51 losses from the best that is known to the median of random points, spaced by their logarithms.

    The best known is the least of the race, or `best_known` where that is less. Without the method `random` the easiest
    is the median of the first loss of each run. The hardest is the best known, or 10^-8 of the easiest where the best
    known is less than that and not negative. Where a loss is negative or the easiest zero, there are no logarithms,
    and they are spaced evenly. There is none where every episode failed.
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
    """Return the episodes after which each target was first reached, shape (seed, target), NaN where it never was."""
    found = np.full((len(runs), len(goals.loss)), np.nan)
    for row, run in zip(found, runs, strict=True):
        best, episodes = best_so_far(run["loss"].to_numpy()), run["episodes"].to_numpy()
        reached = best[:, None] <= goals.loss
        where = reached.any(axis=0)
        row[where] = episodes[reached.argmax(axis=0)[where]]
    return found


def running_times(runs: Sequence[xr.Dataset], goals: Targets) -> Array:
    """Return a method's expected running time (ERT) for each target [episodes], infinite where no run reached it.

    ERT is what all runs spent before they reached the target, or in vain, for each run that reached it: what restarts
    would spend until the first success (Hansen et al. 2021, section 4).
    """
    reached = hits(runs, goals)
    spent = np.array([[float(run["episodes"][-1])] for run in runs])
    total = np.where(np.isfinite(reached), reached, spent).sum(axis=0)
    successes = np.isfinite(reached).sum(axis=0)
    times: Array = np.divide(total, successes, out=np.full(len(goals.loss), np.inf), where=successes > 0)
    return times


def times_record(times: Array) -> list[float | None]:
    """Return running times as JSON has them, to six digits; None for what was never reached."""
    return [finite(float(f"{one:.6g}")) for one in times]


def _easiest(tables: Tables) -> tuple[float, str]:
    random = [run["loss"].to_numpy()[run["kind"].to_numpy() == Kind.RANDOM] for run in tables.get("random", ())]
    drawn = np.concatenate(random) if random else np.empty(0)
    if np.isfinite(drawn).any():
        return float(np.nanmedian(drawn)), "median loss of the random points"
    firsts = [run["loss"].to_numpy() for runs in tables.values() for run in runs]
    begun = [loss[np.isfinite(loss)][0] for loss in firsts if np.isfinite(loss).any()]
    return float(np.median(begun)), "median of the first loss of each run"
