"""A league in a folder: races of the same methods in many scenes, one after another, each resumed by itself."""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..envs.registry import entries
from ..landscapes.cost import duration, episode_cost
from ..landscapes.space import as_whole
from ..landscapes.storage.files import is_full
from ..landscapes.storage.records import write_record
from ..optim.claims import Claims
from ..optim.league import League, SceneStandings
from ..optim.memory import require_runs, run_need
from ..optim.registry import check_methods, optimizer_class
from ..optim.registry import methods as all_methods
from ..optim.runs.store import Journal
from .folder import LEAGUE, RUN_STORE, folder_named
from .job import Job
from .plan import simulation_seconds
from .race import RaceJob, refuse_other_folder
from .scene import AT, SceneSpec
from .search import divide_methods
from .watch import PREPARING, Watch, Work

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..optim.race import Race

RECORD = LEAGUE.files[0]


@dataclass(frozen=True)
class LeagueScene:
    """A scene of a league, at a fidelity of its own, and the folder of its race."""

    scene: SceneSpec
    name: str
    fidelity: str
    folder: Path

    @classmethod
    def of(cls, scene: SceneSpec, league: Path) -> LeagueScene:
        """Return what is to be raced of a scene, without making it.

        Raises ValueError for a scene that there is not, and for a fidelity that it does not have.
        """
        name, known = _known_fidelities(scene)
        fidelity = scene.fidelity or next(iter(known), "")
        if not isinstance(fidelity, str):
            raise ValueError(f"league takes fidelities by name; got {fidelity!r} for {name}")
        if known and fidelity not in known:
            raise ValueError(
                f"{name} has fidelities {', '.join(known)}; got {fidelity!r}, so use for example {name}{AT}{known[0]}"
            )
        chosen = replace(scene, fidelity=fidelity or None)
        return cls(chosen, name, fidelity, league / "-".join([name, fidelity] if fidelity else [name]))

    def __str__(self) -> str:
        return f"{self.name}{AT}{self.fidelity}" if self.fidelity else self.name

    def count_kept(self, methods: Sequence[str], seeds: int, budget: int) -> dict[str, int]:
        """Count the episodes on disk of each method, those past the budget or of other seeds aside."""
        return {
            method: sum(min(_rows(self.folder / f"{method}-{seed}" / RUN_STORE), budget) for seed in range(seeds))
            for method in methods
        }


@dataclass(frozen=True, kw_only=True)
class LeagueJob(Job[League]):
    """A league to run: the same `methods`, `seeds` and `budget` in every one of the `scenes`.

    Methods compute in so many processes, `workers`; with an `executor` its workers search instead. `claims` are the
    paper's, by scene, to compare with the races.
    """

    results = LEAGUE
    scenes: Sequence[LeagueScene]
    methods: Sequence[str]
    budget: int
    seeds: int
    claims: Mapping[str, Claims] = field(default_factory=dict)
    workers: int = 1
    executor: Executor | None = None
    force: bool = False

    @classmethod
    def of(
        cls,
        scenes: Sequence[SceneSpec],
        methods: Sequence[str] = (),
        *,
        budget: int,
        seeds: int,
        command: str,
        out: Path | None = None,
        workers: int = 1,
        executor: Executor | None = None,
        force: bool = False,
        prints: Sequence[float] = (),
    ) -> LeagueJob:
        """Continue the league in `out`, by default a folder for its device, or begin it there.

        `methods` are by default all; those that cannot search a scene are left out there. Raises ValueError for scenes,
        fidelities and methods that there are not, a scene that is named twice, more than fits here, and where the
        folder holds something else.
        """
        budget, seeds = as_whole(budget, "a budget", least=1), as_whole(seeds, "a number of seeds", least=1)
        folder = out or league_folder(scenes)
        raced = [LeagueScene.of(scene, folder) for scene in scenes]
        names = [one.name for one in raced]
        if not raced or (twice := {name for name in names if names.count(name) > 1}):
            got = f"{', '.join(sorted(twice))} more than once" if raced else "none"
            raise ValueError(f"league takes at least one scene, and each only once; got {got}")
        refuse_other_folder(folder, LEAGUE.kind, RECORD, f"*/*-*/{RUN_STORE}")
        named = check_methods(methods) or list(all_methods())
        require_runs(1, budget, seeds, folder, abreast=len(named))  # what the smallest scene takes, before any is made
        return cls(
            scenes=raced, methods=named, budget=budget, seeds=seeds, workers=workers, executor=executor, force=force,
            folder=folder, command=command, prints=prints,
        )  # fmt: skip

    def compute(self, watch: Watch) -> League:
        """Say what is there and what is left, race in one scene after another, and return the league.

        A scene that fails, by whatever cause, is named with it and leaves the others to be raced. Raises ValueError
        where no scene could be raced.
        """
        failed, standings = dict[str, str](), list[SceneStandings]()
        self._announce(failed, watch)
        for number, scene in enumerate([one for one in self.scenes if str(one) not in failed], 1):
            began = time.monotonic()
            watch.note(f"{number} of {len(self.scenes)}: {scene}")
            with self._leaving_out(scene, failed, watch):
                race, unable = self.run_race(scene, watch)
                standings.append(SceneStandings.of(race, left_out=unable, command=self.command))
            if str(scene) not in failed:
                write_record(self.folder / RECORD, self.record(League(standings, failed, self.command)))
                watch.note(f"{scene}: {_outcome(standings[-1])}, in {duration(time.monotonic() - began)}")
        if not standings:
            reasons = "; ".join(f"{name}: {why}" for name, why in failed.items())
            raise ValueError(f"no scene of the league could be raced: {reasons}")
        return League(standings, failed, self.command)

    def work(self) -> Iterator[Work]:
        """Return the budget of every run of the methods that can search each scene."""
        for one in self.scenes:
            env = one.scene.make()
            able, _ = divide_methods(env, self.methods, budget=self.budget)
            asking = sum(optimizer_class(method).needs_grad for method in able)
            each = self.budget * self.seeds
            need = run_need(env.space.dim, self.budget).times(len(able) * self.seeds)
            yield Work(env, (len(able) - asking) * each, asking * each, need.disk, need.memory)

    def outcome(self, found: League) -> str:
        """Say in a line which scenes were left out."""
        many = f"{len(found.failed)} of {len(self.scenes)} scenes were left out"
        return f"{many}: {', '.join(found.failed)}" if found.failed else ""

    def run_race(self, scene: LeagueScene, watch: Watch) -> tuple[Race, dict[str, str]]:
        """Race in one scene, or read what is there; return the race, and why methods were left out.

        Raises ValueError where no method can search it here.
        """
        env = scene.scene.make(watch)
        able, unable = divide_methods(env, self.methods, budget=self.budget)
        if not able:
            raise ValueError(f"no method can search {scene} here: {'; '.join(unable.values())}")
        job = RaceJob.of(
            env, able, budget=self.budget, seeds=self.seeds, command=self.command, out=scene.folder,
            claims=self.claims.get(env.name), workers=self.workers, force=self.force, prints=self.prints, watch=watch,
        )  # fmt: skip
        return replace(job, executor=self.executor).run(watch), unable

    def kept(self) -> str:
        """Say how much of it is on disk."""
        kept = sum(sum(one.count_kept(self.methods, self.seeds, self.budget).values()) for one in self.scenes)
        whole = len(self.scenes) * len(self.methods) * self.seeds * self.budget
        return f"{kept} of {whole} episodes are kept in {self.folder}"

    def forecast(self, scene: LeagueScene, watch: Watch) -> float:
        """Say how many episodes of a scene are done, and return the seconds that the rest takes to simulate."""
        env = scene.scene.make(watch)
        able, unable = divide_methods(env, self.methods, budget=self.budget)
        kept = dict.fromkeys(able, 0) if self.force else scene.count_kept(able, self.seeds, self.budget)
        whole = self.budget * self.seeds
        left = {way: 0 for way in (0, 1)}
        for method in able:
            left[optimizer_class(method).needs_grad] += whole - kept[method]
        without = "".join(f"\n  {method} cannot run here: {why}" for method, why in unable.items())
        said = f"{scene} · {env.device}: {sum(kept.values())} of {whole * len(able)} episodes are done"
        if not sum(left.values()):
            watch.note(said + without)
            return 0.0
        with watch.busy(f"{scene}: {PREPARING}"):
            episode_cost(env, grad=left[1] > 0)  # compiles, which is not to count
            runs = sum(count < whole for count in kept.values()) * self.seeds
            seconds = simulation_seconds(env, left[0], left[1], runs)
        watch.note(f"{said}, the rest takes {duration(seconds)} to simulate{without}")
        return seconds

    def _announce(self, failed: dict[str, str], watch: Watch) -> None:
        """Say for each scene how many episodes are done and how long the rest takes, and the sum."""
        total = 0.0
        for scene in self.scenes:
            with self._leaving_out(scene, failed, watch):
                total += self.forecast(scene, watch)
        racers = f"{len(self.methods)} methods, {self.seeds} seeds, {self.budget} episodes each"
        watch.note(
            f"{self.folder}: {len(self.scenes) - len(failed)} of {len(self.scenes)} scenes, {racers}: "
            f"{duration(total)} of simulation left, plus the time of the methods"
        )

    @contextmanager
    def _leaving_out(self, scene: LeagueScene, failed: dict[str, str], watch: Watch) -> Iterator[None]:
        """Leave out a scene that fails within this context, unless the disk is full: name it, and keep why."""
        try:
            yield
        except Exception as error:
            if is_full(error):
                raise
            failed[str(scene)] = f"{type(error).__name__}: {' '.join(str(error).split())}"
            watch.note(f"{scene} is left out: {failed[str(scene)]}")
        finally:
            gc.collect()  # an environment may hold gigabytes of the GPU


def simulated_scenes() -> list[str]:
    """Return the names of the scenes that this package simulates itself: those with a draft and no extra."""
    return [name for name, one in entries().items() if not one.extra and "draft" in one.fidelities]


def league_folder(scenes: Sequence[SceneSpec]) -> Path:
    """Return the folder of all leagues on a device, whatever their scenes, methods, seeds and budget."""
    how = sorted({(one.device, one.deterministic) for one in scenes})
    return folder_named([LEAGUE.kind, *dict.fromkeys(device for device, _ in how)], how)


def _known_fidelities(scene: SceneSpec) -> tuple[str, tuple[str, ...]]:
    """Return a scene's name and those of its fidelities, without importing it where it is registered."""
    entry = entries().get(scene.name) if isinstance(scene.name, str) else None
    if entry and (entry.fidelities or entry.extra):
        return entry.name, entry.fidelities
    kind = scene.kind
    return kind.name, tuple(kind.fidelities)


def _rows(path: Path) -> int:
    """Count the episodes of a run, 0 where there is none or it is damaged, which the race says."""
    try:
        return Journal.read(path).rows
    except (OSError, ValueError):
        return 0


def _outcome(found: SceneStandings) -> str:
    best, first = found.best, found.lead.describe()
    if best is None:
        return f"{first}; no episode succeeded"
    return f"{first}; best loss {best.loss:.6g} by {best.method}, seed {best.seed}, episode {best.episode}"
