"""The parts of a figure: the slice, companions, a sweep, episodes, searches, a report, the study of fidelities."""

from __future__ import annotations

import abc
import shlex
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from ..envs.base import Environment
from ..envs.points import point
from ..envs.registry import entries, environment_class, make
from ..jobs.episode import SMALL_LOSS, film_episode
from ..jobs.plan import simulation_seconds
from ..jobs.race import RaceJob
from ..jobs.report import ReportedSlice, ReportJob
from ..jobs.scene import SceneSpec
from ..jobs.slice import SliceJob
from ..jobs.study import StudyJob
from ..jobs.sweep import SMOOTHING, SweepJob
from ..jobs.watch import Watch
from ..landscapes.convert import to_json
from ..landscapes.cost import episode_cost
from ..landscapes.identity import digest_of, gradient_stride, plane_of, stored_identity
from ..landscapes.measures.profile import effort
from ..landscapes.objective import Evaluation, Status, evaluate
from ..landscapes.plane import Plane
from ..landscapes.storage.files import make_folder
from ..landscapes.storage.paths import has_lost_root, is_slice
from ..landscapes.storage.records import read_json, write_record
from ..landscapes.storage.store import SliceStore, open_slice
from ..optim.registry import optimizer_class
from ..studies.fidelity import SETTINGS
from ..studies.variants import StudyOptions
from . import files
from .figures import Figure
from .paper import read_paper
from .records import (
    Companion,
    Node,
    SweepRecord,
    open_run,
    read_if_sound,
    read_nodes,
    read_sweep,
    save_run,
    searched,
    write_nodes,
)

if TYPE_CHECKING:
    from concurrent.futures import Executor

    import xarray as xr
    from jaxtyping import Float
    from numpy.typing import NDArray
    from torch import Tensor

COMPANION_RESOLUTION = 24  # points along each axis of a companion's plane; a line has the figure's own
SWEEP_FIDELITY = "draft"  # as there are many episodes; of functions their only one
SWEEP_FRAMES, SWEEP_RESOLUTION, SWEEP_GRADIENTS = 12, 48, 4
SWEEP_DPI = 80
EPISODE_HEIGHT, EPISODE_FRAMES = 480, 60  # of a film: pixels and most frames
SECONDS_PER_FRAME = 0.15  # of drawing an episode, about
METHODS, BUDGET = ("random", "cma-es", "descents", "bo", "bo-leap"), 100  # of searches
SEED = 0
REPORT_POINTS, STUDY_POINTS = 6, 64  # those of `landscape report` and `landscape study fidelity`
CHANGED = tuple(one for one in SETTINGS if one not in ("engine", "device"))  # those take hours on another device


@dataclass(frozen=True)
class State:
    """How much of a slice is sampled: `done` of `points`, or None if the data is of another slice.

    `changed` names the settings of its fidelity that have changed since it was sampled.
    """

    points: int
    done: int | None
    changed: str = ""

    @property
    def finished(self) -> bool:
        """Whether all points are sampled."""
        return self.done == self.points

    def __str__(self) -> str:
        if self.finished:
            return "older" if self.changed else "there"
        if self.done is None:
            return "other settings"
        return f"{self.done} of {self.points} points" if self.done else "missing"


@dataclass(frozen=True)
class FigureList:
    """The figures of the gallery, and how much of each is in a folder of data."""

    folder: Path
    figures: tuple[tuple[Figure, State], ...]

    @property
    def summary(self) -> list[dict[str, Any]]:
        """Return the `id` and the state of each figure as plain JSON."""
        return [{"id": figure.id, **to_json(state)} for figure, state in self.figures]


@dataclass(frozen=True)
class FigurePart(abc.ABC):
    """A part of a figure, in the gallery's data at `root`.

    A part that is `of_environment` is made once for all figures of an environment.
    """

    of_environment: ClassVar[bool] = False
    figure: Figure
    root: Path
    device: str
    executor: Executor | None = None  # whose workers sample slices and sweeps

    @property
    def folder(self) -> Path:
        """The folder of the figure's data."""
        return self.root / self.figure.id

    @property
    def shared(self) -> str:
        """The name that is common to all figures that share this part."""
        return self.figure.env if self.of_environment else self.figure.id

    @abc.abstractmethod
    def label(self) -> str:
        """Return the command that makes the part, or a description of it."""

    def there(self) -> bool:
        """Say whether the part is complete."""
        return self.count_left() == 0

    @abc.abstractmethod
    def count_left(self) -> int:
        """Count the missing points, episodes, films or runs."""

    def seconds_each(self) -> float:
        """Estimate the time of one of them, by default that of an episode without gradient."""
        return episode_cost(self.scene().make(), grad=False).forward

    @abc.abstractmethod
    def make(self, watch: Watch) -> str:
        """Make what is missing, and return the result as one line of text."""

    def scene(self, fidelity: str | None = None) -> SceneSpec:
        """Return the scene at the figure's fidelity or another, or at its default if it has no such fidelity."""
        scene = self.figure.scene(self.device, fidelity)
        known = scene.fidelity in environment_class(self.figure.env).fidelities
        return scene if known else replace(scene, fidelity=None)


class SlicePart(FigurePart):
    """The slice itself, at the figure's fidelity."""

    def label(self) -> str:
        """Return the command that samples the slice."""
        return self.figure.command(self.device)

    def count_left(self) -> int:
        """Count the missing points."""
        state = self.state()
        return state.points - (state.done or 0)

    def state(self) -> State:
        """Read the state from the data, without making an environment; the device of the samples does not matter."""
        points, store = self.figure.resolution ** len(self.figure.dims), self.folder / files.STORE
        if not is_slice(store) and not has_lost_root(store):
            return State(points, 0)
        stored = SliceStore.open(store)
        same = _same(self.figure, stored.identity) and _through(stored.provenance) == self.figure.through
        changed = ", ".join(changes_since(stored.identity)) if same else ""
        return State(points, int((stored.status() > 0).sum()) if same else None, changed)

    def seconds_each(self) -> float:
        """Time one point."""
        cost = self._open().cost()
        return cost.seconds / max(cost.episodes, 1)

    def make(self, watch: Watch) -> str:
        """Sample the slice."""
        outcome = self._open().run(watch).outcome()
        if len(self.figure.dims) == 2:
            # `landscape gallery build` draws planes; events of a line need episodes
            (self.folder / files.PICTURE).unlink()
        return outcome

    def _open(self) -> SliceJob:
        env = self.scene().make()
        return SliceJob.of(
            env,
            self.figure.plane(env),
            gradients=self.figure.gradients,
            command=self.label(),
            out=self.folder,
            # nothing is lost of a store made by another model or for another device
            force=is_slice(self.folder / files.STORE) and self.state().done == 0,
            executor=self.executor,
        )


class CompanionPart(FigurePart):
    """Losses over the same parameters through other points, at the figure's fidelity, drawn on one scale."""

    def label(self) -> str:
        """Describe the slices."""
        return f"losses over the same dims through {' and '.join(points_beside(self.figure))}"

    def count_left(self) -> int:
        """Count the episodes of the slices that are missing for these settings and this slice."""
        names, key = points_beside(self.figure), self._key()
        if not names or key is None:
            return 0
        there = kept_key(self.folder / files.COMPANIONS) == key and (self.folder / files.COMPANION_PICTURE).exists()
        return 0 if there else len(names) * self._resolution ** len(self.figure.dims)

    def make(self, watch: Watch) -> str:
        """Sample the slices, draw them next to the figure's, and write their record."""
        from ..landscapes.draw.figures.multiples import CompanionSlice, companions_figure
        from ..landscapes.draw.figures.page import save
        from ..landscapes.draw.film import lighten

        dataset, env = open_slice(self.folder / files.STORE), self.scene().make()
        cuts, found = [CompanionSlice(self.figure.through, dataset["loss"].to_numpy())], list[Companion]()
        with watch.progress(self.count_left(), "episodes") as advance:
            for name in points_beside(self.figure):
                loss = _sample_losses(env, replace(self.figure, through=name).plane(env, self._resolution))
                finite = loss[np.isfinite(loss)]
                low, high = (float(finite.min()), float(finite.max())) if finite.size else (None, None)
                cuts.append(CompanionSlice(name, loss))
                found.append(Companion(name, low, high, 1 - finite.size / loss.size))
                advance(len(found) * loss.size, "")
        save(companions_figure(cuts, dataset), self.folder / files.COMPANION_PICTURE)
        lighten(self.folder / files.COMPANION_PICTURE)
        record = {"key": self._key(), "device": env.device, "slices": to_json(found)}
        write_record(self.folder / files.COMPANIONS, record)
        said = (
            "all failed" if one.lowest is None else f"losses from {one.lowest:.4g} to {one.highest:.4g}"
            for one in found
        )
        return "; ".join(f"through {one.through}: {losses}" for one, losses in zip(found, said, strict=True))

    @property
    def _resolution(self) -> int:
        return COMPANION_RESOLUTION if len(self.figure.dims) == 2 else self.figure.resolution

    def _key(self) -> dict[str, Any] | None:
        """Return the key that decides these slices and their picture, or None if the figure has no slice yet."""
        store = self.folder / files.STORE
        if not is_slice(store):
            return None
        settings = {"fidelity": self.figure.fidelity, "resolution": self._resolution}
        return {"slice": digest_of(open_slice(store)), **settings, "through": points_beside(self.figure)}


class SweepPart(FigurePart):
    """A film of the slice as another value changes; its slices stay in the sweep's folder under out/."""

    def label(self) -> str:
        """Return the command that makes the film."""
        figure, size = self.figure, ["--frames", SWEEP_FRAMES, "--resolution", SWEEP_RESOLUTION]
        words = ["landscape", "sweep", figure.env, "--dims", *figure.dims, "--over", figure.over, *size]
        words += ["--fidelity", SWEEP_FIDELITY, "--through", figure.through]
        words += ["--gradients", SWEEP_GRADIENTS] if figure.over != SMOOTHING else []  # of smoothed losses are none
        return shlex.join(map(str, [*words, *figure.set_options, "--device", self.device]))

    def count_left(self) -> int:
        """Return 1 if there is no film with these settings yet, else 0."""
        if not self.figure.over or len(self.figure.dims) != 2:
            return 0
        record = read_if_sound(read_sweep, self.folder)
        return int(record is None or record != self._record(record.label, record.low, record.high, record.command))

    def seconds_each(self) -> float:
        """Estimate the time of the film from its last slice."""
        return self._open().cost().seconds

    def make(self, watch: Watch) -> str:
        """Sample the slices of the sweep and make the film."""
        from ..landscapes.draw.figures.sweep import save_films

        drawn = self._open().sample(watch)
        save_films(drawn, self.folder / files.SWEEP_FILM, None, dpi=SWEEP_DPI, loss=SMALL_LOSS)
        record = self._record(drawn.label, drawn.values[0], drawn.values[-1], self.label())
        write_record(self.folder / files.SWEEP_RECORD, to_json(record))
        return f"{SWEEP_FRAMES} frames of {SWEEP_RESOLUTION} x {SWEEP_RESOLUTION} points over {drawn.label}"

    def _record(self, label: str, low: float, high: float, command: str) -> SweepRecord:
        shape = (SWEEP_RESOLUTION, SWEEP_RESOLUTION)
        return SweepRecord(self.figure.over, SWEEP_FIDELITY, SWEEP_FRAMES, shape, label, low, high, command)

    def _open(self) -> SweepJob:
        env = self.scene(SWEEP_FIDELITY).make()
        plane, over = self.figure.plane(env, SWEEP_RESOLUTION), self.figure.over
        job = SweepJob.of(env, plane, over, SWEEP_FRAMES, gradients=SWEEP_GRADIENTS, command=self.label())
        return replace(job, executor=self.executor)


class EpisodePart(FigurePart):
    """Films of the episodes at a few nodes, at the figure's fidelity."""

    def label(self) -> str:
        """Count the nodes."""
        return f"the episodes at {len(self._nodes)} nodes"

    def count_left(self) -> int:
        """Count the nodes without a film; 0 if the environment cannot draw episodes."""
        drawn = environment_class(self.figure.env).episode is not Environment.episode
        return len(self._nodes) - len(self._find_films()) if drawn else 0

    def seconds_each(self) -> float:
        """Time an episode, and add an assumed time for drawing it."""
        return super().seconds_each() + EPISODE_FRAMES * SECONDS_PER_FRAME

    def make(self, watch: Watch) -> str:
        """Make the missing films, and remove those of other nodes."""
        env, plane, filmed = self.scene().make(), plane_of(self._dataset), self._find_films()
        for node in self._nodes:
            if node not in filmed:
                with watch.busy(f"{self.figure.id}: episode, {node.why}"):
                    self._film(env, plane, node)
                filmed.append(node)
                write_nodes(self.folder / files.EPISODES, filmed)
        for file in self.folder.glob("episode-*"):
            if files.is_of_episode(file) and file.stem not in {node.name for node in self._nodes}:
                file.unlink()
        write_nodes(self.folder / files.EPISODES, self._nodes)
        return f"{len(self._nodes)} episodes"

    def _film(self, env: Environment, plane: Plane, node: Node) -> None:
        axes = [axis.tolist() for axis in plane.axes()]
        place = [axis[at] for axis, at in zip(axes, (node.column, node.row), strict=False)]
        episode = env.episode(plane.lift(torch.tensor([place], dtype=torch.float64))[0])
        film_episode(episode, self.folder / node.name, height=EPISODE_HEIGHT, frames=EPISODE_FRAMES)

    @cached_property
    def _dataset(self) -> xr.Dataset:
        return open_slice(self.folder / files.STORE)

    @cached_property
    def _nodes(self) -> list[Node]:
        return choose_nodes(self._dataset, point(make(self.figure.env, device="cpu"), self.figure.through))

    def _find_films(self) -> list[Node]:
        """Return the nodes that have a film."""
        listed = read_if_sound(read_nodes, self.folder / files.EPISODES) or []
        return [
            node for node in self._nodes
            if node in listed and all((self.folder / f"{node.name}.{kind}").exists() for kind in files.EPISODE_KINDS)
        ]  # fmt: skip


class SearchPart(FigurePart):
    """One run of each method in the figure's environment at its fidelity, shared by all its figures."""

    @property
    def shared(self) -> str:
        """The environment and its options."""
        return self._where.name

    def label(self) -> str:
        """Return the command that runs the searches."""
        how = ["--methods", ",".join(METHODS), "--budget", str(BUDGET), "--seeds", "1"]
        how += ["--fidelity", self.figure.fidelity, *self.figure.set_options, "--device", self.device]
        return shlex.join(["landscape", "race", self.figure.env, *how])

    def count_left(self) -> int:
        """Count the missing runs at this fidelity."""
        return len(self._missing())

    def seconds_each(self) -> float:
        """Estimate the simulation time of one run of a lockstep, without the time of the methods themselves."""
        asking = sum(optimizer_class(method).needs_grad for method in METHODS)
        counts = BUDGET * (len(METHODS) - asking), BUDGET * asking
        return simulation_seconds(self.scene().make(), *counts, len(METHODS)) / len(METHODS)

    def make(self, watch: Watch) -> str:
        """Race the methods in a folder under out/, and store the missing runs."""
        job = RaceJob.of(self.scene().make(), METHODS, budget=BUDGET, seeds=1, command=self.label(), watch=watch)
        runs = replace(job, executor=self.executor).run(watch).runs
        for method in self._missing():
            save_run(runs[method][0].data, self._file(method))
        return f"{len(METHODS)} runs of {BUDGET} episodes"

    @property
    def _where(self) -> Path:
        return self.root / files.RUNS / "-".join([self.figure.env, *map(str, self.figure.options.values())])

    def _file(self, method: str) -> Path:
        return self._where / f"{method}-0{files.RUN_SUFFIX}"

    def _missing(self) -> list[str]:
        """Return the methods without a run at the figure's fidelity that its slice's page would show."""
        fidelity, store = self.scene().fidelity, self.folder / files.STORE
        cut = SliceStore.open(store).identity if is_slice(store) else None

        def fits(run: xr.Dataset) -> bool:
            own = cut is None or searched(stored_identity(run), cut)
            return own and fidelity in (None, run.attrs["fidelity"])

        runs = {method: read_if_sound(open_run, self._file(method)) for method in METHODS}
        return [method for method, run in runs.items() if run is None or not fits(run)]


class ReportPart(FigurePart):
    """The report of the slice, next to it."""

    def label(self) -> str:
        """Return the command that measures the slice elsewhere; it names no folder above this one."""
        folder, here = self.folder.resolve(), Path.cwd()
        said = folder.relative_to(here) if folder.is_relative_to(here) else self.folder
        return f"landscape report {said} --device {self.device}"

    def count_left(self) -> int:
        """Return 1 if there is no report of this slice, else 0."""
        record, store = read_if_sound(read_json, self.folder / files.REPORT), self.folder / files.STORE
        if record is None or read_if_sound(read_json, self.folder / files.MEASURES) is None or not is_slice(store):
            return 1
        key = record.get("key")
        return int(not isinstance(key, dict) or key.get("slice") != digest_of(open_slice(store)))

    def seconds_each(self) -> float:
        """Estimate the time of a report from the first episodes."""
        rank = len(self.figure.dims)
        env = self.scene().make()
        losses, gradients = effort(rank, REPORT_POINTS, (self.figure.resolution,) * rank, len(env.replicas()))
        return simulation_seconds(env, losses, gradients, losses + gradients)

    def make(self, watch: Watch) -> str:
        """Measure the slice, and replace the report of any other slice."""
        from ..landscapes.draw.film import lighten

        for name in (files.REPORT, files.MEASURES, files.QUALITY, files.QUALITY_ARRAYS):
            (self.folder / name).unlink(missing_ok=True)
        subject, words = ReportedSlice(self.figure.id, self.folder / files.STORE), read_paper().words
        job = ReportJob([subject], self.folder, True, REPORT_POINTS, SEED, self.device, words, command=self.label())
        report = job.report(subject, watch)
        lighten(self.folder / files.QUALITY)
        return ", ".join(report.words)


class FidelityPart(FigurePart):
    """Accuracy against time of the figure's environment, shared by all its figures."""

    of_environment = True

    def label(self) -> str:
        """Return the command that runs the study elsewhere."""
        return f"landscape study fidelity {self.figure.env} --device {self.device} --settings {','.join(CHANGED)}"

    def count_left(self) -> int:
        """Return 1 if the study is missing and the environment has fidelities to compare, else 0."""
        some = len(environment_class(self.figure.env).fidelities) > 1
        devices = files.DEVICES if self.device == "auto" else (self.device,)
        return int(some and not any(map(self._sound, devices)))

    def seconds_each(self) -> float:
        """Estimate the time of all variants from the work of their episodes."""
        return sum(self._open().seconds().values())

    def make(self, watch: Watch) -> str:
        """Measure all variants; finished ones stay in a folder under out/ until the last is done."""
        from ..landscapes.draw.film import lighten

        job = self._open()
        found = job.run(watch)
        placed = files.StudyFiles.of(self.root, self.figure.env, found.device, found.kind)
        make_folder(placed.record.parent)
        shutil.copyfile(job.folder / job.results.picture, placed.picture)
        lighten(placed.picture)
        write_record(placed.record, to_json(found))
        return f"{len(found.table())} variants at {found.points} points"

    def _sound(self, device: str) -> bool:
        """Whether there is a study on a device."""
        placed = files.StudyFiles.of(self.root, self.figure.env, device, "fidelity")
        return bool(read_if_sound(read_json, placed.record)) and placed.picture.is_file()

    def _open(self) -> StudyJob:
        scene = SceneSpec(self.figure.env, device=self.device)
        options = StudyOptions(points=STUDY_POINTS, seed=SEED, settings=CHANGED)
        return StudyJob.open("fidelity", scene, options, command=self.label())


def _same(figure: Figure, identity: Mapping[str, Any]) -> bool:
    """Whether a slice has the figure's environment, fidelity, options, resolution and dimensions."""
    plane = identity["plane"]
    dims = tuple(row.index(1.0) for row in plane["basis"] if row.count(1.0) == 1)
    same = identity["objective"] == figure.env and identity["fidelity"] == figure.fidelity and dims == figure.dims
    options = {name: identity["options"].get(name) for name in figure.options}
    same &= gradient_stride(identity) == figure.gradients
    return bool(same and options == figure.options and plane["resolution"] == [figure.resolution] * len(dims))


def changes_since(identity: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the settings of a slice's fidelity that have changed since it was sampled, with both values.

    The result is empty if the scene is not registered here, or no longer has this fidelity.
    """
    if (name := identity["objective"]) not in entries():
        return {}
    now = environment_class(name).fidelities.get(identity["fidelity"])
    return now.changes_from(identity.get("settings", {})) if now is not None else {}


def _through(provenance: Mapping[str, Any]) -> str:
    """Return the point that a slice's command names, without making an environment."""
    words = shlex.split(provenance["command"])
    return words[words.index("--through") + 1] if "--through" in words else "center"


def kept_key(path: Path) -> Any:
    """Return the `key` of a record, which says what it was made from; None without a sound record or a key."""
    return (read_if_sound(read_json, path) or {}).get("key")


def points_beside(figure: Figure) -> list[str]:
    """Return the other base points of a figure's companions: the centre and the scene's first example.

    A figure that varies all parameters has the same slice through every point, so it has none.
    """
    kind = environment_class(figure.env)
    space = getattr(kind, "space", None) or SceneSpec(figure.env, device="cpu", options=figure.options).make().space
    if space.dim == len(figure.dims):
        return []
    examples = [f"example:{name}" for name in kind.examples][:1]
    return [name for name in ("center", *examples) if name != figure.through]


def _sample_losses(env: Environment, plane: Plane) -> NDArray[np.float32]:
    """Return the losses on a plane or a line, shape (v, u) or (u,), NaN where an episode failed."""
    grid = plane.grid()
    batches = torch.split(grid.reshape(-1, plane.dim), env.preferred_batch)
    found = Evaluation.join((evaluate(env, x, grad=False) for x in batches), dim=plane.dim, grad=False)
    return found.loss.reshape(grid.shape[:-1]).to(torch.float32).numpy()


def choose_nodes(dataset: xr.Dataset, through: Float[Tensor, " dim"]) -> list[Node]:
    """Choose the nodes with the lowest, median and highest loss, and the one nearest to the slice's point.

    A node that is chosen twice keeps the first reason. The nodes of a line are in row 0.
    """
    loss, status = np.atleast_2d(dataset["loss"].to_numpy()), np.atleast_2d(dataset["status"].to_numpy())
    finite = np.argsort(loss, axis=None, kind="stable")[: int(np.isfinite(loss).sum())]
    ranked = {"lowest loss": finite[:1], "median loss": finite[len(finite) // 2 :][:1], "highest loss": finite[-1:]}
    places = {why: int(at[0]) for why, at in ranked.items() if len(at)}
    plane = plane_of(dataset)
    here = plane.project(through[None])[0].tolist()
    nearest = [int(abs(axis - at).argmin()) for axis, at in zip(plane.axes(), here, strict=True)]  # u, then v
    places["through the slice's point"] = int(np.ravel_multi_index(tuple(nearest[::-1]), dataset["loss"].shape))
    nodes: dict[int, Node] = {}
    for why, place in places.items():
        row, column = divmod(place, loss.shape[1])
        value = float(loss[row, column])
        name = Status(int(status[row, column])).name
        nodes.setdefault(place, Node(row, column, why, value if np.isfinite(value) else None, name))
    return list(nodes.values())
