"""What the gallery makes of a figure: its slice, its sweep, searches of its environment."""

from __future__ import annotations

import abc
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..envs.registry import entries, environment_class
from ..jobs.watch import Watch
from ..landscapes.convert import to_json
from ..landscapes.identity import gradient_stride
from .figures import Figure
from .files import PICTURE, RUN_SUFFIX, RUNS, STORE, SWEEP_FILM, SWEEP_RECORD
from .records import SweepRecord, read_if_sound

if TYPE_CHECKING:
    from concurrent.futures import Executor

    import xarray as xr

    from ..envs.base import Environment
    from ..jobs.scene import SceneSpec
    from ..jobs.slice import SliceJob
    from ..jobs.sweep import SweepJob

DRAFT = "draft"  # fidelity of sweeps, of which there are many episodes; of functions their only one
FRAMES, COARSE, APART = 12, 48, 4  # of a sweep: frames, points along each axis, and how far apart its gradients are
DPI, LOSS = 80, 28  # of its film
METHODS, BUDGET = ("random", "cma-es", "descents", "bo", "bo-leap"), 100  # of searches


@dataclass(frozen=True)
class State:
    """How much of a slice is sampled: `done` of `points`, or None where the data is another slice's.

    `changed` names the settings of its fidelity that were others when it was sampled.
    """

    points: int
    done: int | None
    changed: str = ""

    @property
    def finished(self) -> bool:
        """Whether nothing is left to compute."""
        return self.done == self.points

    def __str__(self) -> str:
        if self.finished:
            return "older" if self.changed else "there"
        if self.done is None:
            return "other settings"
        return f"{self.done} of {self.points} points" if self.done else "missing"


@dataclass(frozen=True)
class FigureList:
    """Hold the figures of the gallery, and how much of each lies in a folder of data."""

    folder: Path
    figures: tuple[tuple[Figure, State], ...]

    @property
    def summary(self) -> list[dict[str, Any]]:
        """Return for each figure its `id` and how much of it is there, as plain JSON."""
        return [{"id": figure.id, **to_json(state)} for figure, state in self.figures]


@dataclass(frozen=True)
class FigurePart(abc.ABC):
    """Something to make of a figure, in the gallery's data at `root`."""

    figure: Figure
    root: Path
    device: str
    executor: Executor | None = None  # whose workers sample slices and sweeps

    @property
    def folder(self) -> Path:
        """Where the figure's data is."""
        return self.root / self.figure.id

    @property
    def shared(self) -> str:
        """What figures have in common that share what is made: by default nothing but themselves."""
        return self.figure.id

    @abc.abstractmethod
    def label(self) -> str:
        """Say what is made."""

    def there(self) -> bool:
        """Say whether nothing is left to make."""
        return self.count_left() == 0

    @abc.abstractmethod
    def count_left(self) -> int:
        """Count what is left to make: points, films or runs."""

    @abc.abstractmethod
    def seconds_each(self) -> float:
        """Estimate what one of them takes, from a first episode or more."""

    @abc.abstractmethod
    def make(self, watch: Watch) -> str:
        """Make what is left and say in a line what came out."""

    def scene(self, fidelity: str | None = None) -> SceneSpec:
        """Return the scene at the figure's fidelity or another; at its default where it does not have that one."""
        scene = self.figure.scene(self.device, fidelity)
        known = scene.fidelity in environment_class(self.figure.env).fidelities
        return scene if known else replace(scene, fidelity=None)


class SlicePart(FigurePart):
    """The slice itself, at the figure's fidelity."""

    def label(self) -> str:
        """Return the command that samples it."""
        return self.figure.command(self.device)

    def count_left(self) -> int:
        """Count the points not sampled."""
        state = self.state()
        return state.points - (state.done or 0)

    def state(self) -> State:
        """Look at the data without making an environment; who sampled it, and on what device, does not matter."""
        from ..landscapes.storage.arrays import FILES
        from ..landscapes.storage.files import has_lost_root
        from ..landscapes.storage.paths import is_slice
        from ..landscapes.storage.store import SliceStore

        points, store = self.figure.resolution ** len(self.figure.dims), self.folder / STORE
        if not is_slice(store) and not has_lost_root(store, FILES):
            return State(points, 0)
        stored = SliceStore.open(store)
        same = _same(self.figure, stored.identity) and _through(stored.provenance) == self.figure.through
        changed = ", ".join(changes_since(stored.identity)) if same else ""
        return State(points, int((stored.status() > 0).sum()) if same else None, changed)

    def seconds_each(self) -> float:
        """Time a point."""
        cost = self._open().cost()
        return cost.seconds / max(cost.episodes, 1)

    def make(self, watch: Watch) -> str:
        """Sample the slice."""
        outcome = self._open().run(watch).outcome()
        if len(self.figure.dims) == 2:
            (self.folder / PICTURE).unlink()  # `landscape gallery build` draws planes; a line's events need episodes
        return outcome

    def _open(self) -> SliceJob:
        from ..jobs.slice import SliceJob
        from ..landscapes.storage.paths import is_slice

        env = self.scene().make()
        return SliceJob.of(
            env,
            self.figure.plane(env),
            gradients=self.figure.gradients,
            command=self.figure.command(self.device),
            out=self.folder,
            # nothing is lost of a store made by another model or for another device
            force=is_slice(self.folder / STORE) and self.state().done == 0,
            executor=self.executor,
        )


class SweepPart(FigurePart):
    """The slice as something else moves: a film, of slices that stay in the sweep's own folder under out/."""

    def label(self) -> str:
        """Return the command that makes it."""
        how = {"frames": FRAMES, "resolution": COARSE, "gradients": APART}
        return self.figure.sweep_command(**how, fidelity=DRAFT, device=self.device)

    def count_left(self) -> int:
        """Return 1 where there is no film of these settings yet."""
        if not self.figure.over or len(self.figure.dims) != 2:
            return 0
        record = read_if_sound(SweepRecord.read, self.folder / SWEEP_RECORD)
        if record is None or not (self.folder / SWEEP_FILM).exists():
            return 1
        return int(record != self._record(record.label, record.low, record.high, record.command))

    def seconds_each(self) -> float:
        """Time the film by its last slice."""
        return self._open().cost().seconds

    def make(self, watch: Watch) -> str:
        """Sample the sweep's slices and film them."""
        from ..landscapes.draw.figures.sweep import save_films

        drawn = self._open().sample(watch)
        save_films(drawn, self.folder / SWEEP_FILM, None, dpi=DPI, loss=LOSS)
        record = self._record(drawn.label, drawn.values[0], drawn.values[-1], self.label())
        record.write(self.folder / SWEEP_RECORD)
        return f"{FRAMES} frames of {COARSE} x {COARSE} points over {drawn.label}"

    def _record(self, label: str, low: float, high: float, command: str) -> SweepRecord:
        return SweepRecord(self.figure.over, DRAFT, FRAMES, [COARSE, COARSE], label, low, high, command)

    def _open(self) -> SweepJob:
        from ..jobs.sweep import SweepJob

        env = self.scene(DRAFT).make()
        plane, over = self.figure.plane(env, COARSE), self.figure.over
        job = SweepJob.of(env, plane, over, FRAMES, gradients=APART, command=self.label())
        return replace(job, executor=self.executor)


class SearchPart(FigurePart):
    """A run of each method in the figure's environment at its fidelity, which its other figures share."""

    @property
    def shared(self) -> str:
        """The environment and its options."""
        return self._where.name

    def label(self) -> str:
        """Return the command that races them."""
        return self.figure.race_command(METHODS, budget=BUDGET, device=self.device)

    def count_left(self) -> int:
        """Count the runs not made at this fidelity."""
        return len(self._missing())

    def seconds_each(self) -> float:
        """Share what simulating all of them in lockstep takes; what methods take themselves comes on top."""
        from ..jobs.race import lockstep_seconds
        from ..optim.registry import optimizer_class

        env = self.scene().make()
        asking = sum(optimizer_class(method).needs_grad for method in METHODS)
        left = {0: BUDGET * (len(METHODS) - asking), 1: BUDGET * asking}
        return lockstep_seconds(env, left, len(METHODS)) / len(METHODS)

    def make(self, watch: Watch) -> str:
        """Race the methods, in a folder under out/, and keep the runs that are missing."""
        from ..jobs.race import RaceJob
        from .runs import save_run

        job = RaceJob.of(self.scene().make(), METHODS, budget=BUDGET, seeds=1, command=self.label(), watch=watch)
        runs = replace(job, executor=self.executor).run(watch).race.runs
        for method in self._missing():
            save_run(runs[method][0].data, self._file(method))
        return f"{len(METHODS)} runs of {BUDGET} episodes"

    @property
    def _where(self) -> Path:
        return self.root / RUNS / "-".join([self.figure.env, *map(str, self.figure.options.values())])

    def _file(self, method: str) -> Path:
        return self._where / f"{method}-0{RUN_SUFFIX}"

    def _missing(self) -> list[str]:
        """Return the methods without a run at the figure's fidelity that its slice's page would show."""
        from ..landscapes.identity import stored_identity
        from ..landscapes.storage.paths import is_slice
        from ..landscapes.storage.store import SliceStore
        from .runs import open_run, searched

        fidelity, store = self.scene().fidelity, self.folder / STORE
        cut = SliceStore.open(store).identity if is_slice(store) else None

        def fits(run: xr.Dataset) -> bool:
            own = cut is None or searched(stored_identity(run), cut)
            return own and fidelity in (None, run.attrs["fidelity"])

        runs = {method: read_if_sound(open_run, self._file(method)) for method in METHODS}
        return [method for method, run in runs.items() if run is None or not fits(run)]


def _same(figure: Figure, identity: Mapping[str, Any]) -> bool:
    """Whether a slice has the figure's environment, fidelity, options, resolution and dimensions."""
    plane = identity["plane"]
    dims = tuple(row.index(1.0) for row in plane["basis"] if row.count(1.0) == 1)
    same = identity["objective"] == figure.env and identity["fidelity"] == figure.fidelity and dims == figure.dims
    options = {name: identity["options"].get(name) for name in figure.options}
    same &= gradient_stride(identity) == figure.gradients
    return bool(same and options == figure.options and plane["resolution"] == [figure.resolution] * len(dims))


def changes_since(identity: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the settings of a slice's fidelity that are others now than when it was sampled: both values.

    There are none that are known of a scene that is not registered here, or of a fidelity that it has no more.
    """
    if (name := identity["objective"]) not in entries():
        return {}
    now = environment_class(name).fidelities.get(identity["fidelity"])
    return now.changes_from(identity.get("settings", {})) if now is not None else {}


def _through(provenance: Mapping[str, Any]) -> str:
    """Return the point that a slice's command names, which no environment has to be made for."""
    words = shlex.split(provenance["command"])
    return words[words.index("--through") + 1] if "--through" in words else "center"


def seconds_of_one(env: Environment) -> float:
    """Return the seconds of an episode without gradient."""
    from ..landscapes.cost import episode_cost

    return episode_cost(env, grad=False).forward
