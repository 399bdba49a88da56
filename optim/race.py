"""Let methods compete: the same budget of episodes for each of them, with each of several seeds."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import xarray as xr

from ..landscapes.objective import Objective
from . import standings
from .base import Optimizer
from .orderings import Claim, findings
from .run import Run
from .search import Progress, search


@dataclass(frozen=True, eq=False)
class Entry:
    """One method with one seed, and the run it fills; `made` returns the optimiser as it is at the start."""

    method: str
    seed: int
    run: Run
    made: Callable[[], Optimizer]


class RaceStopped(Exception):  # noqa: N818 -- no error: it ends the other runs
    """End a run between two proposals, because the race is stopped."""


def race(
    objective: Objective,
    entries: Sequence[Entry],
    *,
    budget: int,
    workers: int = 1,
    gradient_cost: float | None = None,
    progress: Callable[[Entry, Progress], None] | None = None,
) -> None:
    """Let every entry search until its run holds `budget` episodes; runs that do already are not touched.

    `workers` runs are filled at a time, each in a thread, in the order given; what comes out does not depend on it but
    for the seconds. More than one needs an objective that several threads may evaluate at once. `gradient_cost`, what
    an episode with gradient costs in episodes without, is measured by the first run that needs it if not given.
    `progress` may be called from any of the threads. Stop it at any instant: the same call goes on.
    """
    left = [entry for entry in entries if entry.run.count < budget]
    stop = threading.Event()

    def fill(entry: Entry) -> None:
        def follow(now: Progress) -> None:
            if progress is not None:
                progress(entry, now)
            if stop.is_set():
                raise RaceStopped

        if not stop.is_set():
            search(objective, entry.made(), entry.run, budget=budget, gradient_cost=gradient_cost, progress=follow)

    if workers == 1:
        for entry in left:
            fill(entry)
        return
    with ThreadPoolExecutor(workers) as threads:
        futures = [threads.submit(fill, entry) for entry in left]
        try:
            for future in as_completed(futures):
                future.result()
        except BaseException:  # an interrupt too
            stop.set()
            threads.shutdown(cancel_futures=True)
            raise


def tables(entries: Sequence[Entry], budget: int) -> dict[str, list[xr.Dataset]]:
    """Return the first `budget` rows of every run but for its points and gradients, method -> one table per seed."""
    found: dict[str, list[xr.Dataset]] = {}
    for entry in entries:
        table = entry.run.table().drop_vars(["x", "grad"]).isel(evaluation=slice(budget))
        found.setdefault(entry.method, []).append(table)
    return found


def picture(runs: standings.Tables, goals: standings.Targets) -> xr.Dataset:
    """Return what `landscapes.draw.race` draws of a race, its attributes aside."""
    curves = [standings.curve(tables, "episodes") for tables in runs.values()]
    steps = max(len(curve.cost) for curve in curves)
    padded = {
        key: [np.pad(getattr(curve, name), (0, steps - len(curve.cost)), constant_values=np.nan) for curve in curves]
        for key, name in (("episodes", "cost"), ("mean", "mean"), ("low", "low"), ("high", "high"))
    }
    hits = [standings.hits(tables, goals).ravel() for tables in runs.values()]
    missing = [int(np.isnan(losses).sum()) for losses in standings.final_losses(runs)]
    return xr.Dataset(
        {
            **{key: (("method", "step"), np.stack(values)) for key, values in padded.items()},
            "hit": (("method", "pair"), np.stack(hits)),
            "unsuccessful": ("method", missing),
        },
        {"method": list(runs)},
    )


def judged(
    runs: standings.Tables, goals: standings.Targets, claims: Sequence[Claim] = (), silence: str | None = None
) -> dict[str, Any]:
    """Return all figures of a race, what becomes of claims about its environment included.

    `silence` says why there are none.
    """
    differences = standings.differences(runs)
    found = findings(claims, differences)
    return {
        "ranks": [asdict(rank) for rank in standings.ranks(runs)],
        "differences": [asdict(one) | {"better": one.better} for one in differences],
        "claims": [
            asdict(one.claim) | {"claim": str(one.claim), "verdict": one.verdict, "difference": _record(one.difference)}
            for one in found
        ],
        "silence": None if found else silence,
        "targets": {"loss": goals.loss.tolist(), "spacing": goals.spacing, "easiest": goals.easiest},
        "ecdf": {method: _shares(standings.hits(tables, goals)) for method, tables in runs.items()},
        "curves": {
            cost: {
                method: {key: values.tolist() for key, values in vars(standings.curve(tables, cost)).items()}
                for method, tables in runs.items()
            }
            for cost in standings.COSTS
        },
    }


def _record(difference: standings.Difference | None) -> dict[str, Any] | None:
    return None if difference is None else asdict(difference)


def _shares(hits: standings.Array) -> dict[str, list[float]]:
    """Return the ECDF as the episodes at which it steps and its values from there on."""
    reached = np.sort(hits[np.isfinite(hits)])
    return {"episodes": reached.tolist(), "share": (np.arange(1, len(reached) + 1) / hits.size).tolist()}
