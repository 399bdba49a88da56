"""The best loss of a method against what it had cost, over its seeds.

A failed episode costs what any other does and improves nothing. Before its first success a run has no best loss (NaN),
so the mean over seeds begins where the last of them has had a success.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from .bootstrap import Array, interval

COSTS = ("episodes", "forwards", "seconds")

Tables = Mapping[str, Sequence[xr.Dataset]]  # method -> one run's table per seed, all of the same length


@dataclass(frozen=True, eq=False)
class Curve:
    """The mean of the best loss over seeds as a step function of a cost: `mean[i]` from `cost[i]` on."""

    cost: Array
    mean: Array
    low: Array
    high: Array


def best_so_far(loss: Array) -> Array:
    """Return the least loss up to each episode, NaN before the first success."""
    return np.fmin.accumulate(loss)


def final_losses(tables: Tables) -> Array:
    """Return the best loss of every run, shape (method, seed), NaN where no episode succeeded."""
    return np.array([[best_so_far(run["loss"].to_numpy())[-1] for run in runs] for runs in tables.values()])


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


def _first(spent: Array, best: Array) -> float:
    """Return what the first success had cost, infinity without one."""
    successes = np.flatnonzero(np.isfinite(best))
    return float(spent[successes[0]]) if len(successes) else np.inf
