"""The pages of the league: methods against scenes, the paper's claims, and the race of each scene."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...landscapes.convert import to_json
from ...landscapes.plain import text
from ...landscapes.storage.paths import is_finished
from ...landscapes.storage.records import read_json, reading, write_record
from ...landscapes.storage.store import open_slice
from ...optim.claims import ClaimFinding, ClaimVerdict
from ...optim.league import League, SceneStandings, Standing
from ...optim.statistics import MeanRank
from ..files import LEAGUE, LEAGUE_PICTURE, LEAGUE_RECORD, REMAKE, STORE, LeagueFiles
from ..league import read_league, save_both
from ..paper import Paper
from .downloads import save_slice, save_table

LEAGUE_TABLE = "league.csv"
AT_COST = "mean rank at equal forward equivalents"
VERDICTS = {
    ClaimVerdict.HOLDS: "confirmed",
    ClaimVerdict.FAILS: "refuted",
    ClaimVerdict.UNDECIDED: "not decided",
    ClaimVerdict.NOT_RUN: "not run",
}


@dataclass(frozen=True)
class LeaguePage:
    """The contents of the page: ranks, verdicts on the paper's claims, `silences` of the paper, and the races.

    `verdicts` are the paper's claims about a scene, each with the league's finding and its name. `slices` maps a scene
    to the command that samples the slice through its best point, if it has one.
    """

    league: League
    verdicts: Sequence[tuple[str, ClaimFinding, str]]
    silences: Sequence[tuple[str, str]]
    slices: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, league: League, paper: Paper, slices: Mapping[str, str]) -> LeaguePage:
        """Compare a league with the paper."""
        found = [(scene, paper.claims_about(scene.env)) for scene in league.scenes]
        verdicts = [(scene.env, one, VERDICTS[one.verdict]) for scene, said in found for one in scene.findings(said)]
        return cls(league, verdicts, [(scene.env, said.silence) for scene, said in found if said.silence], slices)

    @property
    def counts(self) -> str:
        """The numbers of claims that are confirmed, refuted, and so on, as text."""
        found = Counter(word for _, _, word in self.verdicts)
        return ", ".join(f"{found[word]} {word}" for word in VERDICTS.values() if found[word])

    @property
    def fidelities(self) -> str:
        """The number of races at each fidelity, as text."""
        found = Counter(scene.fidelity for scene in self.league.scenes)
        return ", ".join(f"{count} at {fidelity}" for fidelity, count in sorted(found.items()))

    @property
    def first(self) -> Sequence[str]:
        """The scenes in which a method is ahead of every other after the correction, with that method."""
        return [f"{scene.env} ({scene.lead.method})" for scene in self.league.scenes if scene.lead.is_first]

    @property
    def moves(self) -> Sequence[str]:
        """The scenes in which another method has or shares the best mean rank at equal cost, with the methods."""
        return [
            f"{scene.env} ({scene.lead.method} after all episodes, {' and '.join(scene.moved_to)} at equal cost)"
            for scene in self.league.scenes
            if scene.moved_to
        ]

    @property
    def size(self) -> str:
        """The numbers of methods, seeds and episodes, from the first scene."""
        first = self.league.scenes[0]
        return f"{len(self.league.methods)} methods, {first.seeds} seeds each, {first.budget} episodes a run"

    def python(self, scenes: Sequence[SceneStandings]) -> str:
        """Return Python code that races the scenes again, all with the seeds and episodes of the first."""
        first, names = scenes[0], [f"{scene.env}@{scene.fidelity}" for scene in scenes]
        methods = list(self.league.methods if len(scenes) > 1 else first.methods)
        call = f"league = gs.league({names!r}, {methods!r}, budget={first.budget}, seeds={first.seeds})"
        return "\n".join(["import gradscape as gs", "", call, "league.plot()"])

    def claims(self, env: str) -> Sequence[tuple[ClaimFinding, str]]:
        """Return the paper's claims about a scene, each with the name of this league's finding."""
        return [(finding, word) for name, finding, word in self.verdicts if name == env]

    def describe(self) -> str:
        """Describe the map of ranks."""
        return f"Mean ranks of {len(self.league.methods)} methods in {len(self.league.scenes)} scenes; {self.best}"

    @property
    def best(self) -> str:
        """The method with the best mean rank over all scenes, as text."""
        best = self.league.overall[0]
        interval = f"95 % interval {best.low:.2f} to {best.high:.2f}"
        return f"{best.method} has the best mean rank over all scenes, {best.rank:.2f} ({interval})"

    @property
    def answer(self) -> str:
        """The answer to which optimiser gets anywhere, in two sentences."""
        many = len(self.league.scenes)
        first = f"A method is ahead of all others in {len(self.first)} of {many} scenes"
        named = f": {', '.join(self.first)}" if self.first else ""
        return f"Of {len(self.league.methods)} methods, {self.best}. {first}{named}."


def place_league(data: Path, out: Path, paper: Paper) -> LeaguePage | None:
    """Copy the league of the figures' data into the site, and return its page, or None without a league."""
    league = read_league(data)
    if league is None:
        return None
    folder = out / LEAGUE
    folder.mkdir()
    for source in (LeagueFiles.of(data, one.env) for one in league.scenes):
        for file in (source.record, source.picture, source.dark):
            shutil.copyfile(file, folder / file.name)
    write_record(folder / LEAGUE_RECORD, to_json(league))
    save_both(league.plot(), folder / LEAGUE_PICTURE)
    at_cost = {one.method: one for one in league.overall_at_equal_cost}
    ranks = [
        {"method": one.method, **_ends("mean rank", one), **_ends(AT_COST, at_cost[one.method])}
        for one in league.overall
    ]
    save_table(ranks, folder / LEAGUE_TABLE)
    for scene in league.scenes:
        save_table([_came_off(scene, one) for one in scene.standings], folder / f"{scene.env}.csv")
    slices = {one.env: place_slice(data, out, one.env) for one in league.scenes}
    return LeaguePage.of(league, paper, {env: command for env, command in slices.items() if command})


def place_slice(data: Path, out: Path, env: str) -> str | None:
    """Copy the slice through a scene's best point into the site, and return its command, or None without one."""
    source, target = (LeagueFiles.of(root, env).slice for root in (data, out))
    store = source.record.parent / STORE
    if not (source.there() and source.dark.is_file() and is_finished(store)):
        return None
    with reading(source.record, REMAKE.format("league-slices")):
        command = text(read_json(source.record)["command"])
    folder = target.record.parent
    folder.mkdir()
    for file in (source.picture, source.dark):
        shutil.copyfile(file, folder / file.name)
    save_slice(open_slice(store), store, folder)
    return command


def rank_style(rank: float, methods: int) -> str:
    """Return the style of a cell with a mean rank, in the colours of the league's picture."""
    from ...landscapes.draw.style import RANK_MAP, text_on

    colour = RANK_MAP((rank - 1) / max(methods - 1, 1))
    ground = bytes(round(255 * part) for part in colour[:3]).hex()
    return f"background: #{ground}; color: {text_on(colour)}"


def _came_off(scene: SceneStandings, one: Standing) -> Mapping[str, Any]:
    """Return a method's results in a scene: best loss, rank, and episodes to each goal."""
    times = {f"episodes to {goal:.6g}": time for goal, time in zip(scene.goals, one.times, strict=True)}
    best = {"mean best loss": one.mean, "low": one.low, "high": one.high, "unsuccessful seeds": one.unsuccessful}
    rank = {"mean rank": one.rank, "rank low": one.rank_low, "rank high": one.rank_high}
    rank |= _ends(AT_COST, scene.cost_rank(one.method))
    return {"method": one.method, **best, **rank, **times, "failed episodes": one.failed}


def _ends(name: str, one: MeanRank) -> dict[str, float]:
    return {name: one.rank, f"{name}, low": one.low, f"{name}, high": one.high}
