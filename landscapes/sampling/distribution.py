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
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import cloudpickle
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..identity import StoreError, check_identity
from ..objective import Evaluation, Objective, ObjectiveWrapper, Status
from ..storage.paths import place_of
from ..storage.store import SliceStore
from ..storage.tiles import Tile
from .batches import evaluate_tiles
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
class Site:
    """An objective, and the store that takes its evaluations.

    Sent to another process, it is the same objective made there by `made`, once, and kept, and the same store opened
    there. Without `made` the objective itself is pickled.
    """

    objective: MemoryBound
    store: SliceStore
    made: Callable[[], Objective] | None = None

    def here(self) -> Site:
        """Return the site as it is in this process."""
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
        return RemoteSite, (recipe, str(self.store.path), self.store.identity)


@dataclass(frozen=True)
class RemoteSite:
    """A site in a process that it was sent to."""

    recipe: bytes
    path: str
    identity: Mapping[str, Any]

    def here(self) -> Site:
        """Return the site with its objective, made where this process has not made it yet, and its store.

        Raises StoreError where this process does not see the store, StoreMismatchError where it is another one.
        """
        try:
            at = place_of(Path(self.path)).stat()
        except FileNotFoundError:
            raise StoreError(f"a worker finds no {self.path}; workers need a file system that they share") from None
        store = open_store(self.path, at.st_ino, at.st_mtime_ns)
        check_identity(store.path, wanted=self.identity, found=store.identity)
        return Site(make_objective(self.recipe), store)

    def fill(self, tiles: Sequence[Tile], batch: int) -> Iterator[FilledTile]:
        """Do what `Site.fill` does, but for tiles that a worker finished before it died."""
        site = self.here()
        found = {tile: site.store.statuses(tile) for tile in tiles}
        error = site.store.error
        yield from (FilledTile(tile, statuses, error=error) for tile, statuses in found.items() if statuses)
        yield from site.fill(tiles, batch, {tile for tile, statuses in found.items() if not statuses})


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


class ReadBack:
    """Read the tiles that workers have finished, while they go on with others."""

    def __init__(self, store: SliceStore) -> None:
        self._store = store
        self._values: dict[Tile, dict[str, NDArray[Any]]] = {}
        self._late: list[Tile] = []

    def look(self, tile: Tile) -> None:
        """Read a tile if it is to be seen already: a file system that machines share may show it later."""
        values = self._store.read_tile(tile)
        if values is None:
            self._late.append(tile)
        else:
            self._values[tile] = values

    def values(self) -> Mapping[Tile, dict[str, NDArray[Any]]]:
        """Return the arrays of all tiles looked for, when they have appeared; raises StoreError where they do not."""
        since = time.monotonic()
        while self._late:
            late, self._late = self._late, []
            for tile in late:
                self.look(tile)
            if self._late and time.monotonic() - since > LATE:
                raise StoreError(
                    f"{self._store.path}: {len(self._late)} tiles that workers finished have not appeared here for "
                    f"{LATE:g} s; see that they write to the same folder, and the same command goes on"
                )
            if self._late:
                time.sleep(POLL)
        return self._values


class Distributed(ObjectiveWrapper):
    """An objective whose points an executor's workers evaluate, each an equal part of a batch."""

    def __init__(self, site: Site, executor: Executor) -> None:
        super().__init__(site.objective)
        self._site, self._executor = site, executor

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked, at points `x` in the parameters' own units.

        Raises WorkersLostError where nobody is left to evaluate them, and what the objective raises.
        """
        parts = torch.tensor_split(x, max(1, min(len(x), workers_of(self._executor))))
        tasks = [(self._site, number, part, grad) for number, part in enumerate(parts)]
        found = dict(run_tasks(self._executor, _evaluate, tasks))
        return Evaluation.join([found[number] for number in range(len(parts))], dim=x.shape[1], grad=grad)


def evaluator(
    objective: Objective, store: SliceStore, executor: Executor | None, made: Callable[[], Objective] | None
) -> Objective:
    """Return the objective of a slice as it is to be evaluated: here, or by an executor's workers."""
    site = Site(MemoryBound(objective), store, made)
    return site.objective if executor is None else Distributed(site, executor)


def workers_of(executor: Executor) -> int:
    """Return how many batches an executor works on at a time, 1 if it does not say: no interface of theirs has it."""
    client = getattr(executor, "_client", None)  # Dask's
    if client is not None:
        return sum(client.nthreads().values()) or 1
    return int(getattr(executor, "_max_workers", 1))


def distribute(site: Site, tiles: Sequence[Tile], batch: int, executor: Executor) -> Iterator[FilledTile]:
    """Let an executor's workers fill tiles, group by group, and yield each tile when its group is done."""
    groups = equal_groups(site.store, tiles, batch, workers_of(executor))
    yield from chain.from_iterable(run_tasks(executor, _fill, [(site, group, batch) for group in groups]))


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
    site: Site | RemoteSite, number: int, x: Float[Tensor, "batch dim"], grad: bool
) -> tuple[int, Evaluation]:
    return number, site.here().objective.evaluate(x, grad=grad)


def _fill(site: Site | RemoteSite, tiles: Sequence[Tile], batch: int) -> list[FilledTile]:
    return list(site.fill(tiles, batch))
