"""A sweep to sample into a folder, slice by slice, and to film: what it will cost, its films, its summary."""

from __future__ import annotations

import json
import math
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from ..landscapes.capacity import BLOCK, Need, require, size
from ..landscapes.cost import FRAME_SECONDS, PICTURE_SECONDS, duration
from ..landscapes.identity import BOXED, record_cut, with_stride
from ..landscapes.lattice import check_gradients
from ..landscapes.objective import BoxedObjective, Objective, failed
from ..landscapes.plain import plain_name
from ..landscapes.sampling.fill import Progress, sample
from ..landscapes.storage.arrays import count_statuses
from ..landscapes.storage.arrays import need_of as slice_need
from ..landscapes.storage.files import discard, refuse_others, visible_files
from ..landscapes.storage.paths import check_replaceable, slice_exists, slice_places
from ..landscapes.storage.store import SliceStore
from .folder import ROOT, SWEEP, folder_named
from .job import SummaryJob
from .scene import first_line, provenance
from .slice import (
    MAX_NAME_LETTERS,
    SliceCost,
    estimate_cost,
    flat_points,
    kind_of,
    range_of,
    say_range,
    slice_work,
)
from .watch import PREPARING, Watch, Work
from .workers import recipe

if TYPE_CHECKING:
    from torch import Tensor

    from ..envs.base import Environment
    from ..landscapes.draw.figures.sweep import Sweep
    from ..landscapes.plane import Plane

FRAMES, ONLY, FILM, GIF, STREAM, SUMMARY = SWEEP.files
FRAME = re.compile(r"\d{3,}\.(?:filling|zarr|zarr\.zip)")  # what the folder of a sweep's slices holds
SMOOTHING = "smoothing"
MAX_SMOOTHING = 0.25  # the widest Gaussian's standard deviation, as a fraction of the box's sides
PARALLEL_TOLERANCE = 1e-9  # of a parameter's unit: as near as rounding lets a point on a plane be to it
HORIZON = "horizon"  # a scene option: the episode's duration as a multiple of the scene's own
STORE_MEMORY, STORE_BLOCKS = 100e3, 4  # of a slice without samples: bytes of its arrays' records, and blocks of disk


@dataclass(frozen=True)
class FrameSummary:
    """Record a frame: the value of the swept quantity, the range of its losses, and its points by status."""

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
    """Record the cost of a sweep and the content of each frame, as in its `summary.json`."""

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
class SweepJob(SummaryJob[SweepSummary]):
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
        """Continue the sweep of an environment in `out`, by default a folder named after it, or begin it there.

        Gradients are at every so many samples along each axis, 0 for none; of smoothed losses there are none. With a
        `cut`, how it was cut along directions, it is boxed, but for those of weights. One that was begun continues
        along its own directions: on a GPU they come out a little different each time. Raises ValueError for what cannot
        be swept or has no room, and where the folder holds something else or another sweep.
        """
        if plane.rank != 2 or frames < 2:
            dims = ", ".join(plane.names)
            raise ValueError(f"sweep takes two dims and at least two frames; got {dims} and {frames} frames")
        gradients = check_gradients(gradients, plane, refined=False)
        gradients = 0 if over == SMOOTHING else gradients
        refuse_too_large(plane, frames, out or ROOT, grad=gradients > 0, over=over)
        motion = Motion.of(env, plane, over, frames)
        folder = out or sweep_folder(env, motion, over, gradients=gradients, cut=cut)
        check_folder(folder)
        if force:
            _clear(folder)
        elif cut:
            motion = Motion.of(env, _along_kept(folder / motion.stores[0], plane, cut), over, frames)
        about = provenance(env, command)
        identities = (_identity(motion.env_at(number), gradients, cut) for number in range(len(motion.stores)))
        stores = tuple(
            SliceStore.open_or_create(
                folder / name, plane, env.space, identity=identity, provenance=about, grad=gradients > 0
            )
            for name, plane, identity in zip(motion.stores, motion.planes, identities, strict=True)
        )
        return cls(
            env=env, motion=motion, folder=folder, stores=stores, command=command, boxed=BOXED in record_cut(cut)
        )

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
            every = store.every if store.grad else 0
            yield slice_work(self.motion.env_at(number), plane.resolution, every, between=False)

    def compute(self, watch: Watch) -> SweepSummary:
        """Sample what is missing, film it and return the summary."""
        self._announce(watch)
        start, resumed = time.monotonic(), self.done()
        drawn = self.sample(watch)
        with watch.busy("drawing"):
            self._film(drawn)
        return self._summary(drawn, resumed, time.monotonic() - start)

    def sample(self, watch: Watch | None = None) -> Sweep:
        """Sample what is missing, and return what there is to draw.

        Raises StoreMismatchError where the scene gives other numbers than a slice holds.
        """
        slices, finished, lost, whole = list[xr.Dataset](), 0, 0, len(self.stores)
        with (watch or Watch()).progress(self.total) as advance:
            for number in range(whole):

                def follow(now: Progress, number: int = number + 1, finished: int = finished, lost: int = lost) -> None:
                    lost += sum(count for status, count in now.statuses.items() if failed(status))
                    said = f", {lost} failed" if lost else ""
                    advance(finished + now.done, f"slice {number} of {whole}{said}")

                slices.append(dataset := self._sample(number, follow))
                finished += dataset["status"].size
                lost += int(failed(dataset["status"]).sum())
        from ..landscapes.draw.figures.sweep import Sweep

        moved = self.motion
        return Sweep(moved.label, moved.values, moved.slices(slices), moved.logarithmic)

    def kept(self) -> str:
        """Say how much of it is on disk."""
        return f"{self.done()} of {self.total} points are kept in {self.folder}"

    def _announce(self, watch: Watch) -> None:
        """Say what is left to compute and what that costs."""
        left, env, kind = self.total - self.done(), self.env, kind_of(self.stores[0])
        watch.note(first_line(env.identity(), self.folder))
        if not left:
            watch.note(f"all {self.total} {kind} of {len(self.stores)} slices are done already")
            return
        with watch.busy(f"{env.name}: {PREPARING}"):
            cost = self.cost()
        kept = f", {self.total - left} are done already" if left < self.total else ""
        slices = f"{len(self.stores)} slices" if len(self.stores) > 1 else "one slice"
        seconds = cost.seconds + PICTURE_SECONDS + FRAME_SECONDS * len(self.motion.values)
        takes = f"about {duration(seconds)} with the film, {size(cost.memory)} of memory"
        watch.announce(f"{left} {kind} of {slices} to compute{kept}: {takes}", seconds)

    def _sample(self, number: int, follow: Callable[[Progress], None]) -> xr.Dataset:
        (objective, made), store = self._sampled(number), self.stores[number]
        return sample(
            objective, self.motion.planes[number], store, progress=follow, gradients=int(store.grad),
            executor=self.executor, made=made,
        )  # fmt: skip

    def _sampled(self, number: int) -> tuple[Objective, Callable[[], Objective] | None]:
        """Return what is sampled on a plane, and how workers make it, None where they are sent it."""
        env = self.motion.env_at(number)
        return (BoxedObjective(env), None) if self.boxed else (env, recipe(env))

    def _film(self, drawn: Sweep) -> None:
        from ..landscapes.draw.figures.sweep import save_films
        from ..landscapes.draw.recordings.runs import save_sweep

        save_films(drawn, self.folder / FILM, self.folder / GIF)
        save_sweep(drawn, self.folder / STREAM)

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


def _identity(env: Environment, gradients: int, cut: Mapping[str, Any] | None) -> dict[str, Any]:
    return with_stride(env.identity(), gradients) | record_cut(cut)


def sweep_folder(
    env: Environment, motion: Motion, over: int | str, *, gradients: int = 1, cut: Mapping[str, Any] | None = None
) -> Path:
    """Return the default folder of a sweep, unique for its settings and always the same for them."""
    planes = [plane.record() for plane in motion.planes]
    what = over if over in (SMOOTHING, HORIZON) else env.space.index(over)
    points = "x".join(map(str, (*planes[0]["resolution"], len(motion.values))))
    if cut is None:
        axes: list[Any] = [int(row.nonzero()[0]) for row in motion.planes[0].basis]
        where: list[Any] = [planes]
    else:  # directions may differ by rounding
        axes, where = [plain_name(cut["along"])[:MAX_NAME_LETTERS]], [dict(cut), points]
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
    """Raise ValueError if a folder contains anything but a sweep; films without a slice do not count as one."""
    held = visible_files(folder)
    begun = [file for file in held if file.name in (FRAMES, *(place.name for place in slice_places(Path(ONLY))))]
    strange = [file for file in visible_files(folder / FRAMES) if not FRAME.fullmatch(file.name)]
    refuse_others(folder, strange if begun else held, SWEEP.kind)
    SWEEP.check(folder, begun)


def _clear(folder: Path) -> None:
    """Remove the slices of a sweep, and what was made of them."""
    places = [*visible_files(folder / FRAMES), *slice_places(folder / ONLY)]
    stores = [store for store in places if store.exists()]
    for store in stores:
        check_replaceable(store)
    for store in stores:
        discard(store)
    for name in (FILM, GIF, STREAM, SUMMARY):
        (folder / name).unlink(missing_ok=True)


@dataclass(frozen=True)
class Motion:
    """Record the swept quantity `label` and its `values`: frames show `slices` of the samples on `planes`.

    `env_at` makes the environment of a plane, by its number. A `logarithmic` quantity moves by equal ratios.
    """

    label: str
    values: tuple[float, ...]
    planes: tuple[Plane, ...]
    env_at: Callable[[int], Environment]
    slices: Callable[[Sequence[xr.Dataset]], Sequence[xr.Dataset]] = list
    logarithmic: bool = False

    @classmethod
    def of(cls, env: Environment, plane: Plane, over: int | str, frames: int) -> Motion:
        """Return what `over` names: a parameter, horizon or smoothing.

        Raises ValueError for a parameter that the plane varies, and for a horizon that the scene does not have.
        """
        if over == SMOOTHING:
            return _smoothing(env, plane, frames)
        return _horizon(env, plane, frames) if over == HORIZON else _parameter(over, env, plane, frames)

    @property
    def stores(self) -> tuple[str, ...]:
        """Where in the sweep's folder the slice of each plane is."""
        if len(self.planes) == 1:
            return (ONLY,)
        return tuple(f"{FRAMES}/{number:03d}.zarr.zip" for number in range(len(self.planes)))


def refuse_too_large(plane: Plane, frames: int, folder: Path, *, grad: bool, over: int | str) -> None:
    """Refuse a sweep of which a single frame is larger than this machine, or all of them are.

    Raises TooLargeError, which is a ValueError.
    """

    def need(side: int, count: int) -> Need:
        return need_of((side,) * plane.rank, plane.dim, count, grad=grad, over=over)

    side = max(plane.resolution)
    require("resolution", side, lambda points: need(points, 1), folder)
    require("frames", frames, lambda count: need(side, count), folder)


def need_of(shape: tuple[int, ...], dim: int, frames: int, *, grad: bool, over: int | str) -> Need:
    """Return what sampling a sweep and filming it takes: every frame's slice is stored, of a smoothing's only one."""
    slices, samples = 1 if over == SMOOTHING else frames, math.prod(shape)
    array, one = samples * (9 + 8 * dim * grad), slice_need(shape, dim, grad=grad)
    memory = one.memory + slices * (STORE_MEMORY + array) + frames * 9.0 * samples
    return Need(memory, one.disk + slices * (STORE_BLOCKS * BLOCK + float(array)))


def _parameter(name: int | str, env: Environment, plane: Plane, frames: int) -> Motion:
    """Move a parameter from one of its bounds to the other."""
    import torch

    from ..landscapes.space import LOG10, to_values

    number = env.space.index(name)
    if _holds(plane, number):
        raise ValueError(
            f"sweep moves a third parameter, {HORIZON} or {SMOOTHING}; got --over {name}, which the slice itself varies"
        )
    space = env.space
    places = torch.linspace(float(space.lower[number]), float(space.upper[number]), frames, dtype=torch.float64)
    planes = tuple(replace(plane, origin=_with(plane.origin, number, place)) for place in places.tolist())
    scale = space.scales[number]
    values = tuple(to_values(places[:, None], [scale])[:, 0].tolist())
    return Motion(space.labels[number], values, planes, lambda _: env, logarithmic=scale == LOG10)


def _horizon(env: Environment, plane: Plane, frames: int) -> Motion:
    """End the episode later and later, up to the scene's own end."""
    whole = env.horizon
    if whole is None:
        raise ValueError(
            f"{env.name} has no {HORIZON} to sweep over: no setting controls how long an episode is (for your own "
            f"function, horizon= names one); sweep a third parameter or {SMOOTHING}"
        )
    if env.horizon_option == HORIZON and whole != 1 and env.model_version:
        raise ValueError(f"--over {HORIZON} changes this option itself; leave out --set {HORIZON}=...")
    shares = [(frame + 1) / frames for frame in range(frames)]
    values = tuple(100 * share for share in shares)
    return Motion(
        "share of the scene's duration [%]", values, (plane,) * frames,
        lambda number: env.with_horizon(shares[number] * whole),
    )  # fmt: skip


def _smoothing(env: Environment, plane: Plane, frames: int) -> Motion:
    """Average one slice over wider and wider Gaussians."""
    widths = np.linspace(0, MAX_SMOOTHING, frames).tolist()

    def slices(sampled: Sequence[xr.Dataset]) -> list[xr.Dataset]:
        from ..landscapes.smoothing import smooth

        return [smooth(sampled[0], width) for width in widths]

    label = "smoothing width [% of the box's sides]"
    return Motion(label, tuple(100 * width for width in widths), (plane,), lambda _: env, slices)


def _holds(plane: Plane, number: int) -> bool:
    """Say whether moving a parameter leads from a plane to itself."""
    import torch

    step = torch.zeros(plane.dim, dtype=torch.float64)
    step[number] = 1.0
    return bool(plane.distance(plane.origin + step) < PARALLEL_TOLERANCE)


def _with(origin: Tensor, number: int, value: float) -> Tensor:
    origin = origin.clone()
    origin[number] = value
    return origin
