"""What a job takes, found out by doing a little of all that it does, in a folder that is thrown away."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .console import picture_of, provenance_of
from .sweep_report import Job as SweepJob
from .swept import SMOOTHING, moved

if TYPE_CHECKING:
    from .envs.base import Environment
    from .landscapes.plane import Plane
    from .landscapes.rehearsal import Room

HERE = "measured here, now"
FEW, MORE = 2, 8  # frames of which films are made, to see what each frame takes
SUMMARY = 1000  # bytes of a slice's summary, about


@dataclass(frozen=True)
class Plan:
    """Say what a job takes, in seconds, bytes, files and folders.

    `start` is what passes until the first episode that counts. `memory` is of the host, `gpu` of the device. `disk` is
    what results take, `filling` what the tiles of a slice take until it is finished. `rate` says where the seconds of
    an episode are from.
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

    def wall(self, workers: int) -> float:
        """Return seconds from start to end where each of `workers` has a device such as this; one of them draws."""
        share = math.ceil(self.batches / workers) / self.batches
        return self.start + share * (self.simulating + self.writing) + self.drawing

    def record(self, workers: int) -> dict[str, Any]:
        """Return all of it as plain JSON."""
        seconds = {name: getattr(self, name) for name in ("start", "simulating", "writing", "drawing")}
        return {
            **{"episodes": self.episodes, "batches": self.batches, "workers": workers, "wall": self.wall(workers)},
            **{"seconds": seconds, "device_hours": self.simulating / 3600, "rate": self.rate},
            "memory": {"host": self.memory, "device": self.gpu},
            "disk": {**asdict(self.disk), "filling": asdict(self.filling)},
        }


def of_slice(env: Environment, plane: Plane, folder: Path, *, grad: bool, began: float) -> Plan:
    """Plan a slice whose command would have begun at `began` on `time.perf_counter`'s clock."""
    from .landscapes.job import Job, peak_memory
    from .landscapes.rehearsal import Alike, Room, drawn, pictures, stored

    job = Job.open(
        env, plane, folder, picture_of(env, plane),
        identity=env.identity(), provenance=provenance_of(env, ""), grad=grad,
    )  # fmt: skip
    cost = job.cost()
    start, memory = time.perf_counter() - began, cost.memory - peak_memory()
    alike = Alike.of(env, job.store, cost.seconds / cost.episodes)
    kept = stored(alike, job.store)
    loading, once = drawn(lambda: job._save(alike.dataset(job.store)), alike)
    batches = -(-cost.episodes // env.preferred_batch)
    count = pictures(job.store, batches, cost.seconds + kept.seconds, once)
    extra = SUMMARY + sum(file.stat().st_size for file in folder.iterdir() if file.is_file())
    return Plan(
        cost.episodes, batches, start, cost.seconds, kept.seconds, loading + count * once, memory + peak_memory(),
        _gpu(env), Room(kept.finished.bytes + extra, kept.finished.files + 2), kept.filling,
    )  # fmt: skip


def of_sweep(
    env: Environment,
    plane: Plane,
    folder: Path,
    over: str,
    frames: int,
    made: Callable[..., Environment],
    *,
    grad: bool,
    began: float,
) -> Plan:
    """Plan a sweep."""
    swept = moved(over, env, plane, frames, made)
    job = SweepJob.open(env, swept, folder, command="", grad=grad and over != SMOOTHING)
    seconds, memory = job.cost()
    start, last = time.perf_counter() - began, len(job.stores) - 1
    from .landscapes.job import peak_memory
    from .landscapes.rehearsal import Alike, Room, stored

    memory -= peak_memory()
    alike = Alike.of(swept.env_at(last), job.stores[last], seconds / job.total)
    kept = stored(alike, job.stores[last])
    drawing, films = _filming(job, seconds / job.total, folder / "films", frames)
    count, batches = len(job.stores), sum(-(-math.prod(s.shape) // env.preferred_batch) for s in job.stores)
    extra = films + SUMMARY + 250 * frames
    return Plan(
        job.total, batches, start, seconds, count * kept.seconds, drawing, memory + peak_memory(), _gpu(env),
        Room(count * kept.finished.bytes + extra, count * kept.finished.files + 5), kept.filling,
    )  # fmt: skip


def _filming(job: SweepJob, seconds_each: float, folder: Path, frames: int) -> tuple[float, int]:
    """Return seconds and bytes of a sweep's films, by films of a few frames of slices that are like its own."""
    from .landscapes.draw.sweep import Sweep, save_films
    from .landscapes.draw.sweep_stream import save_stream
    from .landscapes.rehearsal import Alike, drawn

    folder.mkdir()
    most, last = min(MORE, max(frames, FEW + 1)), len(job.stores) - 1
    shown = [round(at * last / (most - 1)) for at in range(most)]
    alike = {at: Alike.of(job.moved.env_at(at), job.stores[at], most * seconds_each) for at in set(shown)}
    datasets = [alike[at].dataset(job.stores[at]) for at in shown]

    def film(count: int) -> None:
        sweep = Sweep(job.moved.label, job.moved.values[:count], datasets[:count])
        save_films(sweep, folder / "sweep.mp4", folder / "sweep.gif")
        save_stream(sweep, folder / "sweep.rrd")

    loading, few = drawn(partial(film, FEW))
    small, began = _bytes(folder), time.perf_counter()
    film(most)
    more, grown = time.perf_counter() - began, (frames - FEW) / (most - FEW)
    return loading + few + grown * (more - few), round(small + grown * (_bytes(folder) - small))


def _bytes(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.iterdir())


def _gpu(env: Environment) -> int:
    return env.memory() * env.preferred_batch if env.device == "cuda" else 0
