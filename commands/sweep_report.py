"""What `landscape sweep` does and prints."""

from __future__ import annotations

import hashlib
import json
import re
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ..envs.registry import make
from ..jobs.scene import provenance as provenance_of
from ..jobs.swept import FRAMES, HORIZON, ONLY, SMOOTHING, Moved, moved, refuse_too_large
from ..jobs.workers import recipe, workers
from ..landscapes.capacity import size
from ..landscapes.cost import duration
from ..landscapes.storage.disk import until_full
from ..landscapes.storage.files import discard, tidy, visible_files, write_json
from ..landscapes.storage.paths import check_replaceable, filling_path
from .arguments import read_extent, read_settings
from .terminal import Console, Described

if TYPE_CHECKING:
    from concurrent.futures import Executor

    import xarray as xr
    from matplotlib.figure import Figure

    from ..envs.base import Environment
    from ..landscapes.draw.figures.sweep import Sweep
    from ..landscapes.sampling.fill import Progress as Sampled
    from ..landscapes.storage.store import SliceStore

SUMMARY = "summary.json"
FILM, GIF, STREAM = "sweep.mp4", "sweep.gif", "sweep.rrd"
FRAME = re.compile(r"\d{3,}(?:\.filling)?\.zarr")  # what the folder of a sweep's slices holds


def sweep(
    name: str,
    dims: Sequence[str],
    over: str,
    *,
    frames: int,
    resolution: int,
    fidelity: str | None,
    device: str,
    engine: str,
    deterministic: bool,
    through: str,
    extent: str | None,
    settings: Sequence[str],
    grad: bool,
    out: str | None,
    as_json: bool,
    force: bool,
    scheduler: str | None = None,
) -> None:
    """Sample a slice for each value of what moves, film them, and say what it costs and what came out."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    how: dict[str, Any] = {"fidelity": fidelity, "device": device, "engine": engine, "deterministic": deterministic}
    made = partial(make, name, **how, **read_settings(settings))
    env = made()
    from ..jobs.scene import point_of
    from ..landscapes.plane import Plane

    plane = Plane.through(env.space, point_of(env, through), dims, resolution=resolution, extent=read_extent(extent))
    if plane.rank != 2 or frames < 2:
        raise ValueError(f"a sweep has two dims and two frames or more; got {', '.join(dims)} and {frames} frames")
    grad = grad and over != SMOOTHING  # of smoothed losses there are no gradients to show
    refuse_too_large(plane, frames, Path(out or "out"), grad=grad, over=over)
    swept = moved(over, env, plane, frames, made)
    folder = Path(out) if out else sweep_folder(env, swept, over, grad=grad)
    with console.status(f"opening {len(swept.planes)} slices"):
        job = Job.open(env, swept, folder, command=shlex.join(["landscape", *sys.argv[1:]]), grad=grad, force=force)
    with workers(scheduler, env.device) as executor:
        job = replace(job, executor=executor)
        try:
            with until_full(job.kept):
                job.announce(console)
                summary = job.run(console)
        except KeyboardInterrupt:
            job.farewell(console)
            sys.exit(130)
    console.print(_outcome(summary) + f"\n{folder}: {', '.join(summary['files'])}", markup=False)
    if as_json:
        print(json.dumps({**summary, "folder": str(folder)}))


@dataclass(frozen=True)
class Job:
    """A sweep to sample into `folder`, slice by slice, and to film; `executor` is that of `sample`."""

    env: Environment
    moved: Moved
    folder: Path
    stores: tuple[SliceStore, ...]
    command: str
    executor: Executor | None = None

    @classmethod
    def open(
        cls, env: Environment, moved: Moved, folder: Path, *, command: str, grad: bool = True, force: bool = False
    ) -> Job:
        """Go on with the sweep in `folder`, or begin it there; `force` begins anew where another one is."""
        from ..landscapes.storage.store import SliceStore

        _check(folder)
        if force:
            _clear(folder)
        provenance = provenance_of(env, command)
        stores = tuple(
            SliceStore.open_or_create(
                folder / name, plane, env.space, grad=grad, identity=moved.env_at(i).identity(), provenance=provenance
            )
            for i, (name, plane) in enumerate(zip(moved.stores, moved.planes, strict=True))
        )
        return cls(env, moved, folder, stores, command)

    @cached_property
    def total(self) -> int:
        """Points in all slices."""
        return sum(int(np.prod(store.shape)) for store in self.stores)

    def done(self) -> int:
        """Count the points that are on disk."""
        return sum(int((store.status() > 0).sum()) for store in self.stores)

    def announce(self, console: Console) -> None:
        """Say what is left to compute and what that costs."""
        left, env, kind = self.total - self.done(), self.env, "episodes with gradients" if self._grad else "episodes"
        console.print(f"{env.name} · {env.fidelity.name} · {env.device} · {self.folder}", markup=False)
        if not left:
            console.print(f"all {self.total} {kind} of {len(self.stores)} slices are there already")
            return
        with console.status(f"{env.name}: preparing (kernels are compiled once, then kept)"):
            seconds, memory = self.cost()
        kept = f", {self.total - left} are there already" if left < self.total else ""
        slices = f"{len(self.stores)} slices" if len(self.stores) > 1 else "one slice"
        console.print(
            f"{left} {kind} of {slices} to compute{kept}: about {duration(seconds)}, {size(memory)} of memory"
        )

    def run(self, console: Console) -> dict[str, Any]:
        """Sample what is missing, film it, write and return the summary."""
        start, resumed = time.monotonic(), self.done()
        drawn = self.sampled(console)
        from ..landscapes.draw.figures.sweep import save_films
        from ..landscapes.draw.recordings.sweep import save_stream

        with console.status("drawing"):
            save_films(drawn, self.folder / FILM, self.folder / GIF)
            save_stream(drawn, self.folder / STREAM)
        return self._summarise(drawn, resumed, time.monotonic() - start)

    def sampled(self, console: Console) -> Sweep:
        """Sample what is missing, and return what there is to draw."""
        slices = self._sample(console)
        from ..landscapes.draw.figures.sweep import Sweep

        return Sweep(self.moved.label, self.moved.values, self.moved.slices(slices))

    def kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{self.done()} of {self.total} points are kept in {self.folder}"

    def farewell(self, console: Console) -> None:
        """Say what is kept of a sweep that was stopped, and how to go on."""
        said = f"stopped: {self.kept()}; the same command goes on from there: {self.command}"
        console.print(said, markup=False)

    @property
    def _grad(self) -> bool:
        return self.stores[0].grad

    def cost(self) -> tuple[float, int]:
        """Return seconds and bytes that what is left should take, by points of the last slice not finished."""
        from ..jobs import slice as job

        pending = {number: int((store.status() == 0).sum()) for number, store in enumerate(self.stores)}
        work = {number: self.moved.env_at(number).work().count * count for number, count in pending.items() if count}
        if not work:
            return 0.0, 0
        last = max(work)
        plane, store = self.moved.planes[last], self.stores[last]
        env, how = self.moved.env_at(last), (store, _never_drawn, "", self.executor)
        cost = job.SliceJob(env, plane, self.folder, *how, recipe(env)).cost()
        return cost.seconds * sum(work.values()) / work[last], cost.memory

    def _sample(self, console: Console) -> list[xr.Dataset]:
        from ..landscapes.objective import Status
        from ..landscapes.sampling.fill import sample

        columns = (Described(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        sampled: list[xr.Dataset] = []
        with Progress(*columns, TextColumn("left"), TimeRemainingColumn(), console=console) as bar:
            task, finished, failed = bar.add_task("episodes", total=self.total), 0, 0

            def follow(now: Sampled) -> None:
                here = failed + now.done - now.statuses.get(Status.OK, 0)
                said = f"slice {len(sampled) + 1} of {len(self.stores)}" + (f", {here} failed" if here else "")
                bar.update(task, completed=finished + now.done, description=said)

            for number, (plane, store) in enumerate(zip(self.moved.planes, self.stores, strict=True)):
                env = self.moved.env_at(number)
                how: dict[str, Any] = {"executor": self.executor, "made": recipe(env)}
                dataset = sample(env, plane, store, grad=store.grad, progress=follow, **how)
                finished += dataset["status"].size
                failed += int((dataset["status"] != Status.OK).sum())
                sampled.append(dataset)
        return sampled

    def _summarise(self, drawn: Sweep, resumed: int, seconds: float) -> dict[str, Any]:
        identity = self.stores[0].identity
        frames = [_frame(value, dataset) for value, dataset in zip(drawn.values, drawn.slices, strict=True)]
        ends = [end for frame in frames for end in frame["loss"].values() if end is not None]
        summary: dict[str, Any] = {
            "env": self.env.name,
            "dims": list(self.stores[0].plane.names),
            "over": drawn.label,
            **{key: identity[key] for key in ("fidelity", "device", "options")},
            "resolution": list(self.stores[0].plane.resolution),
            "gradients": self._grad,
            "episodes": self.total - resumed,
            "resumed": resumed,
            "seconds": round(seconds, 3),
            "loss": {"lowest": min(ends, default=None), "highest": max(ends, default=None)},
            "frames": frames,
            "command": self.command,
            "files": [*sorted({name.split("/")[0] for name in self.moved.stores}), FILM, GIF, STREAM, SUMMARY],
        }
        write_json(self.folder / SUMMARY, summary)
        tidy(self.folder)
        return summary


def sweep_folder(env: Environment, moved: Moved, over: str, *, grad: bool = True) -> Path:
    """Return a folder of its own for every different sweep, the same for the same one."""
    planes = [plane.record() for plane in moved.planes]
    settings = json.dumps([env.identity(), planes, moved.values, grad], sort_keys=True)
    axes = [str(int(row.nonzero()[0])) for row in moved.planes[0].basis]
    what = over if over in (SMOOTHING, HORIZON) else str(env.space.index(over))
    points = "x".join(map(str, (*planes[0]["resolution"], len(moved.values))))
    parts = ["sweep", env.name, *axes, "over", what, env.fidelity.name, points]
    return Path("out") / "-".join([*parts, hashlib.sha256(settings.encode()).hexdigest()[:6]])


def _check(folder: Path) -> None:
    """Refuse a folder that holds anything but a sweep."""
    slices = {FRAMES, ONLY, filling_path(Path(ONLY)).name}
    present = {file.name for file in visible_files(folder)}
    strange = [file for file in visible_files(folder / FRAMES) if not FRAME.fullmatch(file.name)]
    if strange or present - slices - {FILM, GIF, STREAM, SUMMARY} or (present and not present & slices):
        raise ValueError(f"{folder} holds other files and no sweep; give --out a new or an empty folder")


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


def _never_drawn(dataset: xr.Dataset) -> Figure:
    raise NotImplementedError("a sweep draws all of its slices on one scale")


def _frame(value: float, dataset: xr.Dataset) -> dict[str, Any]:
    from ..jobs.slice import flat_points
    from ..landscapes.objective import Status

    loss, status = dataset["loss"].to_numpy(), dataset["status"].to_numpy()
    ends = [float(np.nanmin(loss)), float(np.nanmax(loss))] if np.isfinite(loss).any() else [None, None]
    return {
        "value": value,
        "loss": {"lowest": ends[0], "highest": ends[1]},
        "status": {kind.name.lower(): int((status == kind).sum()) for kind in Status},
        "flat": flat_points(dataset),
    }


def _outcome(summary: dict[str, Any]) -> str:
    failed = sum(count for frame in summary["frames"] for kind, count in frame["status"].items() if kind != "ok")
    low, high = summary["loss"]["lowest"], summary["loss"]["highest"]
    losses = "no finite loss" if low is None else f"losses from {low:.4g} to {high:.4g}"
    failures = f"; {failed} failed" if failed else ""
    done = f"{summary['episodes']} episodes in {duration(summary['seconds'])}"
    return f"{done}; {len(summary['frames'])} frames; {losses}{failures}"
