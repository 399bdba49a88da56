"""What a slice takes beside its episodes, measured before it is computed: writing it, drawing it, room on the disk.

A few true evaluations are repeated, each time a little different so that they compress as results do, and go the way
that a slice goes, into a store that is thrown away.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from ..landscapes.objective import Evaluation, Objective, ObjectiveWrapper
from ..landscapes.sampling.fill import Progress, sample
from ..landscapes.storage.arrays import write_finished
from ..landscapes.storage.store import SliceStore
from .slice import SOON, first_points, pause_after

WRITING = 2.0  # seconds that a rehearsal goes on writing tiles
SEEN = 1.0  # seconds for the evaluations that are repeated
JITTER = 1e-3  # by how much, relatively, a repeated value differs from the true one
BLOCK = 1024  # points that are made up at a time


class Replica(ObjectiveWrapper):
    """An objective that repeats the evaluations of another, each where it is nearest, slightly altered.

    `rows` true evaluations are made, at the first points of `store`, which spread over all of it. `seconds` were spent
    on repeating them while tiles were written, which a job does not spend.
    """

    seconds = 0.0

    def __init__(self, objective: Objective, store: SliceStore, rows: int) -> None:
        super().__init__(objective)
        x = first_points(store, store.tiles(), rows)
        self._plane = store.plane
        self._tree = cKDTree(self._place(x))
        self._seen = objective.evaluate(x, grad=store.grad)
        loss = self._seen.loss.detach().cpu().nan_to_num().double()
        self._single = bool(torch.equal(loss, loss.float().double()))  # then numbers compress better
        self._random = torch.Generator().manual_seed(0)

    @classmethod
    def of(cls, objective: Objective, store: SliceStore, seconds_each: float) -> Replica:
        """Make as many true evaluations as fit into a moment and a batch, at least one."""
        rows = min(int(SEEN / max(seconds_each, 1e-9)), objective.preferred_batch)
        return cls(objective, store, max(1, rows))

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return for each row of `x` what was found nearest to it."""
        began = time.perf_counter()
        repeated = self._repeat(x, grad=grad)
        self.seconds += time.perf_counter() - began
        return repeated

    def dataset(self, store: SliceStore) -> xr.Dataset:
        """Return a slice of the shape of `store` without a gap, with gradients where the store has them."""
        blank = store.dataset()
        grid = np.meshgrid(*(blank[name].to_numpy() for name in store.dims), indexing="ij")[::-1]
        nodes = torch.from_numpy(np.stack([axis.ravel() for axis in grid], axis=1))
        filled = {name: np.empty(one.shape, one.dtype) for name, one in blank.items()}
        for start in range(0, len(nodes), BLOCK):
            rows = slice(start, start + BLOCK)
            said = self._repeat(store.plane.lift(nodes[rows]), grad=store.grad)
            for name, values in filled.items():
                flat = values.reshape(len(nodes), -1)
                flat[rows] = getattr(said, str(name)).reshape(-1, flat.shape[1])
        for axis in range(blank["loss"].ndim if store.grad else 0):
            without = np.arange(blank["loss"].shape[axis]) % store.every > 0
            filled["grad"].swapaxes(0, axis)[without] = np.nan
        return blank.copy(data=filled)

    def _repeat(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        rows = torch.from_numpy(self._tree.query(self._place(x))[1])
        slopes = None if self._seen.grad is None or not grad else self._alter(self._seen.grad[rows])
        return Evaluation(self._alter(self._seen.loss[rows]), slopes, self._seen.status[rows])

    def _place(self, x: Float[Tensor, "batch dim"]) -> NDArray[np.float64]:
        """Return where points are on the plane, which has sides of length 1."""
        plane = self._plane
        return ((plane.project(x) - plane.lower) / (plane.upper - plane.lower)).numpy()

    def _alter(self, values: Tensor) -> Tensor:
        """Return other values; in place, since the memory of a rehearsal is to be that of the job."""
        noise = torch.rand(values.shape, generator=self._random, dtype=torch.float64)
        altered = noise.mul_(JITTER).add_(1).mul_(values.detach().cpu())
        return altered.float().double() if self._single else altered


@dataclass(frozen=True)
class Room:
    """Room on a disk: bytes, and the number of files and folders."""

    bytes: int
    files: int


@dataclass(frozen=True, eq=False)
class Stored:
    """Say what writing a slice takes [s], its room once it is finished, and that of its tiles until then.

    `dataset` is what was written.
    """

    seconds: float
    finished: Room
    filling: Room
    dataset: xr.Dataset


class _Enough(Exception):  # noqa: N818 -- nothing went wrong
    """Stop a rehearsal."""


def store_replica(replica: Replica, store: SliceStore) -> Stored:
    """Fill an empty slice store on disk with a replica's evaluations, or as much of it as `WRITING` seconds allow.

    Raises ValueError for a store in memory.
    """
    path = store.path
    if path is None:
        raise ValueError("a rehearsal needs a store on disk; got one in memory")
    tiles, began = len(store.tiles()), time.perf_counter() - replica.seconds
    before, done, took, total = room_of(store.place or path), 0, 0.0, math.prod(store.shape)

    def follow(now: Progress) -> None:
        nonlocal done, took
        done, took = now.done, time.perf_counter() - replica.seconds - began
        if done == total or (done and took > WRITING):
            raise _Enough

    with contextlib.suppress(_Enough):
        sample(replica, store.plane, store, gradients=int(store.grad), progress=follow)
    after = room_of(store.place or path)
    size, files = (
        round(old + (new - old) * total / done)
        for old, new in ((before.bytes, after.bytes), (before.files, after.files))
    )
    whole, began = replica.dataset(store), time.perf_counter()
    write_finished(path, whole)
    seconds = took * total / done + time.perf_counter() - began
    return Stored(seconds, room_of(path), Room(size, min(files, before.files + 8 * tiles)), whole)


def time_drawing(draw: Callable[[], object]) -> tuple[float, float]:
    """Return seconds of a first drawing beyond those of any other (what it loads), and those of another."""
    took = []
    for _ in range(2):
        began = time.perf_counter()
        draw()
        took.append(time.perf_counter() - began)
    return max(0.0, took[0] - took[1]), took[1]


def count_pictures(levels: int, batches: int, seconds: float, once: float) -> int:
    """Return how often `SliceJob.run` should draw: at the end, and of so many coarse pictures before some."""
    before = 1 + int((seconds - SOON) / (pause_after(once) + once)) if seconds > SOON else 0
    return 1 + min(levels, batches, before)


def room_of(path: Path) -> Room:
    """Return the room of what is in a folder, which itself counts as one of its folders."""
    there = [path, *path.rglob("*")]
    return Room(sum(one.stat().st_size for one in there if one.is_file()), len(there))
