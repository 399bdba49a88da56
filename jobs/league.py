"""A league in a folder: races of the same methods in many scenes, one after another, each resumed by itself."""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..envs.registry import entries
from ..landscapes.convert import to_json
from ..landscapes.cost import duration, episode_cost
from ..landscapes.space import as_whole
from ..landscapes.storage.files import full, is_full, refuse_others, tidy, visible_files
from ..landscapes.storage.records import write_record
from ..optim.claims import Claims
from ..optim.league import League, SceneStandings
from ..optim.memory import require_runs, run_need
from ..optim.registry import methods as all_methods
from ..optim.registry import optimizer_class
from ..optim.runs.journal import Journal
from .folder import LEAGUE, ROOT, RUN_STORE, folder_named
from .methods import check_methods, divide_methods
from .race import RaceJob, lockstep_seconds
from .scene import AT, SceneSpec
from .watch import PREPARING, Stopped, Watch, Work, resumable

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..optim.race import Race

RECORD, PICTURE = LEAGUE.files


@dataclass(frozen=True)
class Fixture:
    """A scene of a league, at a fidelity of its own, and the folder of its race."""

    scene: SceneSpec
    name: str
    fidelity: str
    folder: Path

    @classmethod
    def of(cls, scene: SceneSpec, league: Path) -> Fixture:
        """Return what is to be raced of a scene, without making it.

        Raises ValueError for a scene that there is not, and for a fidelity that it does not have.
        """
        name, known = _known_fidelities(scene)
        fidelity = scene.fidelity or next(iter(known), "")
        if not isinstance(fidelity, str):
            raise ValueError(f"a league takes fidelities by their names; got {fidelity!r} for {name}")
        if known and fidelity not in known:
            raise ValueError(
                f"{name} has fidelities {', '.join(known)}; got {fidelity!r}, so ask for {name}{AT}{known[0]}"
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


@dataclass(frozen=True)
class LeagueJob:
    """A league to run in `folder`: the same `methods`, `seeds` and `budget` in every scene of `fixtures`.

    Methods compute in so many processes, `workers`; with an `executor` its workers search instead. `claims` are held
    against the races, by scene. `failed` takes up which scenes could not be raced, and why.
    """

    fixtures: Sequence[Fixture]
    methods: Sequence[str]
    folder: Path
    budget: int
    seeds: int
    command: str
    claims: Mapping[str, Claims] = field(default_factory=dict)
    workers: int = 1
    executor: Executor | None = None
    force: bool = False
    prints: Sequence[float] = ()
    failed: dict[str, str] = field(default_factory=dict)

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
        root: Path = ROOT,
        **how: Any,
    ) -> LeagueJob:
        """Go on with the league in `out`, by default a folder for its device, or begin it there.

        `methods` are by default all; those that cannot search a scene are left out there. More scenes, methods, seeds
        or episodes go on in the same folder. Raises ValueError for scenes, fidelities and methods that there are not,
        for a scene that is named twice, and where the folder holds something else; TooLargeError for more seeds or
        episodes than fit this machine.
        """
        budget, seeds = as_whole(budget, "a budget", least=1), as_whole(seeds, "a number of seeds", least=1)
        folder = out or league_folder(scenes, root)
        fixtures = [Fixture.of(scene, folder) for scene in scenes]
        names = [one.name for one in fixtures]
        if not fixtures or (twice := {name for name in names if names.count(name) > 1}):
            raise ValueError(f"a league has scenes, each once; got {', '.join(sorted(twice)) if fixtures else 'none'}")
        _refuse_others(folder)
        named = check_methods(methods) or list(all_methods())
        require_runs(1, budget, seeds, folder, abreast=len(named))  # what the smallest scene takes, before any is made
        return cls(fixtures, named, folder, budget, seeds, command, **how)

    def run(self, watch: Watch | None = None) -> League:
        """Say what is there and what is left, race in one scene after another, draw, write and return the league.

        A scene that fails, by whatever cause, is named with it and leaves the others to be raced. Raises Stopped where
        it is interrupted, and DiskFullError; the same job goes on from what is kept then.
        """
        watch = watch or Watch()
        watch.plan(self.work())
        self.failed.clear()
        with resumable(self.say_kept):
            self.announce(watch)
            scenes = list[SceneStandings]()
            for number, fixture in enumerate(self._sound(), 1):
                began = time.monotonic()
                watch.note(f"{number} of {len(self.fixtures)}: {fixture}")
                if (found := self._attempt(fixture, self.race, watch)) is not None:
                    scenes.append(found)
                    self._write(scenes)
                    watch.note(f"{fixture}: {_outcome(found)}, in {duration(time.monotonic() - began)}")
            return self._finish(scenes)

    def work(self) -> Iterator[Work]:
        """Return the budget of every run of the methods that can search each scene."""
        for fixture in self.fixtures:
            env = fixture.scene.make()
            able, _ = divide_methods(env, self.methods, budget=self.budget)
            asking = sum(optimizer_class(method).needs_grad for method in able)
            each = self.budget * self.seeds
            need = run_need(env.space.dim, self.budget).times(len(able) * self.seeds)
            yield Work(env, (len(able) - asking) * each, asking * each, need.disk, need.memory)

    def announce(self, watch: Watch) -> None:
        """Say of each scene how many episodes are there and what the others take to simulate, and the sum."""
        total = 0.0
        for fixture in self.fixtures:
            total += self._attempt(fixture, self.forecast, watch) or 0.0
        racers = f"{len(self.methods)} methods, {self.seeds} seeds, {self.budget} episodes each"
        watch.note(
            f"{self.folder}: {len(self._sound())} of {len(self.fixtures)} scenes, {racers}: "
            f"{duration(total)} of simulation are left, and what the methods take"
        )

    def race(self, fixture: Fixture, watch: Watch) -> SceneStandings:
        """Race in one scene, or read what is there, and return how the methods came off; raises as `run_race` does."""
        race, unable = self.run_race(fixture, watch)
        return SceneStandings.of(race, left_out=unable, command=self.command)

    def run_race(self, fixture: Fixture, watch: Watch) -> tuple[Race, dict[str, str]]:
        """Race in one scene, or read what is there; return the race, and why methods were left out.

        Raises ValueError where no method can search it here.
        """
        env = fixture.scene.make(watch)
        able, unable = divide_methods(env, self.methods, budget=self.budget)
        if not able:
            raise ValueError(f"no method can search it here: {'; '.join(unable.values())}")
        job = RaceJob.of(
            env, able, budget=self.budget, seeds=self.seeds, command=self.command, out=fixture.folder,
            claims=self.claims.get(env.name), workers=self.workers, force=self.force, prints=self.prints, watch=watch,
        )  # fmt: skip
        return replace(job, executor=self.executor).run(watch).race, unable

    def say_kept(self) -> str:
        """Say how much of it is on disk."""
        kept = sum(sum(one.count_kept(self.methods, self.seeds, self.budget).values()) for one in self.fixtures)
        whole = len(self.fixtures) * len(self.methods) * self.seeds * self.budget
        return f"{kept} of {whole} episodes are kept in {self.folder}"

    def forecast(self, fixture: Fixture, watch: Watch) -> float:
        """Say what is there of a scene and what is left, and return the seconds that it takes to simulate."""
        env = fixture.scene.make(watch)
        able, unable = divide_methods(env, self.methods, budget=self.budget)
        kept = dict.fromkeys(able, 0) if self.force else fixture.count_kept(able, self.seeds, self.budget)
        whole = self.budget * self.seeds
        left = {way: 0 for way in (0, 1)}
        for method in able:
            left[optimizer_class(method).needs_grad] += whole - kept[method]
        without = "".join(f"\n  without {method}: {why}" for method, why in unable.items())
        said = f"{fixture} · {env.device}: {sum(kept.values())} of {whole * len(able)} episodes are there"
        if not sum(left.values()):
            watch.note(said + without)
            return 0.0
        with watch.busy(f"{fixture}: {PREPARING}"):
            episode_cost(env, grad=left[1] > 0)  # compiles, which is not to count
            seconds = lockstep_seconds(env, left, sum(count < whole for count in kept.values()) * self.seeds)
        watch.note(f"{said}, the others take {duration(seconds)} to simulate{without}")
        return seconds

    def _attempt(self, fixture: Fixture, work: Any, watch: Watch) -> Any:
        """Return what a scene's work returns, None where it failed, which is said and kept."""
        try:
            return work(fixture, watch)
        except KeyboardInterrupt as stop:
            raise Stopped(f"in {fixture}; {self.say_kept()}") from stop
        except Exception as error:
            if is_full(error):
                raise full(error, self.say_kept()) from error
            self.failed[str(fixture)] = f"{type(error).__name__}: {' '.join(str(error).split())}"
            watch.note(f"{fixture} is left out: {self.failed[str(fixture)]}")
            return None
        finally:
            gc.collect()  # an environment may hold gigabytes of the GPU

    def _sound(self) -> list[Fixture]:
        return [one for one in self.fixtures if str(one) not in self.failed]

    def _write(self, scenes: Sequence[SceneStandings]) -> League:
        league = League(scenes, dict(self.failed), self.command)
        write_record(self.folder / RECORD, to_json(league))
        return league

    def _finish(self, scenes: Sequence[SceneStandings]) -> League:
        """Draw and write what the races say. Raises ValueError where no scene could be raced."""
        from ..landscapes.draw.figures.page import save, save_prints

        if not scenes:
            raise ValueError(f"no scene of the league could be raced: {_say_failed(self.failed)}")
        league = self._write(scenes)
        save(league.plot(), self.folder / PICTURE)
        save_prints(lambda width: league.plot(width=width), self.folder / PICTURE, self.prints)
        tidy(self.folder)
        return league


def simulated_scenes() -> list[str]:
    """Return the names of the scenes that this package simulates itself: those with a draft and no extra."""
    return [name for name, one in entries().items() if not one.extra and "draft" in one.fidelities]


def league_folder(scenes: Sequence[SceneSpec], root: Path = ROOT) -> Path:
    """Return the folder of all leagues on a device, whatever their scenes, methods, seeds and budget."""
    how = sorted({(one.device, one.deterministic) for one in scenes})
    return folder_named([LEAGUE.kind, *dict.fromkeys(device for device, _ in how)], how, root)


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


def _refuse_others(folder: Path) -> None:
    """Refuse a folder that holds anything but a league: its own files, and races."""
    if (folder / RECORD).exists() or any(folder.glob(f"*/*-*/{RUN_STORE}")):
        return
    refuse_others(folder, (one for one in visible_files(folder) if not one.is_dir() or visible_files(one)), LEAGUE.kind)


def _say_failed(failed: Mapping[str, str]) -> str:
    return "; ".join(f"{name}: {why}" for name, why in failed.items())


def _outcome(found: SceneStandings) -> str:
    best, first = found.best, f"{found.methods[0]} has the best mean rank"
    if best is None:
        return f"{first}; no episode succeeded"
    return f"{first}; best loss {best.loss:.6g} by {best.method}, seed {best.seed}, episode {best.episode}"
