"""What a slice or a sweep will take, found out by doing a little of it in a folder that is thrown away."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from ..landscapes.capacity import TooLargeError
from ..landscapes.identity import with_stride
from ..landscapes.lattice import check_gradients, count_gradients
from .motion import SMOOTHING, Motion, need_of
from .scene import SceneSpec
from .scene import provenance as provenance_of
from .slice import picture_of
from .sweep import SweepJob
from .watch import Watch

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.plane import Plane
    from .rehearsal import Room, Stored

DEVICES = ("auto", "cpu", "cuda")
HERE = "measured here, now"
FEW, MORE = 2, 8  # frames of which films are made, to see what each frame takes
MOST_POINTS, MOST_FRAMES = 128, 24  # of a rehearsal: points along each axis of a plane, and slices of a sweep
SUMMARY = 1000  # bytes of a slice's summary, about


@dataclass(frozen=True)
class Plan:
    """Say what a job takes, in seconds, bytes, files and folders.

    `start` is what passes until the first episode that counts. So many `losses`, at most, are evaluated between the
    samples of a slice, each taken to cost an episode. `memory` is of the host, `gpu` of the device. `disk` is
    what results take, `filling` what the tiles of a slice take until it is finished. `rate` says where the seconds of
    an episode are from. Of the `episodes` so many `gradients` are computed, too.
    """

    episodes: int
    batches: int
    start: float
    simulating: float
    writing: float
    drawing: float
    memory: int
    gpu: int
    disk: Room
    filling: Room
    rate: str = HERE
    losses: int = 0
    gradients: int = 0

    @property
    def between(self) -> float:
        """What looking between the samples takes, at most [s]."""
        return self.losses * self.simulating / self.episodes

    def wall(self, workers: int) -> float:
        """Return seconds from start to end where each of `workers` has a device such as this; one of them draws."""
        share = math.ceil(self.batches / workers) / self.batches
        return self.start + share * (self.simulating + self.writing + self.between) + self.drawing

    @property
    def device_hours(self) -> float:
        """How long a device simulates [h]."""
        return self.simulating / 3600

    def seconds(self) -> dict[str, float]:
        """Return what each part takes [s], by its name."""
        return {name: getattr(self, name) for name in ("start", "simulating", "writing", "drawing", "between")}

    def record(self, workers: int) -> dict[str, Any]:
        """Return all of it as plain JSON."""
        return {
            **{"episodes": self.episodes, "gradients": self.gradients, "batches": self.batches},
            **{"workers": workers, "wall": self.wall(workers)},
            **{"seconds": self.seconds(), "device_hours": self.device_hours, "rate": self.rate},
            "memory": {"host": self.memory, "device": self.gpu},
            "disk": {**asdict(self.disk), "filling": asdict(self.filling)},
        }


@dataclass(frozen=True)
class Forecast:
    """Hold a `plan` and what it is of; fields are called as `landscape plan --json` has them.

    `over` is what a sweep moves, `too_large` why this machine would refuse it, None where it would not.
    """

    env: str
    dims: list[str]
    resolution: list[int]
    fidelity: str
    device: str
    engine: str
    over: str | None
    frames: int
    too_large: str | None
    plan: Plan

    def subject(self) -> dict[str, Any]:
        """Return of what it is, as plain JSON."""
        names = ("env", "dims", "resolution", "fidelity", "device", "engine")
        return {name: getattr(self, name) for name in names}

    def record(self, workers: int) -> dict[str, Any]:
        """Return all of it as plain JSON, for so many workers."""
        about = {"over": self.over, "frames": self.frames, "too_large": self.too_large}
        return {**self.subject(), **about, **self.plan.record(workers)}


@dataclass(frozen=True)
class PlanJob:
    """A slice of a scene, or a sweep `over` something in so many `frames`, to foretell; nothing of it is kept.

    Losses are at all samples of a slice, gradients at every so many along each axis, `gradients`, 0 for none; of a
    sweep they are at all or none. What lies off the box, of one `along` directions, is taken to cost an episode like
    the rest.
    """

    scene: SceneSpec
    dims: Sequence[int | str] | None
    resolution: int
    through: str = "center"
    extent: float | tuple[float, float] | None = None
    gradients: int = 1
    over: str | None = None
    frames: int = 1
    along: str | None = None

    def run(self, watch: Watch | None = None, *, began: float | None = None) -> Forecast:
        """Rehearse it, and foretell what it takes.

        `began` is when its command would have begun, on the clock of `time.perf_counter`; now, by default. For a CUDA
        device that is not here, what `landscape tradeoff` kept of one counts. Raises ValueError for what the scene does
        not have, for gradients that are too far apart, and where nothing is known of the device that is asked for.
        """
        from .cut import cut

        began = time.perf_counter() if began is None else began
        env, device = make_here(self.scene)
        how: dict[str, Any] = {"extent": self.extent, "resolution": self.resolution}
        plane = cut(env, self.dims, self.along, through=self.through, **how)
        check_gradients(self.gradients, plane, refined=False)
        with (watch or Watch()).busy(f"{env.name}: rehearsing {env.fidelity.name} episodes, tiles and pictures"):
            found = self._rehearse(env, plane, began)
        return Forecast(
            env=env.name,
            dims=list(plane.names),
            resolution=list(plane.resolution),
            fidelity=env.fidelity.name,
            device=device,
            engine=env.engine,
            over=self.over,
            frames=self.frames if self.over else 1,
            too_large=self._too_large(plane),
            plan=_elsewhere(found, env, device),
        )

    def _rehearse(self, env: Environment, plane: Plane, began: float) -> Plan:
        with TemporaryDirectory() as folder:
            if self.over is None:
                return plan_slice(env, plane, Path(folder), gradients=self.gradients, began=began)
            how: dict[str, Any] = {"gradients": self.gradients, "began": began}
            return plan_sweep(env, plane, Path(folder), self.over, self.frames, **how)

    def _too_large(self, plane: Plane) -> str | None:
        """Return why this machine would refuse what is planned, None where it would not."""
        from ..landscapes.storage.arrays import refuse_too_large as refuse_slice
        from .motion import refuse_too_large as refuse_sweep

        try:
            if self.over is None:
                refuse_slice(plane, Path(), grad=self.gradients > 0)
            else:
                refuse_sweep(plane, self.frames, Path(), grad=self.gradients > 0, over=self.over)
        except TooLargeError as error:
            return str(error)
        return None


def make_here(scene: SceneSpec) -> tuple[Environment, str]:
    """Make an environment, on the CPU where the CUDA device that is asked for is not here; return that device too.

    Raises ValueError for what the scene does not have.
    """
    from ..envs.engines.runtime import cuda_available

    kind = scene.kind
    if scene.device not in DEVICES:
        raise ValueError(f"--device takes {', '.join(DEVICES)}; got {scene.device!r}")
    if scene.device == "cuda" and "cuda" in kind.devices and not cuda_available():
        return replace(scene, device="cpu").make(), "cuda"
    env = scene.make()
    return env, env.device


def _elsewhere(found: Plan, env: Environment, device: str) -> Plan:
    """Return a plan with the rate of a device that is not here, as `landscape tradeoff` measured it there."""
    if device == env.device:
        return found
    from .tolerance import find_variant

    variant, path = find_variant(env, device)
    seconds = variant.comparison.seconds
    each = {True: seconds.with_gradient, False: seconds.forward}
    counts = {True: found.gradients, False: found.episodes - found.gradients}
    return replace(
        found,
        simulating=sum(n * each[grad] for grad, n in counts.items() if n),
        batches=_count_batches(counts.values(), max(1, variant.comparison.batch)),
        gpu=variant.memory or 0,
        rate=f"kept by `landscape tradeoff` in {path}; writing and drawing {found.rate}",
    )


def _count_batches(counts: Iterable[int], size: int) -> int:
    """Count the batches of points with gradients and of those without, which are evaluated apart."""
    return sum(-(-count // size) for count in counts)


def plan_slice(env: Environment, plane: Plane, folder: Path, *, gradients: int, began: float) -> Plan:
    """Plan a slice with gradients at every so many samples along each axis, 0 for none.

    Its command would have begun at `began` on `time.perf_counter`'s clock. Of a large one a smaller one is rehearsed.
    """
    from ..landscapes.measures.unresolved import probes
    from .rehearsal import Replica, Room, count_pictures, store_replica, time_drawing
    from .slice import SliceJob, peak_memory

    little, grad = _little(plane), gradients > 0
    grown = Growth.of(little, plane, grad=grad)
    job = SliceJob.open(
        env, little, folder, picture_of(env, little),
        identity=with_stride(env.identity(), gradients), provenance=provenance_of(env, ""), grad=grad,
    )  # fmt: skip
    cost = job.cost()
    start, memory = time.perf_counter() - began, cost.memory - peak_memory() + grown.memory
    replica = Replica.of(env, job.store, cost.seconds / cost.episodes)
    kept = store_replica(replica, job.store)
    loading, once = time_drawing(lambda: job._save(kept.dataset))
    episodes, having = math.prod(plane.resolution), count_gradients(plane.resolution, gradients)
    counts = {True: having, False: episodes - having}
    simulating, writing = sum(counts[one] * each for one, each in cost.each.items()), grown.points * kept.seconds
    batches = _count_batches(counts.values(), env.preferred_batch)
    count = count_pictures(grown.levels, batches, simulating + writing, once)
    extra = Room(SUMMARY + sum(file.stat().st_size for file in folder.iterdir() if file.is_file()), 2)
    return Plan(
        episodes, batches, start, simulating, writing, loading + count * once, memory + peak_memory(), _gpu(env),
        grown.finished_room(kept, 1, extra), grown.filling_room(kept), _rate(little, plane),
        probes(episodes, grad=gradients == 1), having,
    )  # fmt: skip


def plan_sweep(
    env: Environment,
    plane: Plane,
    folder: Path,
    over: str,
    frames: int,
    *,
    gradients: int,
    began: float,
) -> Plan:
    """Plan a sweep; of a long one fewer frames are rehearsed, and of large slices smaller ones."""
    little, gradients = _little(plane), 0 if over == SMOOTHING else gradients
    grad, whole, having = gradients > 0, math.prod(plane.resolution), count_gradients(plane.resolution, gradients)
    grown = Growth.of(little, plane, grad=grad)
    motion = Motion.of(env, little, over, min(frames, MOST_FRAMES))
    job = SweepJob.open(env, motion, folder, command="", gradients=gradients)
    cost = job.cost()
    seconds, memory = cost.seconds, cost.memory
    start, last = time.perf_counter() - began, len(job.stores) - 1
    from .rehearsal import Replica, Room, store_replica
    from .slice import peak_memory

    memory -= peak_memory()
    replica = Replica.of(motion.env_at(last), job.stores[last], seconds / job.total)
    kept = store_replica(replica, job.stores[last])
    drawing, films = _filming(job, seconds / job.total, folder / "films", frames)
    count = frames if len(job.stores) > 1 else 1
    held = need_of(plane.resolution, plane.dim, frames, grad=grad, over=over).memory
    held -= need_of(little.resolution, plane.dim, 0, grad=grad, over=over).memory
    return Plan(
        count * whole, count * _count_batches((having, whole - having), env.preferred_batch), start,
        seconds * count * whole / job.total,
        count * grown.points * kept.seconds, drawing, round(memory + held) + peak_memory(), _gpu(env),
        grown.finished_room(kept, count, Room(films + SUMMARY + 250 * frames, 5)), grown.filling_room(kept),
        _rate(little, plane), gradients=count * having,
    )  # fmt: skip


@dataclass(frozen=True)
class Growth:
    """Say how much larger a slice is than the one that is rehearsed for it.

    It has so many times as many `points` and `tiles`, so many more `chunks` once it is finished and bytes of `memory`,
    and `levels` of coarse pictures.
    """

    points: float
    tiles: float
    chunks: int
    memory: int
    levels: int

    @classmethod
    def of(cls, little: Plane, plane: Plane, *, grad: bool) -> Growth:
        """Compare two planes."""
        from ..landscapes.storage.arrays import need_of as slice_need

        points, tiles = (math.prod(large) / math.prod(small) for large, small in (
            (plane.resolution, little.resolution), (_tiles(plane), _tiles(little))
        ))  # fmt: skip
        less, more = (slice_need(one.resolution, one.dim, grad=grad).memory for one in (little, plane))
        chunks = _chunks(plane, grad=grad) - _chunks(little, grad=grad)
        return cls(points, tiles, chunks, round(more - less), max(_tiles(plane)) - 1)

    def finished_room(self, kept: Stored, slices: int, extra: Room) -> Room:
        """Return the room of so many slices, and of what else there is."""
        one = round(self.points * kept.finished.bytes), kept.finished.files + self.chunks
        return replace(extra, bytes=slices * one[0] + extra.bytes, files=slices * one[1] + extra.files)

    def filling_room(self, kept: Stored) -> Room:
        """Return the room of a slice's tiles."""
        room = kept.filling
        return replace(room, bytes=round(self.points * room.bytes), files=round(self.tiles * room.files))


def _little(plane: Plane) -> Plane:
    """Return a plane with no more points than a rehearsal takes."""
    most = MOST_POINTS if plane.rank == 2 else MOST_POINTS**2
    if max(plane.resolution) <= most:
        return plane
    return replace(plane, resolution=tuple(min(points, most) for points in plane.resolution))


def _tiles(plane: Plane) -> list[int]:
    """Return how many tiles there are along each axis."""
    from ..landscapes.storage.tiles import tile_side

    return [-(-points // tile_side(points)) for points in plane.resolution]


def _chunks(plane: Plane, *, grad: bool) -> int:
    """Return how many files hold the arrays of a finished slice."""
    from ..landscapes.storage.layout import analysis_chunks

    *sides, deep = analysis_chunks(plane.resolution, plane.dim)
    flat = math.prod(-(-points // side) for points, side in zip(plane.resolution, sides, strict=True))
    return flat * (2 + grad * -(-plane.dim // deep))


def _rate(little: Plane, plane: Plane) -> str:
    return HERE if little is plane else f"{HERE}, on {' x '.join(map(str, little.resolution))} points"


def _filming(job: SweepJob, seconds_each: float, folder: Path, frames: int) -> tuple[float, int]:
    """Return seconds and bytes of a sweep's films, by films of a few frames of slices that are like its own."""
    from ..landscapes.draw.figures.sweep import Sweep, save_films
    from ..landscapes.draw.recordings.sweep import save_stream
    from .rehearsal import Replica, time_drawing

    folder.mkdir()
    most, last = min(MORE, max(frames, FEW + 1)), len(job.stores) - 1
    shown = [round(at * last / (most - 1)) for at in range(most)]
    replicas = {at: Replica.of(job.motion.env_at(at), job.stores[at], most * seconds_each) for at in set(shown)}
    datasets = [replicas[at].dataset(job.stores[at]) for at in shown]
    every = job.motion.values  # which may share a slice
    values = [every[round(at * (len(every) - 1) / (most - 1))] for at in range(most)]

    def film(count: int) -> None:
        at = range(most) if count == most else (0, most - 1)  # a few of them are the first and the last
        moved, chosen = job.motion, [datasets[one] for one in at]
        sweep = Sweep(moved.label, tuple(values[one] for one in at), chosen, moved.logarithmic)
        save_films(sweep, folder / "sweep.mp4", folder / "sweep.gif")
        save_stream(sweep, folder / "sweep.rrd")

    loading, few = time_drawing(partial(film, FEW))
    small, began = _bytes(folder), time.perf_counter()
    film(most)
    more, grown = time.perf_counter() - began, (frames - FEW) / (most - FEW)
    return loading + few + grown * (more - few), round(small + grown * (_bytes(folder) - small))


def _bytes(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.iterdir())


def _gpu(env: Environment) -> int:
    return env.memory() * env.preferred_batch if env.device == "cuda" else 0
