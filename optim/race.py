"""Compare methods: the same budget of episodes for each of them, with several seeds."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from ..landscapes.cost import episode_cost
from ..landscapes.objective import Objective
from .base import Optimizer
from .lockstep import Lockstep
from .runs.run import Run
from .runs.store import RunStore
from .search import SearchProgress, fill
from .statistics import RaceStatistics, Tables, final_losses, hits

if TYPE_CHECKING:
    import pandas as pd

    from ..landscapes.draw.figures.page import Picture


NOT_DISTINGUISHABLE = "not distinguishable"  # two methods, after the correction for all pairs of a race
MAX_ABREAST = 200  # runs that advance in lockstep: the folder of each is open


@dataclass(frozen=True, eq=False)
class Competitor:
    """One method with one seed, and the run it fills; `make` returns the new optimiser."""

    method: str
    seed: int
    run: RunStore
    make: Callable[[], Optimizer]


def race(
    objective: Objective,
    competitors: Sequence[Competitor],
    *,
    budget: int,
    gradient_cost: float | None = None,
    workers: int = 1,
    progress: Callable[[Competitor, SearchProgress], None] | None = None,
) -> None:
    """Let every competitor search until its run has `budget` episodes; complete runs are not touched.

    Runs advance in lockstep: all propose, one batch evaluates all proposals, and all are told. That suits simulators
    that are faster on large batches. Except for the seconds, each run is the one it would be alone, if rows of the
    objective do not depend on their batch. At most `MAX_ABREAST` runs advance at the same time. Methods compute in
    `workers` processes. `gradient_cost`, the cost of an episode with gradient in episodes without, is measured if a run
    needs it. You can stop it at any moment: the same call continues.
    """
    left = [one for one in competitors if one.run.count < budget]
    for start in range(0, len(left), MAX_ABREAST):
        _run_abreast(objective, left[start : start + MAX_ABREAST], budget, gradient_cost, workers, progress)


def _run_abreast(
    objective: Objective,
    left: Sequence[Competitor],
    budget: int,
    gradient_cost: float | None,
    workers: int,
    progress: Callable[[Competitor, SearchProgress], None] | None,
) -> None:
    optimizers = [one.make() for one in left]
    objective.prepare()
    pairs = list(zip(optimizers, left, strict=True))
    if gradient_cost is None and any(made.needs_grad and one.run.gradient_cost is None for made, one in pairs):
        gradient_cost = episode_cost(objective).ratio
    searches = []
    with ExitStack() as locks:
        for made, one in pairs:
            locks.enter_context(one.run.lock())
            one.run.abreast = len(left)
            follow = None if progress is None else partial(progress, one)
            filling = fill(objective, made, one.run, budget=budget, gradient_cost=gradient_cost, progress=follow)
            searches.append(filling)
        Lockstep(objective, workers=workers).run(searches)


@dataclass(frozen=True, eq=False, repr=False)
class Race:
    """The runs of a race, method -> one run per seed, truncated to `budget` episodes.

    `folder` contains its files, None for one in memory. `provenance` records how it was made, by default that of its
    first run. `best_known` is the lowest loss known from elsewhere, which the targets extend to.
    """

    runs: Mapping[str, Sequence[Run]]
    budget: int
    folder: Path | None = None
    provenance: Mapping[str, Any] | None = None
    best_known: float | None = None

    @property
    def methods(self) -> list[str]:
        """The methods that compete."""
        return list(self.runs)

    @property
    def seeds(self) -> int:
        """The number of seeds of each method."""
        return len(self.runs[self.methods[0]])

    @property
    def loss_unit(self) -> str:
        """The unit of the losses, empty where they have none."""
        return str(self._about["loss_unit"])

    @property
    def identity(self) -> dict[str, Any]:
        """The settings that decide the numbers of its first run, as plain JSON."""
        return self.runs[self.methods[0]][0].identity

    @cached_property
    def statistics(self) -> RaceStatistics:
        """Ranks, comparisons of all pairs of methods, targets reached and curves, with intervals over the seeds."""
        return RaceStatistics.of(self._tables, self.best_known)

    def table(self) -> pd.DataFrame:
        """Return a row for each method, the best mean rank first, with 95 % intervals; column names contain units."""
        import pandas as pd

        unit = f" [{self.loss_unit}]" if self.loss_unit else ""
        at_cost = {one.method: one for one in self.statistics.equal_cost.ranks}
        rows = [
            {
                "method": rank.method,
                "mean rank": rank.rank,
                "mean rank, low": rank.rank_low,
                "mean rank, high": rank.rank_high,
                "mean rank at equal forward equivalents": at_cost[rank.method].rank,
                "mean rank at equal forward equivalents, low": at_cost[rank.method].low,
                "mean rank at equal forward equivalents, high": at_cost[rank.method].high,
                "wins": rank.wins,
                f"best loss{unit}": rank.mean,
                f"best loss, low{unit}": rank.low,
                f"best loss, high{unit}": rank.high,
                "seeds without success": rank.unsuccessful,
                "failed episodes": rank.failed,
                "forward equivalents": rank.forwards,
                "seconds [s]": rank.seconds,
            }
            for rank in self.statistics.ranks
        ]
        return pd.DataFrame(rows)

    def pairs(self) -> pd.DataFrame:
        """Return a row for every pair of methods: the difference of their mean best losses, and how often each wins.

        The probability is that the first has the lower best loss, a tie counting half. p is from Mann and Whitney's
        rank test; the next column has it corrected for all pairs by Holm's rule, and decides `better`.
        """
        import pandas as pd

        unit, figures = f" [{self.loss_unit}]" if self.loss_unit else "", self.statistics
        rows = [
            {
                "first": one.first,
                "second": one.second,
                f"difference{unit}": one.mean,
                f"difference, low{unit}": one.low,
                f"difference, high{unit}": one.high,
                "probability": chance.probability,
                "p": chance.p,
                "corrected p": chance.corrected,
                "better": chance.better or NOT_DISTINGUISHABLE,
            }
            for one, chance in zip(figures.differences, figures.superiorities, strict=True)
        ]
        return pd.DataFrame(rows)

    def running_times(self) -> pd.DataFrame:
        """Return the expected running time of every method [episodes], a column for each, a row for each target loss.

        It is infinite where no run reached the target.
        """
        import pandas as pd

        figures = self.statistics
        index = pd.Index(figures.targets.loss, name=f"loss [{self.loss_unit}]" if self.loss_unit else "loss")
        return pd.DataFrame(figures.running_times, index=index)

    def plot(self, *, width: float | None = None) -> Picture:
        """Draw best losses against episodes, and the share of targets reached.

        It returns a matplotlib figure, which notebooks show. `width` draws it for a page of this width [mm].
        """
        from ..landscapes.draw.figures.search import race_figure

        return race_figure(self._picture, width=width)

    @cached_property
    def _tables(self) -> dict[str, list[xr.Dataset]]:
        """The first `budget` rows of every run, without points and gradients."""
        return {
            method: [run.data.drop_vars(["x", "grad"]).isel(evaluation=slice(self.budget)) for run in runs]
            for method, runs in self.runs.items()
        }

    @property
    def _about(self) -> Mapping[str, Any]:
        return self.runs[self.methods[0]][0].data.attrs

    @cached_property
    def _picture(self) -> xr.Dataset:
        about, goals = self._about, self.statistics.targets
        title = (about["env"], about["fidelity"], f"{self.budget} episodes", name_seeds(self.seeds))
        provenance = about["provenance"] if self.provenance is None else json.dumps(self.provenance)
        return picture(self._tables, self.statistics).assign_attrs(
            title=" · ".join(part for part in title if part),
            budget=self.budget,
            seeds=self.seeds,
            loss_unit=self.loss_unit,
            spacing=goals.spacing,
            lead=self.statistics.lead.summarise(),
            targets=(len(goals.loss), *(goals.loss[[0, -1]] if len(goals.loss) else (math.nan, math.nan))),
            identity=about["identity"],
            provenance=provenance,
        )

    def __repr__(self) -> str:
        """Return the competitors and the best one in a line."""
        best = self.statistics.ranks[0].method
        where = f", in {self.folder}" if self.folder else ""
        return (
            f"<Race of {', '.join(self.methods)} on {self._about['env']}: {self.budget} episodes, "
            f"{name_seeds(self.seeds)}, {best} has the best mean rank{where}>"
        )


def picture(tables: Tables, figures: RaceStatistics) -> xr.Dataset:
    """Return the input of `race_figure` for a race, without its attributes."""
    curves = list(figures.curves["episodes"].values())
    steps = max(len(curve.cost) for curve in curves)
    padded = {
        key: [np.pad(getattr(curve, name), (0, steps - len(curve.cost)), constant_values=np.nan) for curve in curves]
        for key, name in (("episodes", "cost"), ("mean", "mean"), ("low", "low"), ("high", "high"))
    }
    reached = [hits(runs, figures.targets).ravel() for runs in tables.values()]
    missing = [int(np.isnan(losses).sum()) for losses in final_losses(tables)]
    return xr.Dataset(
        {
            **{key: (("method", "step"), np.stack(values)) for key, values in padded.items()},
            "hit": (("method", "pair"), np.stack(reached)),
            "unsuccessful": ("method", missing),
        },
        {"method": list(tables)},
    )


def name_seeds(count: int) -> str:
    """Return a number of seeds in words."""
    return f"{count} seed{'s' if count > 1 else ''}"
