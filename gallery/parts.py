"""What `landscape gallery compute` makes for a figure: its slice, its sweep, searches of its environment."""

from __future__ import annotations

import abc
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..commands.terminal import Console
from ..envs.registry import environment_class, make
from ..jobs.scene import provenance as provenance_of
from ..jobs.slice import picture_of
from ..jobs.workers import recipe
from .figures import Figure

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..envs.base import Environment
    from ..jobs.slice import SliceJob
    from ..jobs.sweep import SweepJob
    from ..landscapes.plane import Plane

DRAFT = "draft"  # fidelity of sweeps and searches, of which there are many episodes; of functions their only one
FRAMES, COARSE = 12, 24  # of a sweep: frames, and points along each axis
DPI, LOSS = 80, 28  # of its film
FILM, ABOUT = "sweep.mp4", "sweep.json"
METHODS, BUDGET, SEED = ("random", "cma-es", "descents", "bo", "bo-leap"), 100, 0


@dataclass(frozen=True)
class State:
    """How much of a slice is sampled: `done` of `points`, or None where the data is another slice's."""

    points: int
    done: int | None

    @property
    def finished(self) -> bool:
        """Whether nothing is left to compute."""
        return self.done == self.points


@dataclass(frozen=True)
class Part(abc.ABC):
    """Something to make of a figure, in the gallery's data at `root`."""

    figure: Figure
    root: Path
    device: str
    executor: Executor | None = None  # whose workers sample slices and sweeps

    @property
    def folder(self) -> Path:
        """Where the figure's data is."""
        return self.root / self.figure.id

    @abc.abstractmethod
    def label(self) -> str:
        """Say what is made."""

    def there(self) -> bool:
        """Say whether nothing is left to make."""
        return self.left() == 0

    @abc.abstractmethod
    def left(self) -> int:
        """Count what is left to make: points, films or runs."""

    @abc.abstractmethod
    def seconds_each(self) -> float:
        """Estimate what one of them takes, from a first episode or more."""

    @abc.abstractmethod
    def make(self, console: Console) -> str:
        """Make what is left and say in a line what came out."""

    def _env(self, fidelity: str) -> Environment:
        known = fidelity if fidelity in environment_class(self.figure.env).fidelities else None
        return make(self.figure.env, fidelity=known, device=self.device, **self.figure.options)


class Slice(Part):
    """The slice itself, at the figure's fidelity."""

    def label(self) -> str:
        """Return the command that samples it."""
        return self.figure.command(self.device)

    def left(self) -> int:
        """Count the points not sampled."""
        state = self.state()
        return state.points - (state.done or 0)

    def state(self) -> State:
        """Look at the data without making an environment; who sampled it, and on what device, does not matter."""
        from ..jobs.slice import STORE
        from ..landscapes.storage.arrays import FILES
        from ..landscapes.storage.ownership import lost_root
        from ..landscapes.storage.store import SliceStore, is_slice

        points, store = self.figure.resolution ** len(self.figure.dims), self.folder / STORE
        if not is_slice(store) and not lost_root(store, FILES):
            return State(points, 0)
        kept = SliceStore.open(store)
        return State(points, int((kept.status() > 0).sum()) if _same(self.figure, kept.identity) else None)

    def seconds_each(self) -> float:
        """Time a point."""
        cost = self._open().cost()
        return cost.seconds / max(cost.episodes, 1)

    def make(self, console: Console) -> str:
        """Sample the slice."""
        from ..jobs.slice import PICTURE

        job = self._open()
        from ..api.progress import Bars

        said = job.run(Bars(console)).outcome()
        if len(self.figure.dims) == 2:
            (self.folder / PICTURE).unlink()  # `landscape gallery build` draws planes; a line's events need episodes
        return said

    def _open(self) -> SliceJob:
        from ..jobs.slice import STORE, SliceJob
        from ..landscapes.storage.store import is_slice

        env = self._env(self.figure.fidelity)
        plane = plane_of_figure(self.figure, env, self.figure.resolution)
        empty = is_slice(self.folder / STORE) and self.state().done == 0
        return SliceJob.open(
            env,
            plane,
            self.folder,
            picture_of(env, plane),
            identity=env.identity(),
            provenance=provenance_of(env, self.figure.command(self.device)),
            command=self.figure.command(self.device),
            force=empty,  # nothing is lost of a store made by other code or for another device
            executor=self.executor,
            remake=recipe(env),
        )


class Sweep(Part):
    """The slice as something else moves: a film, of slices that stay in the sweep's own folder under out/."""

    def label(self) -> str:
        """Return the command that makes it."""
        return self.figure.sweep_command(frames=FRAMES, resolution=COARSE, fidelity=DRAFT, device=self.device)

    def left(self) -> int:
        """Return 1 where there is no film of these settings yet."""
        if not self.figure.over or len(self.figure.dims) != 2:
            return 0
        kept = read_record(self.folder / ABOUT)
        there = (self.folder / FILM).exists() and isinstance(kept, dict)
        return 0 if there and all(kept.get(name) == value for name, value in self._settings.items()) else 1

    def seconds_each(self) -> float:
        """Time the film by its last slice."""
        return self._job().cost().seconds

    def make(self, console: Console) -> str:
        """Sample the sweep's slices and film them."""
        from ..landscapes.draw.figures.sweep import save_films
        from ..landscapes.storage.records import write_record

        job = self._job()
        from ..api.progress import Bars

        drawn = job.sample(Bars(console))
        save_films(drawn, self.folder / FILM, None, dpi=DPI, loss=LOSS)
        about = {"label": drawn.label, "low": drawn.values[0], "high": drawn.values[-1], "command": self.label()}
        write_record(self.folder / ABOUT, {**self._settings, **about})
        return f"{FRAMES} frames of {COARSE} x {COARSE} points over {drawn.label}"

    @property
    def _settings(self) -> dict[str, Any]:
        return {"over": self.figure.over, "fidelity": DRAFT, "frames": FRAMES, "resolution": [COARSE, COARSE]}

    def _job(self) -> SweepJob:
        from ..jobs.motion import SMOOTHING, Motion
        from ..jobs.sweep import SweepJob, sweep_folder

        env, over = self._env(DRAFT), self.figure.over
        motion = Motion.of(env, plane_of_figure(self.figure, env, COARSE), over, FRAMES)
        grad = over != SMOOTHING
        folder = sweep_folder(env, motion, over, grad=grad)
        return replace(SweepJob.open(env, motion, folder, command=self.label(), grad=grad), executor=self.executor)


class Searches(Part):
    """A run of each method in the figure's environment, which its other figures share."""

    def label(self) -> str:
        """Name methods, budget and scene."""
        return f"{', '.join(METHODS)}: {BUDGET} episodes each in {self._where.name}"

    def left(self) -> int:
        """Count the runs not made."""
        return len(self._missing)

    def seconds_each(self) -> float:
        """Time a run by one of its episodes; what a method takes itself comes on top."""
        return BUDGET * 2 * seconds_of_one(self._env(DRAFT))

    def make(self, console: Console) -> str:
        """Run every method that has not run."""
        from ..api.progress import Bars
        from ..jobs.search import SearchJob, make_optimizer
        from .runs import save_run

        env = self._env(DRAFT)
        for method in self._missing:
            command = self.figure.search_command(
                method, budget=BUDGET, seed=SEED, fidelity=env.fidelity.name, device=self.device
            )
            job = SearchJob.of(env, make_optimizer(method, env, seed=SEED), budget=BUDGET, command=command)
            job.run(Bars(console))
            save_run(job.store.dataset(), self._file(method))
        return f"{len(METHODS)} runs of {BUDGET} episodes"

    @property
    def _where(self) -> Path:
        from .runs import FOLDER

        return self.root / FOLDER / "-".join([self.figure.env, *map(str, self.figure.options.values())])

    def _file(self, method: str) -> Path:
        from .runs import SUFFIX

        return self._where / f"{method}-{SEED}{SUFFIX}"

    @property
    def _missing(self) -> list[str]:
        from .runs import open_run

        missing = []
        for method in METHODS:
            try:
                open_run(self._file(method))
            except (OSError, ValueError):  # not there, or damaged
                missing.append(method)
        return missing


def plane_of_figure(figure: Figure, env: Environment, resolution: int) -> Plane:
    """Return the plane of a figure's slice."""
    from ..envs.points import point
    from ..landscapes.plane import Plane

    return Plane.through(env.space, point(env, figure.through), figure.dims, resolution=resolution)


def _same(figure: Figure, identity: dict[str, Any]) -> bool:
    """Whether a slice has the figure's environment, fidelity, options, resolution and dimensions."""
    plane = identity["plane"]
    dims = tuple(row.index(1.0) for row in plane["basis"] if row.count(1.0) == 1)
    same = identity["objective"] == figure.env and identity["fidelity"] == figure.fidelity and dims == figure.dims
    options = {name: identity["options"].get(name) for name in figure.options}
    return bool(same and options == figure.options and plane["resolution"] == [figure.resolution] * len(dims))


def seconds_of_one(env: Environment) -> float:
    """Return the seconds of an episode without gradient."""
    from ..landscapes.cost import episode_cost

    return episode_cost(env, grad=False).forward


def read_record(path: Path) -> Any:
    """Return the record or the list of records that a JSON file holds, None if there is none that can be read."""
    from ..landscapes.storage.records import unsigned

    try:
        found = json.loads(path.read_text())
        return [unsigned(one) for one in found] if isinstance(found, list) else unsigned(found)
    except (OSError, TypeError, ValueError):
        return None
