"""A league: races of the same methods in several scenes, with a row for each scene and method."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from ..landscapes.identity import current_identity
from ..landscapes.plain import finite
from .claims import ClaimFinding, Claims, check_claims
from .statistics import EqualCost, Lead, MeanRank, Superiority, interval, not_told_from, seen_from, times_record

RANDOM = "random"  # the method that another has to be told from to be of use
OF_METHOD = ("method", "method_options", "method_version", "seed")  # of a run's identity, what is not of its scene

if TYPE_CHECKING:
    import pandas as pd

    from ..landscapes.draw.figures.page import Picture
    from .race import Race
    from .statistics import Rank


@dataclass(frozen=True)
class BestPoint:
    """The point of least loss in a scene: its parameters `x`, each in its own unit, and the episode that found it."""

    loss: float
    method: str
    seed: int
    episode: int
    x: tuple[float, ...]

    @classmethod
    def of(cls, race: Race) -> BestPoint | None:
        """Return the best point of a race, None where no episode succeeded."""
        found = list[BestPoint]()
        for run in chain.from_iterable(race.runs.values()):
            loss = run.data["loss"].to_numpy()[: race.budget]
            if np.isfinite(loss).any():
                row = int(np.nanargmin(loss))
                x = tuple(map(float, run.data["x"].to_numpy()[row]))
                found.append(cls(float(loss[row]), run.method, run.seed, row + 1, x))
        return min(found, key=lambda one: one.loss, default=None)


@dataclass(frozen=True)
class Standing:
    """A method's result in a scene: mean rank and mean best loss with their intervals over seeds.

    `unsuccessful` counts the seeds without a successful episode, `failed` the failed episodes. `times` are the expected
    running times for the scene's `goals` [episodes], None where no run reached one.
    """

    method: str
    rank: float
    rank_low: float
    rank_high: float
    mean: float
    low: float
    high: float
    unsuccessful: int
    failed: int
    times: tuple[float | None, ...]

    @classmethod
    def of(cls, rank: Rank, times: Sequence[float | None]) -> Standing:
        """Return the result of a method in a race, from its rank and its running times."""
        kept = {name: getattr(rank, name) for name in cls.__dataclass_fields__ if name != "times"}
        return cls(**kept, times=tuple(times))


@dataclass(frozen=True)
class SceneStandings:
    """The result of a race in one scene: `standings`, the best mean rank first, and comparisons of all `pairs`.

    Both are at equal episodes; `equal_cost` has ranks and pairs at equal forward equivalents. `identity` decides the
    numbers: scene, its version, options, fidelity, device, engine. `goals` are some of the race's targets, the hardest
    first. `best` is the best point of all runs. `left_out` gives the reason for each method that did not run.
    """

    env: str
    fidelity: str
    device: str
    loss_unit: str
    identity: Mapping[str, Any]
    budget: int
    seeds: int
    goals: tuple[float, ...]
    standings: tuple[Standing, ...]
    pairs: tuple[Superiority, ...]
    equal_cost: EqualCost
    best: BestPoint | None
    left_out: Mapping[str, str]
    command: str

    derived = ("lead",)

    def __post_init__(self) -> None:
        object.__setattr__(self, "identity", current_identity(self.identity))

    @classmethod
    def of(cls, race: Race, *, left_out: Mapping[str, str] | None = None, command: str = "") -> SceneStandings:
        """Return the result of a race."""
        identity = {name: value for name, value in race.identity.items() if name not in OF_METHOD}
        figures, some = race.statistics, race.statistics.targets.some
        times = {method: times_record(one[some]) for method, one in figures.running_times.items()}
        return cls(
            env=str(identity["objective"]),
            fidelity=str(identity["fidelity"]),
            device=str(identity["device"]),
            loss_unit=race.loss_unit,
            identity=identity,
            budget=race.budget,
            seeds=race.seeds,
            goals=tuple(map(float, figures.targets.loss[some])),
            standings=tuple(Standing.of(rank, times[rank.method]) for rank in figures.ranks),
            pairs=tuple(figures.superiorities),
            equal_cost=figures.equal_cost,
            best=BestPoint.of(race),
            left_out=dict(left_out or {}),
            command=command,
        )

    @property
    def methods(self) -> list[str]:
        """The methods that raced, the best mean rank first."""
        return [one.method for one in self.standings]

    @property
    def ranks(self) -> tuple[MeanRank, ...]:
        """The mean ranks after the whole budget of episodes, the best first."""
        return tuple(MeanRank(one.method, one.rank, one.rank_low, one.rank_high) for one in self.standings)

    @property
    def lead(self) -> Lead:
        """The leader after the whole budget of episodes."""
        return Lead.of(self.methods, self.pairs)

    @property
    def moved_to(self) -> tuple[str, ...]:
        """The methods with the best mean rank at equal forward equivalents; none if it is the same method."""
        best = self.equal_cost.ranks[0].rank
        found = tuple(one.method for one in self.equal_cost.ranks if one.rank == best)
        return () if found == (self.lead.method,) else found

    @property
    def not_told_from_random(self) -> tuple[str, ...]:
        """The methods that are not distinguishable from random search after the whole budget of episodes."""
        return not_told_from(RANDOM, self.methods, self.pairs)

    def cost_rank(self, method: str) -> MeanRank:
        """Return the mean rank of a method at equal forward equivalents."""
        return next(one for one in self.equal_cost.ranks if one.method == method)

    def describe_lead(self) -> str:
        """Name the leader in a sentence, at equal episodes and at equal cost."""
        at_cost = f"within {self.equal_cost.forwards:.0f} forward equivalents {self.equal_cost.lead.describe()}"
        return f"after {self.budget} episodes {self.lead.describe()}; {at_cost}"

    def findings(self, claims: Claims) -> list[ClaimFinding]:
        """Return the verdicts of the race on claims about its scene."""
        return check_claims(claims.claims, (), self.pairs)

    def probabilities(self, method: str) -> dict[str, float]:
        """Return the probability that a method ends with a lower loss than each of the others."""
        return {one.second: one.probability for one in seen_from(method, self.pairs)}

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The results of each method, one row each."""
        about = {name: getattr(self, name) for name in ("env", "fidelity", "device", "loss_unit", "budget", "seeds")}
        return [
            {
                **about,
                **{name: value for name, value in asdict(one).items() if name != "times"},
                **self._cost_columns(one.method),
                "probability": {other: finite(p) for other, p in self.probabilities(one.method).items()},
                "running_times": dict(zip(map("{:.6g}".format, self.goals), one.times, strict=True)),
                "best_known": self.best.loss if self.best else None,
            }
            for one in self.standings
        ]

    def _cost_columns(self, method: str) -> dict[str, float | bool]:
        one = self.cost_rank(method)
        return {
            "first": self.lead.is_first and self.lead.method == method,
            "equal_forwards": self.equal_cost.forwards,
            "equal_forwards_rank": one.rank,
            "equal_forwards_rank_low": one.low,
            "equal_forwards_rank_high": one.high,
        }


@dataclass(frozen=True)
class OverallRank(MeanRank):
    """The mean of a method's mean ranks over its `scenes`, with an interval by resampling the scenes."""

    scenes: int


@dataclass(frozen=True, eq=False)
class League:
    """The results of races by scene; `failed` gives the reason for each missing race, `command` makes the league."""

    scenes: Sequence[SceneStandings]
    failed: Mapping[str, str]
    command: str

    derived = ("rows", "overall", "overall_at_equal_cost")

    @property
    def rows(self) -> list[dict[str, Any]]:
        """A row for each scene and method."""
        return [row for scene in self.scenes for row in scene.rows]

    @cached_property
    def overall(self) -> list[OverallRank]:
        """The methods over all scenes after the whole budget of episodes, the best mean rank first."""
        return _overall(chain.from_iterable(scene.standings for scene in self.scenes))

    @cached_property
    def overall_at_equal_cost(self) -> list[OverallRank]:
        """The methods over all scenes at equal forward equivalents, the best mean rank first."""
        return _overall(chain.from_iterable(scene.equal_cost.ranks for scene in self.scenes))

    @property
    def methods(self) -> list[str]:
        """The methods that raced anywhere, the best over all scenes first."""
        return [one.method for one in self.overall]

    def table(self) -> pd.DataFrame:
        """Return a row for each scene and method: mean rank, mean best loss and their intervals, running times."""
        import pandas as pd

        return pd.DataFrame(self.rows)

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())

    def plot(self, *, width: float | None = None) -> Picture:
        """Draw the mean ranks of methods in scenes as a map; `width` is that of a page for print [mm].

        Raises ValueError where there is no race to draw.
        """
        if not self.scenes:
            raise ValueError("no race of the league was run, so there is nothing to draw")
        from ..landscapes.draw.figures.search import league_figure

        return league_figure(self._picture(), width=width)

    def _picture(self) -> xr.Dataset:
        """Return the input of `league_figure`: ranks by scene and method, all scenes together last."""
        ranks = {(scene.env, scene.fidelity): {one.method: one for one in scene.standings} for scene in self.scenes}
        rows = [[standings.get(method) for method in self.methods] for standings in ranks.values()]
        parts = {
            name: [
                *([getattr(one, name) if one else np.nan for one in row] for row in rows),
                [getattr(one, name.removeprefix("rank_")) for one in self.overall],
            ]
            for name in ("rank", "rank_low", "rank_high")
        }
        first = [[scene.lead.is_first and scene.lead.method == name for name in self.methods] for scene in self.scenes]
        fidelities = {scene.fidelity for scene in self.scenes}
        names = [scene.env if len(fidelities) == 1 else f"{scene.env} ({scene.fidelity})" for scene in self.scenes]
        seeds, budget = (_range(getattr(scene, name) for scene in self.scenes) for name in ("seeds", "budget"))
        said = [f"League of {len(self.methods)} methods", *(fidelities if len(fidelities) == 1 else ())]
        return xr.Dataset(
            {name: (("scene", "method"), np.array(values, float)) for name, values in parts.items()}
            | {"first": (("scene", "method"), np.array([*first, [False] * len(self.methods)]))},
            {"scene": [*names, "all scenes"], "method": self.methods},
            {
                "title": " · ".join([*said, f"{budget} episodes", f"{seeds} seeds" if seeds != "1" else "1 seed"]),
                "seeds": seeds,
                "command": self.command,
            },
        )


def _overall(ranks: Iterable[Standing | MeanRank]) -> list[OverallRank]:
    """Return the means over scenes of the ranks of methods, the best first."""
    by: dict[str, list[float]] = {}
    for one in ranks:
        by.setdefault(one.method, []).append(one.rank)
    found = list[OverallRank]()
    for method, values in by.items():
        low, high = map(float, interval(np.array(values)))
        found.append(OverallRank(method, float(np.mean(values)), low, high, len(values)))
    return sorted(found, key=lambda one: (one.rank, one.method))


def _range(values: Any) -> str:
    """Return a number, or the smallest and the largest where they differ."""
    found = sorted(set(values))
    return str(found[0]) if len(found) == 1 else f"{found[0]} to {found[-1]}"
