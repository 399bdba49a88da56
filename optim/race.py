"""Let methods compete: the same budget of episodes for each of them, with each of several seeds."""

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
    """One method with one seed, and the run it fills; `make` returns the optimiser as it is at the start."""

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
    """Let every competitor search until its run holds `budget` episodes; runs that do already are not touched.

    Runs advance in lockstep: all propose, what they propose is evaluated in one batch, and all are told. So a simulator
    that is quicker at many points at once is used well, and what comes out is what each run gives alone but for the
    seconds, given an objective whose rows do not depend on their batch. `MAX_ABREAST` runs advance at a time. Methods
    compute in so many processes, `workers`. `gradient_cost`, what an episode with gradient costs in episodes without,
    is measured if a run needs it. Stop it at any instant: the same call continues.
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
    """Hold the runs of a race, method -> one run per seed, of which the first `budget` episodes count.

    `folder` is where its files are, None of one in memory; `provenance` is how it came about, by default as its first
    run did. `best_known` is the least loss that is known from elsewhere, down to which its targets go.
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
        """How many seeds each of them has."""
        return len(self.runs[self.methods[0]])

    @property
    def loss_unit(self) -> str:
        """The unit of the losses, empty where they have none."""
        return str(self._about["loss_unit"])

    @property
    def identity(self) -> dict[str, Any]:
        """What decides the numbers of its first run, as plain JSON."""
        return self.runs[self.methods[0]][0].identity

    @cached_property
    def statistics(self) -> RaceStatistics:
        """Ranks, comparisons of every two methods, targets reached and curves, with intervals over the seeds."""
        return RaceStatistics.of(self._tables, self.best_known)

    def table(self) -> pd.DataFrame:
        """Return a row for each method, the best mean rank first, with 95 % intervals; columns name their units."""
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
        """Return a row for every two methods: the difference of their mean best losses, and who wins how often.

        The probability is that the first has the lesser best loss, a tie half; p is that of Mann and Whitney's rank
        test, corrected for all pairs by Holm's rule beside it; `better` is by that.
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

        The picture is matplotlib's figure, shown by a notebook as it is; `width` draws it for a page so wide [mm].
        """
        from ..landscapes.draw.figures.search import race_figure

        return race_figure(self._picture, width=width)

    @cached_property
    def _tables(self) -> dict[str, list[xr.Dataset]]:
        """The first `budget` rows of every run but for its points and gradients."""
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
        """Return in a line what competed and what came out best."""
        best = self.statistics.ranks[0].method
        where = f", in {self.folder}" if self.folder else ""
        return (
            f"<Race of {', '.join(self.methods)} on {self._about['env']}: {self.budget} episodes, "
            f"{name_seeds(self.seeds)}, {best} has the best mean rank{where}>"
        )


def picture(tables: Tables, figures: RaceStatistics) -> xr.Dataset:
    """Return what `race_figure` draws of a race, its attributes aside."""
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
