"""A sweep to sample into a folder, slice by slice, and to film: what it will cost, its films, its summary."""

from __future__ import annotations

import json
import math
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xarray as xr

from ..landscapes.capacity import size
from ..landscapes.convert import to_json
from ..landscapes.cost import duration
from ..landscapes.identity import with_stride
from ..landscapes.lattice import check_gradients, count_gradients
from ..landscapes.objective import BoxedObjective, Objective, failed
from ..landscapes.plain import plain_name
from ..landscapes.sampling.fill import Progress, sample
from ..landscapes.storage.arrays import need_of as slice_need
from ..landscapes.storage.files import discard, tidy, visible_files, write_json
from ..landscapes.storage.ownership import refuse_others
from ..landscapes.storage.paths import check_replaceable, filling_path, slice_exists
from ..landscapes.storage.store import SliceStore
from .folder import ROOT, SWEEP, folder_named
from .job import Job
from .motion import HORIZON, SMOOTHING, Motion, refuse_too_large
from .plan import Work
from .scene import provenance
from .slice import SliceCost, estimate_cost, kind_of
from .slice_place import MOST
from .slice_summary import count_statuses, flat_points, range_of, say_range
from .watch import PREPARING, Advance, Watch
from .workers import recipe

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.draw.figures.sweep import Sweep
    from ..landscapes.plane import Plane

FRAMES, ONLY, FILM, GIF, STREAM, SUMMARY = SWEEP.files
FRAME = re.compile(r"\d{3,}(?:\.filling)?\.zarr")  # what the folder of a sweep's slices holds


@dataclass(frozen=True)
class FrameSummary:
    """Say what a frame shows: the value of what moves, the ends of its losses, how many points ended how."""

    value: float
    loss: dict[str, float | None]
    status: dict[str, int]
    flat: int | None

    @classmethod
    def of(cls, value: float, dataset: xr.Dataset) -> FrameSummary:
        """Count and measure what a frame's slice holds."""
        return cls(value, range_of(dataset), count_statuses(dataset), flat_points(dataset))


@dataclass(frozen=True)
class SweepSummary:
    """Say what a sweep cost and what each of its frames shows, as `summary.json` beside it has it."""

    env: str
    dims: list[str]
    over: str
    fidelity: str | None
    device: str | None
    options: dict[str, Any] | None
    resolution: list[int]
    gradients: bool
    gradients_every: int
    episodes: int
    resumed: int
    seconds: float
    loss: dict[str, float | None]
    frames: list[FrameSummary]
    command: str
    files: list[str]

    def outcome(self) -> str:
        """Say in a line what the sweep cost and what came out."""
        ended = Counter[str]()
        for frame in self.frames:
            ended.update(frame.status)
        losses = say_range(self.loss)
        failures = "".join(f"; {count} {kind}" for kind, count in ended.items() if count and kind != "ok")
        done = f"{self.episodes} episodes in {duration(self.seconds)}"
        return f"{done}; {len(self.frames)} frames; {losses}{failures}"


@dataclass(frozen=True, kw_only=True)
class SweepJob(Job[SweepSummary]):
    """A sweep to sample slice by slice, here or by the workers of an `executor`, and to film.

    A `boxed` one leaves out what lies outside the parameters' bounds.
    """

    results = SWEEP
    env: Environment
    motion: Motion
    stores: tuple[SliceStore, ...]
    executor: Executor | None = None
    boxed: bool = False

    @classmethod
    def open(
        cls,
        env: Environment,
        motion: Motion,
        folder: Path,
        *,
        command: str,
        gradients: int = 1,
        force: bool = False,
        cut: Mapping[str, Any] | None = None,
    ) -> SweepJob:
        """Go on with the sweep in `folder`, or begin it there; `force` begins anew where another one is.

        Gradients are at every so many samples along each axis, `gradients`, 0 for none. With a `cut`, how it was cut
        along directions, it is boxed. Raises ValueError where the folder holds something else, StoreMismatchError where
        it holds another sweep.
        """
        check_folder(folder)
        if force:
            _clear(folder)
        how: dict[str, Any] = {"grad": gradients > 0, "provenance": provenance(env, command)}
        oblique: dict[str, Any] = {"boxed": True, "cut": dict(cut)} if cut else {}
        made = [with_stride(motion.env_at(number).identity(), gradients) for number in range(len(motion.stores))]
        stores = tuple(
            SliceStore.open_or_create(folder / name, plane, env.space, identity=identity | oblique, **how)
            for name, plane, identity in zip(motion.stores, motion.planes, made, strict=True)
        )
        return cls(env=env, motion=motion, folder=folder, stores=stores, command=command, boxed=bool(cut))

    @classmethod
    def of(
        cls,
        env: Environment,
        plane: Plane,
        over: int | str,
        frames: int,
        *,
        command: str,
        out: Path | None = None,
        gradients: bool | int = 1,
        force: bool = False,
        cut: Mapping[str, Any] | None = None,
    ) -> SweepJob:
        """Open the sweep of an environment in `out`, by default a folder named after it under out/.

        Of smoothed losses there are no gradients. With a `cut` it is boxed, and one that was begun goes on along its
        own directions: on a GPU they come out a little different each time. Raises ValueError for what cannot be swept
        and where gradients cannot be so far apart, TooLargeError for what has no room here, and as `open` does.
        """
        if plane.rank != 2 or frames < 2:
            dims = ", ".join(plane.names)
            raise ValueError(f"a sweep has two dims and two frames or more; got {dims} and {frames} frames")
        gradients = check_gradients(gradients, plane, refined=False)
        gradients = 0 if over == SMOOTHING else gradients
        refuse_too_large(plane, frames, out or ROOT, grad=gradients > 0, over=over)
        motion = Motion.of(env, plane, over, frames)
        folder = out or sweep_folder(env, motion, over, gradients=gradients, cut=cut)
        if cut and not force:
            motion = Motion.of(env, _along_kept(folder / motion.stores[0], plane, cut), over, frames)
        return cls.open(env, motion, folder, command=command, gradients=gradients, force=force, cut=cut)

    @cached_property
    def total(self) -> int:
        """Points in all slices."""
        return sum(math.prod(store.shape) for store in self.stores)

    def done(self) -> int:
        """Count the points that are on disk."""
        return sum(int((store.status() > 0).sum()) for store in self.stores)

    def cost(self) -> SliceCost:
        """Estimate what is left, by points of the last slice that is not finished."""
        pending = {number: int((store.status() == 0).sum()) for number, store in enumerate(self.stores)}
        work = {number: self.motion.env_at(number).work().count * count for number, count in pending.items() if count}
        if not work:
            return SliceCost(0, 0.0, 0)
        last = max(work)
        objective, made = self._sampled(last)
        cost = estimate_cost(objective, self.stores[last], self.executor, made)
        return SliceCost(sum(pending.values()), cost.seconds * sum(work.values()) / work[last], cost.memory)

    def work(self) -> Iterator[Work]:
        """Return the samples of each slice."""
        for number, (store, plane) in enumerate(zip(self.stores, self.motion.planes, strict=True)):
            having = count_gradients(plane.resolution, store.every if store.grad else 0)
            need = slice_need(plane.resolution, plane.dim, grad=store.grad)
            env = self.motion.env_at(number)
            yield Work(env, math.prod(plane.resolution) - having, having, need.disk, need.memory)

    def compute(self, watch: Watch) -> SweepSummary:
        """Sample what is missing, film it and return the summary."""
        self._announce(watch)
        start, resumed = time.monotonic(), self.done()
        drawn = self.sample(watch)
        with watch.busy("drawing"):
            self._film(drawn)
        return self._summary(drawn, resumed, time.monotonic() - start)

    def write(self, found: SweepSummary) -> list[str]:
        """Write the summary."""
        write_json(self.folder / SUMMARY, to_json(found))
        tidy(self.folder)
        return found.files

    def outcome(self, found: SweepSummary) -> str:
        """Say in a line what the sweep cost and what came out."""
        return found.outcome()

    def sample(self, watch: Watch | None = None) -> Sweep:
        """Sample what is missing, and return what there is to draw.

        Raises StoreMismatchError where the scene gives other numbers than a slice holds.
        """
        with (watch or Watch()).progress(self.total) as advance:
            count = _Count(advance, len(self.stores))
            slices = [self._sample(number, count) for number in range(len(self.stores))]
        from ..landscapes.draw.figures.sweep import Sweep

        moved = self.motion
        return Sweep(moved.label, moved.values, moved.slices(slices), moved.logarithmic)

    def kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{self.done()} of {self.total} points are kept in {self.folder}"

    def _announce(self, watch: Watch) -> None:
        """Say what is left to compute and what that costs."""
        left, env, kind = self.total - self.done(), self.env, kind_of(self.stores[0])
        watch.note(f"{env.name} · {env.fidelity.name} · {env.device} · {self.folder}")
        if not left:
            watch.note(f"all {self.total} {kind} of {len(self.stores)} slices are there already")
            return
        with watch.busy(f"{env.name}: {PREPARING}"):
            cost = self.cost()
        kept = f", {self.total - left} are there already" if left < self.total else ""
        slices = f"{len(self.stores)} slices" if len(self.stores) > 1 else "one slice"
        takes = f"about {duration(cost.seconds)}, {size(cost.memory)} of memory"
        watch.note(f"{left} {kind} of {slices} to compute{kept}: {takes}")

    def _sample(self, number: int, count: _Count) -> xr.Dataset:
        (objective, made), store = self._sampled(number), self.stores[number]
        how: dict[str, Any] = {"gradients": int(store.grad), "executor": self.executor, "made": made}
        dataset = sample(objective, self.motion.planes[number], store, progress=count.follow, **how)
        count.add(dataset)
        return dataset

    def _sampled(self, number: int) -> tuple[Objective, Callable[[], Objective] | None]:
        """Return what is sampled on a plane, and how workers make it, None where they are sent it."""
        env = self.motion.env_at(number)
        return (BoxedObjective(env), None) if self.boxed else (env, recipe(env))

    def _film(self, drawn: Sweep) -> None:
        from ..landscapes.draw.figures.sweep import save_films
        from ..landscapes.draw.recordings.sweep import save_stream

        save_films(drawn, self.folder / FILM, self.folder / GIF)
        save_stream(drawn, self.folder / STREAM)

    def _summary(self, drawn: Sweep, resumed: int, seconds: float) -> SweepSummary:
        first = self.stores[0]
        frames = [FrameSummary.of(value, one) for value, one in zip(drawn.values, drawn.slices, strict=True)]
        ends = [end for frame in frames for end in frame.loss.values() if end is not None]
        return SweepSummary(
            env=self.env.name,
            dims=list(first.plane.names),
            over=drawn.label,
            fidelity=first.identity["fidelity"],
            device=first.identity["device"],
            options=first.identity["options"],
            resolution=list(first.plane.resolution),
            gradients=first.grad,
            gradients_every=first.every,
            episodes=self.total - resumed,
            resumed=resumed,
            seconds=round(seconds, 3),
            loss={"lowest": min(ends, default=None), "highest": max(ends, default=None)},
            frames=frames,
            command=self.command,
            files=[*sorted({name.split("/")[0] for name in self.motion.stores}), FILM, GIF, STREAM, SUMMARY],
        )


@dataclass
class _Count:
    """Hold how much of a sweep is sampled, over all of its slices, and show it."""

    advance: Advance
    slices: int
    number: int = 1
    finished: int = 0
    failed: int = 0

    def follow(self, now: Progress) -> None:
        """Show how far the slice under way is."""
        lost = self.failed + sum(count for status, count in now.statuses.items() if failed(status))
        said = f"slice {self.number} of {self.slices}" + (f", {lost} failed" if lost else "")
        self.advance(self.finished + now.done, said)

    def add(self, dataset: xr.Dataset) -> None:
        """Count a slice that is finished."""
        self.number += 1
        self.finished += dataset["status"].size
        self.failed += int(failed(dataset["status"]).sum())


def sweep_folder(
    env: Environment, motion: Motion, over: int | str, *, gradients: int = 1, cut: Mapping[str, Any] | None = None
) -> Path:
    """Return a folder of its own for every different sweep, the same for the same one."""
    planes = [plane.record() for plane in motion.planes]
    what = over if over in (SMOOTHING, HORIZON) else env.space.index(over)
    points = "x".join(map(str, (*planes[0]["resolution"], len(motion.values))))
    if cut is None:
        axes: list[Any] = [int(row.nonzero()[0]) for row in motion.planes[0].basis]
        where: list[Any] = [planes]
    else:  # directions may differ by rounding
        axes, where = [plain_name(cut["along"])[:MOST]], [dict(cut), points]
    parts = ["sweep", env.name, *axes, "over", what, env.fidelity.name, points]
    return folder_named(parts, [with_stride(env.identity(), gradients), *where, motion.values, gradients > 0])


def _along_kept(path: Path, plane: Plane, cut: Mapping[str, Any]) -> Plane:
    """Return a plane along the directions of a sweep that was begun with the same cut, else the plane as it is."""
    if not slice_exists(path):
        return plane
    kept = SliceStore.open(path)
    if kept.identity.get("cut") != json.loads(json.dumps(dict(cut))) or kept.plane.resolution != plane.resolution:
        return plane
    return replace(kept.plane, origin=plane.origin)


def check_folder(folder: Path) -> None:
    """Raise ValueError where a folder holds anything but a sweep: its films without any slice are somebody else's."""
    held = visible_files(folder)
    begun = [file for file in held if file.name in (FRAMES, ONLY, filling_path(Path(ONLY)).name)]
    strange = [file for file in visible_files(folder / FRAMES) if not FRAME.fullmatch(file.name)]
    refuse_others(folder, strange if begun else held, SWEEP.kind)
    SWEEP.check(folder, begun)


def _clear(folder: Path) -> None:
    """Remove the slices of a sweep, and what was made of them."""
    places = [*visible_files(folder / FRAMES), folder / ONLY, filling_path(folder / ONLY)]
    stores = [store for store in places if store.exists()]
    for store in stores:
        check_replaceable(store)
    for store in stores:
        discard(store)
    for name in (FILM, GIF, STREAM, SUMMARY):
        (folder / name).unlink(missing_ok=True)
