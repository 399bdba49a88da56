"""Tiles are filled in this process, or by an executor's workers, which write them to the store they share.

What travels is small: to a worker how the objective is made, where the store is and which tiles; back which tiles are
finished and how their points ended. A tile is the same whoever writes it, so a batch may be done twice and harms none.
"""

from __future__ import annotations

import math
import pickle
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import cloudpickle
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..identity import StoreError, check_identity
from ..objective import Evaluation, Objective, ObjectiveWrapper, Status
from ..storage.arrays import Tile
from ..storage.paths import place_of
from ..storage.store import SliceStore
from .memory import MemoryBound, free_memory

T = TypeVar("T")
POLL = 1.0  # seconds between looks at the workers
WITHOUT_WORKERS = 60.0  # seconds without any worker after which they are given up
LATE = 120.0  # seconds in which what a worker wrote must appear here: NFS remembers for up to 60 what was not there


class WorkersLostError(OSError):
    """The workers of an executor, or their scheduler, are gone."""


@dataclass(frozen=True)
class FilledTile:
    """A finished tile: how its points ended, what to warn of, and what the first point that raised said."""

    tile: Tile
    statuses: Mapping[Status, int]
    notes: tuple[str, ...] = ()
    error: str = ""


@dataclass(frozen=True, eq=False)
class TileWriter:
    """An objective, and the store that takes its evaluations.

    Sent to another process, it is the same objective made there by `made`, once, and kept, and the same store opened
    there. Without `made` the objective itself is pickled.
    """

    objective: MemoryBound
    store: SliceStore
    made: Callable[[], Objective] | None = None

    def here(self) -> TileWriter:
        """Return the writer as it is in this process."""
        return self

    def fill(self, tiles: Sequence[Tile], batch: int, pending: Collection[Tile] | None = None) -> Iterator[FilledTile]:
        """Evaluate tiles in batches of so many points, and write them one by one; by default all are pending."""
        pending, finished = set(tiles if pending is None else pending), self.store.ascending
        for tile, found in evaluate_tiles(self.objective, self.store, tiles, batch, pending):
            self.store.write(tile, found)
            statuses = Counter(map(Status, found.status.tolist()))
            yield FilledTile(tile, statuses, self.objective.take_notes(), found.error)
            if self.store.ascending != finished:  # by another process, and has other tiles since
                return

    def __reduce__(self) -> tuple[Any, ...]:
        who = self.objective.name
        if self.store.path is None:
            raise ValueError(f"{who} is sampled by other processes, which share no memory; give sample a store on disk")
        try:
            recipe = cloudpickle.dumps(self.made or _Itself(self.objective.objective))
        except Exception as error:  # whatever part of it cannot travel
            raise ValueError(
                f"{who} cannot be sent to another process ({error}); give sample made=, a function that makes it there"
            ) from error
        return WorkerTileWriter, (recipe, str(self.store.path), self.store.identity)


@dataclass(frozen=True)
class WorkerTileWriter:
    """A writer in a process that it was sent to."""

    recipe: bytes
    path: str
    identity: Mapping[str, Any]

    def here(self) -> TileWriter:
        """Return the writer with its objective, made where this process has not made it yet, and its store.

        Raises StoreError where this process does not see the store, StoreMismatchError where it is another one.
        """
        try:
            at = place_of(Path(self.path)).stat()
        except FileNotFoundError:
            raise StoreError(f"a worker finds no {self.path}; workers need a file system that they share") from None
        store = open_store(self.path, at.st_ino, at.st_mtime_ns)
        check_identity(store.path, wanted=self.identity, found=store.identity)
        return TileWriter(make_objective(self.recipe), store)

    def fill(self, tiles: Sequence[Tile], batch: int) -> Iterator[FilledTile]:
        """Do what `TileWriter.fill` does, but for tiles that a worker finished before it died."""
        writer = self.here()
        found = {tile: writer.store.statuses(tile) for tile in tiles}
        error = writer.store.error
        yield from (FilledTile(tile, statuses, error=error) for tile, statuses in found.items() if statuses)
        yield from writer.fill(tiles, batch, {tile for tile, statuses in found.items() if not statuses})


@dataclass(frozen=True)
class _Itself:
    """Make an objective that is pickled."""

    objective: Objective

    def __call__(self) -> Objective:
        return self.objective


@lru_cache(maxsize=1)
def open_store(path: str, inode: int, changed: int) -> SliceStore:
    """Return an open store, the last one as it is; `inode` and `changed` [ns] tell it from one that replaced it."""
    return SliceStore.open(path)


_objectives: dict[bytes, MemoryBound] = {}
_making = threading.Lock()


def make_objective(recipe: bytes) -> MemoryBound:
    """Return the objective that a pickled function makes, once in this process; only the last one is kept.

    It may hold all of a GPU's memory.
    """
    with _making:
        if recipe not in _objectives:
            _objectives.clear()
            free_memory()
            _objectives[recipe] = MemoryBound(pickle.loads(recipe)())
        return _objectives[recipe]


def equal_groups(store: SliceStore, tiles: Sequence[Tile], batch: int, workers: int) -> list[list[Tile]]:
    """Group tiles, in their order, so that every worker gets as many groups, equal and of at most `batch` points.

    Where gradients are at every few samples alone, groups are larger: of at most so many points with a gradient, and of
    as many points in all as have so many where they are evenly spread. Where tiles are coarse groups are equal to
    within one, which may exceed that.
    """
    share = store.every ** len(store.shape)  # of so many samples one has a gradient
    sizes = [max(store.count(tile), share * int(store.sloped(tile).sum())) for tile in tiles]
    total = sum(sizes)
    count = min(len(tiles), workers * math.ceil(total / (share * batch * workers)))
    groups: list[list[Tile]] = [[] for _ in range(count)]
    before = 0
    for tile, size in zip(tiles, sizes, strict=True):
        groups[(2 * before + size) * count // (2 * total)].append(tile)
        before += size
    return [group for group in groups if group]


def await_tiles(store: SliceStore, late: Sequence[Tile]) -> None:
    """Wait for tiles that workers have written: a file system that machines share may show them later.

    Raises StoreError where they do not appear.
    """
    since = time.monotonic()
    while late := [tile for tile in late if store.read_tile(tile) is None]:
        if time.monotonic() - since > LATE:
            raise StoreError(
                f"{store.path}: {len(late)} tiles that workers finished have not appeared here for {LATE:g} s; see "
                "that they write to the same folder, and the same command goes on"
            )
        time.sleep(POLL)


class Distributed(ObjectiveWrapper):
    """An objective whose points an executor's workers evaluate, each an equal part of a batch."""

    def __init__(self, writer: TileWriter, executor: Executor) -> None:
        super().__init__(writer.objective)
        self._writer, self._executor = writer, executor

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked, at points `x` in the parameters' own units.

        Raises WorkersLostError where nobody is left to evaluate them, and what the objective raises.
        """
        parts = torch.tensor_split(x, max(1, min(len(x), workers_of(self._executor))))
        tasks = [(self._writer, number, part, grad) for number, part in enumerate(parts)]
        found = dict(run_tasks(self._executor, _evaluate, tasks))
        return Evaluation.join([found[number] for number in range(len(parts))], dim=x.shape[1], grad=grad)


def evaluator(
    objective: Objective, store: SliceStore, executor: Executor | None, made: Callable[[], Objective] | None
) -> Objective:
    """Return the objective of a slice as it is to be evaluated: here, or by an executor's workers."""
    writer = TileWriter(MemoryBound(objective), store, made)
    return writer.objective if executor is None else Distributed(writer, executor)


def workers_of(executor: Executor) -> int:
    """Return how many batches an executor works on at a time, 1 if it does not say: no interface of theirs has it."""
    client = getattr(executor, "_client", None)  # Dask's
    if client is not None:
        return sum(client.nthreads().values()) or 1
    return int(getattr(executor, "_max_workers", 1))


def distribute(writer: TileWriter, tiles: Sequence[Tile], batch: int, executor: Executor) -> Iterator[FilledTile]:
    """Let an executor's workers fill tiles, group by group, and yield each tile when its group is done."""
    groups = equal_groups(writer.store, tiles, batch, workers_of(executor))
    yield from chain.from_iterable(run_tasks(executor, _fill, [(writer, group, batch) for group in groups]))


def run_tasks(executor: Executor, work: Callable[..., T], tasks: Iterable[Sequence[Any]]) -> Iterator[T]:
    """Let workers do tasks, and yield each result when it is there; what is not begun when that ends is cancelled.

    Raises WorkersLostError where nobody is left to do them, and what a task raises.
    """
    futures: list[Future[T]] = []
    try:
        futures += [executor.submit(work, *task) for task in tasks]
        for future in _wait_for(executor, futures):
            yield future.result()
    except (CancelledError, BrokenExecutor) as error:
        raise WorkersLostError(f"the workers are gone ({str(error) or type(error).__name__})") from error
    finally:
        for future in futures:
            future.cancel()


def _wait_for(executor: Executor, futures: Iterable[Future[T]]) -> Iterator[Future[T]]:
    """Yield futures as they end, and give up where nobody is left to work on them."""
    pending, seen = set(futures), time.monotonic()
    while pending:
        done, pending = wait(pending, timeout=POLL, return_when=FIRST_COMPLETED)
        yield from done
        if done or _has_workers(executor):
            seen = time.monotonic()
        elif time.monotonic() - seen > WITHOUT_WORKERS:
            raise WorkersLostError(f"the workers are gone (none was there for {WITHOUT_WORKERS:g} s)")


def _has_workers(executor: Executor) -> bool:
    """Say whether an executor has a worker, as far as it can be asked."""
    client = getattr(executor, "_client", None)  # Dask's
    try:
        return client is None or bool(client.nthreads())
    except OSError:  # nobody is there to answer
        return False


def _evaluate(
    writer: TileWriter | WorkerTileWriter, number: int, x: Float[Tensor, "batch dim"], grad: bool
) -> tuple[int, Evaluation]:
    return number, writer.here().objective.evaluate(x, grad=grad)


def _fill(writer: TileWriter | WorkerTileWriter, tiles: Sequence[Tile], batch: int) -> list[FilledTile]:
    return list(writer.fill(tiles, batch))


def evaluate_tiles(
    objective: Objective, store: SliceStore, tiles: Sequence[Tile], batch: int, pending: Collection[Tile]
) -> Iterator[tuple[Tile, Evaluation]]:
    """Evaluate the points of those tiles that are pending, in order; a point without gradient has one of NaN."""
    kinds = [Batches(objective, store, tiles, batch, pending, grad).evaluations() for grad in (True, False)]
    left = [tile for tile in tiles if tile in pending]
    for tile, having, lacking in zip(left, *kinds, strict=True):
        yield tile, _merge(having, lacking, torch.from_numpy(store.sloped(tile)), store)


def _merge(having: Evaluation, lacking: Evaluation, sloped: Tensor, store: SliceStore) -> Evaluation:
    """Put both kinds of a tile's points into the order of its points."""
    dim = store.plane.dim
    blank = replace(lacking, grad=torch.full((len(lacking.loss), dim), torch.nan, dtype=torch.float64))
    order = torch.cat([sloped.nonzero(), (~sloped).nonzero()])[:, 0].argsort()
    return Evaluation.join([having, blank], dim=dim, grad=store.grad).rows(order)


@dataclass(frozen=True, eq=False)
class Batches:
    """The points of tiles that have a gradient, or with `grad` false those that have none, in batches.

    Where all points are of one kind, a batch is whole tiles: `batch` points or more. Otherwise batches go on from tile
    to tile, so that all are full but the last, however few points of the kind a tile has: they hold `batch` points, or
    the least multiple of it that the points of any tile fit into.

    Batches are the same however many of the tiles are `pending`, so that a run that goes on repeats them; each is
    evaluated at the points of tiles that are.
    """

    objective: Objective
    store: SliceStore
    tiles: Sequence[Tile]
    batch: int
    pending: Collection[Tile]
    grad: bool

    def evaluations(self) -> Iterator[Evaluation]:
        """Yield the evaluation of every pending tile's points of the kind, in order.

        No more is evaluated ahead than the batch that a tile's last point is in.
        """
        batches, dim = self.points(), self.store.plane.dim
        ahead, start = Evaluation.empty(dim, grad=self.grad), 0
        for tile in self.tiles:
            if tile not in self.pending:
                continue
            count = len(self._of(tile))
            while len(ahead.loss) < start + count:
                parts = [ahead.rows(slice(start, None)), self.objective.evaluate(next(batches), grad=self.grad)]
                ahead, start = Evaluation.join(parts, dim=dim, grad=self.grad), 0
            yield ahead.rows(slice(start, start + count))
            start += count

    def points(self) -> Iterator[Float[Tensor, "batch dim"]]:
        """Yield the points of one batch after another."""
        size, whole = self._size(), self.store.every == 1
        parts, room = list[Tensor](), size
        for tile in self.tiles:
            left = self._of(tile)
            while len(left):
                here, left = np.split(left, [len(left) if whole else room])
                if tile in self.pending:
                    parts.append(self.store.points(tile)[here])
                room -= len(here)
                if room <= 0:
                    if parts:
                        yield torch.cat(parts)
                    parts, room = [], size
        if parts:
            yield torch.cat(parts)

    def _size(self) -> int:
        """Return how many points a full batch has."""
        if self.store.every == 1:
            return self.batch
        most = max((len(self._of(tile)) for tile in self.tiles), default=0)
        return self.batch * max(1, -(-most // self.batch))

    def _of(self, tile: Tile) -> NDArray[np.intp]:
        """Return the numbers of a tile's points that are of the kind."""
        return np.flatnonzero(self.store.sloped(tile) == self.grad)
