"""Evaluate the points of a slice in this process, or by an executor's workers.

A worker receives how to make the objective and which tiles to evaluate; it returns evaluations, which this process
writes.
"""

from __future__ import annotations

import math
import pickle
import threading
import time
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import Any, TypeVar

import cloudpickle
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..objective import Evaluation, Objective, ObjectiveWrapper
from ..storage.arrays import Tile, Tiling
from .memory import MemoryBound, free_memory

T = TypeVar("T")
POLL = 1.0  # seconds between looks at the workers
AHEAD = 2  # tasks of each worker that are under way or wait for it
WITHOUT_WORKERS = 60.0  # seconds without any worker after which they are given up


class WorkersLostError(OSError):
    """The workers of an executor, or their scheduler, are gone."""


@dataclass(frozen=True, eq=False)
class FilledTile:
    """An evaluated tile, with its warnings."""

    tile: Tile
    found: Evaluation
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class PortableObjective:
    """An objective that can be sent to another process, where `made` makes it once.

    Without `made` the objective itself is pickled. In the other process, `recipe` is the received form.
    """

    own: MemoryBound | None
    made: Callable[[], Objective] | None = None
    recipe: bytes = b""

    @classmethod
    def of(cls, objective: Objective, made: Callable[[], Objective] | None) -> PortableObjective:
        """Return an objective in the form to send."""
        return cls(MemoryBound(objective), made)

    @property
    def objective(self) -> MemoryBound:
        """The objective in this process, made on first use."""
        return make_objective(self.recipe) if self.own is None else self.own

    def __reduce__(self) -> tuple[Any, ...]:
        try:
            itself = self.objective.objective
            recipe = self.recipe or cloudpickle.dumps(self.made or (lambda: itself))
        except Exception as error:  # whatever part of it cannot travel
            raise ValueError(
                f"{self.objective.name} cannot be sent to another process ({error}); pass sample made=, a function "
                "that makes it there"
            ) from error
        return PortableObjective, (None, None, recipe)


_objectives: dict[bytes, MemoryBound] = {}
_making = threading.Lock()


def make_objective(recipe: bytes) -> MemoryBound:
    """Return the objective from a pickled function, made once in this process; only the last one is kept.

    It can hold all of a GPU's memory.
    """
    with _making:
        if recipe not in _objectives:
            _objectives.clear()
            free_memory()
            _objectives[recipe] = MemoryBound(pickle.loads(recipe)())
        return _objectives[recipe]


def equal_groups(tiling: Tiling, tiles: Sequence[Tile], batch: int, workers: int) -> list[list[Tile]]:
    """Group tiles, in order, so that every worker gets the same number of equal groups of at most `batch` points.

    If only some samples have gradients, groups are larger: of at most that many points with a gradient, and of as many
    points in total as contain them on average. Where tiles are coarse, groups are equal to within one tile, which can
    exceed that.
    """
    share = max(tiling.every, 1) ** len(tiling.shape)  # of so many samples one has a gradient
    sizes = [max(tiling.count(tile), share * int(tiling.sloped(tile).sum())) for tile in tiles]
    total = sum(sizes)
    count = min(len(tiles), workers * math.ceil(total / (share * batch * workers)))
    groups: list[list[Tile]] = [[] for _ in range(count)]
    before = 0
    for tile, size in zip(tiles, sizes, strict=True):
        groups[(2 * before + size) * count // (2 * total)].append(tile)
        before += size
    return [group for group in groups if group]


class Distributed(ObjectiveWrapper):
    """An objective whose points an executor's workers evaluate, each an equal part of a batch."""

    def __init__(self, sent: PortableObjective, executor: Executor) -> None:
        super().__init__(sent.objective)
        self._sent, self._executor = sent, executor

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if requested, at points `x` in the parameters' own units.

        Raises WorkersLostError where no worker is left, and any error of the objective.
        """
        parts = torch.tensor_split(x, max(1, min(len(x), workers_of(self._executor))))
        tasks = [(self._sent, number, part, grad) for number, part in enumerate(parts)]
        found = dict(run_tasks(self._executor, _evaluate, tasks))
        return Evaluation.join([found[number] for number in range(len(parts))], dim=x.shape[1], grad=grad)


def evaluator(objective: Objective, executor: Executor | None, made: Callable[[], Objective] | None) -> Objective:
    """Return the evaluator of an objective: itself, or an executor's workers."""
    sent = PortableObjective.of(objective, made)
    return sent.objective if executor is None else Distributed(sent, executor)


def workers_of(executor: Executor) -> int:
    """Return the number of batches an executor works on simultaneously, at least 1."""
    return _workers_there(executor) or 1


def _workers_there(executor: Executor) -> int:
    """Return the number of batches an executor works on now, 0 where no worker is left."""
    client = getattr(executor, "_client", None)  # Dask's
    if client is None:
        return int(getattr(executor, "_max_workers", 1))
    try:
        return sum(client.nthreads().values()) if client.status == "running" else 0  # else it waits for an answer
    except OSError:  # nobody is there to answer
        return 0


def fill_tiles(
    sent: PortableObjective, tiling: Tiling, pending: Sequence[Tile], batch: int, executor: Executor | None
) -> Generator[FilledTile, None, None]:
    """Evaluate the pending tiles, here or group by group on an executor's workers; yield each when it is done.

    Tasks that have not begun when that ends are cancelled.
    """
    if executor is None:
        yield from _fill(sent, tiling, tiling.tiles(), batch, pending)
        return
    groups = equal_groups(tiling, pending, batch, workers_of(executor))
    tasks = [(sent, tiling, group, batch, group) for group in groups]
    yield from chain.from_iterable(run_tasks(executor, _fill_there, tasks))


def run_tasks(executor: Executor, work: Callable[..., T], tasks: Iterable[Sequence[Any]]) -> Iterator[T]:
    """Let workers do tasks, and yield each result when it is ready; tasks not begun when that ends are cancelled.

    Each worker has one current and one next task, so little work is lost when one dies with its results. Raises
    WorkersLostError where no worker is left, and any error of a task.
    """
    left, pending = iter(tasks), set[Future[T]]()
    count, there = workers_of(executor), True
    asked = seen = time.monotonic()
    try:
        while True:
            for task in islice(left, max(0, AHEAD * count - len(pending))):
                pending.add(executor.submit(work, *task))
            if not pending:
                return
            done, pending = wait(pending, timeout=POLL, return_when=FIRST_COMPLETED)
            if time.monotonic() - asked >= POLL:
                found, asked = _workers_there(executor), time.monotonic()
                count, there = found or count, found > 0
            alive = bool(done or there)
            while done:  # held no longer than needed: Dask computes again what was lost with a worker and is held
                yield done.pop().result()
            if alive:
                seen = time.monotonic()
            elif time.monotonic() - seen > WITHOUT_WORKERS:
                raise WorkersLostError(f"the workers are gone (none was there for {WITHOUT_WORKERS:g} s)")
    except (CancelledError, BrokenExecutor) as error:
        raise WorkersLostError(f"the workers are gone ({str(error) or type(error).__name__})") from error
    finally:
        for future in pending:
            future.cancel()


def _evaluate(
    sent: PortableObjective, number: int, x: Float[Tensor, "batch dim"], grad: bool
) -> tuple[int, Evaluation]:
    return number, sent.objective.evaluate(x, grad=grad)


def _fill(
    sent: PortableObjective, tiling: Tiling, tiles: Sequence[Tile], batch: int, pending: Collection[Tile]
) -> Iterator[FilledTile]:
    """Evaluate the points of pending tiles, in order; a point without gradient gets one of NaN."""
    objective, pending = sent.objective, set(pending)
    kinds = [Batches(objective, tiling, tiles, batch, pending, grad).evaluations() for grad in (True, False)]
    for tile, having, lacking in zip([tile for tile in tiles if tile in pending], *kinds, strict=True):
        found = _merge(having, lacking, torch.from_numpy(tiling.sloped(tile)), tiling)
        yield FilledTile(tile, found, objective.take_notes())


def _fill_there(*task: Any) -> list[FilledTile]:
    return list(_fill(*task))


def _merge(having: Evaluation, lacking: Evaluation, sloped: Tensor, tiling: Tiling) -> Evaluation:
    """Put both kinds of a tile's points into the order of its points."""
    dim = tiling.plane.dim
    blank = replace(lacking, grad=torch.full((len(lacking.loss), dim), torch.nan, dtype=torch.float64))
    order = torch.cat([sloped.nonzero(), (~sloped).nonzero()])[:, 0].argsort()
    return Evaluation.join([having, blank], dim=dim, grad=tiling.every > 0).rows(order)


@dataclass(frozen=True, eq=False)
class Batches:
    """The points of tiles with a gradient, or with `grad` false those without, in batches.

    If all points are of one kind, a batch consists of whole tiles: `batch` points or more. Otherwise batches span
    tiles, so that all but the last are full, even if a tile has few points of the kind. They have `batch` points, or
    the least multiple of it that fits the points of any tile. Batches do not depend on which tiles are `pending`, so a
    continued run repeats them; each is evaluated only at pending points.
    """

    objective: Objective
    tiling: Tiling
    tiles: Sequence[Tile]
    batch: int
    pending: Collection[Tile]
    grad: bool

    def evaluations(self) -> Iterator[Evaluation]:
        """Yield the evaluation of every pending tile's points of the kind, in order.

        Nothing beyond the batch with a tile's last point is evaluated in advance.
        """
        batches, dim = self.points(), self.tiling.plane.dim
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
        size, whole = self._size(), self.tiling.every <= 1
        parts, room = list[Tensor](), size
        for tile in self.tiles:
            left = self._of(tile)
            while len(left):
                here, left = np.split(left, [len(left) if whole else room])
                if tile in self.pending:
                    parts.append(self.tiling.points(tile)[here])
                room -= len(here)
                if room <= 0:
                    if parts:
                        yield torch.cat(parts)
                    parts, room = [], size
        if parts:
            yield torch.cat(parts)

    def _size(self) -> int:
        """Return how many points a full batch has."""
        if self.tiling.every <= 1:
            return self.batch
        most = max((len(self._of(tile)) for tile in self.tiles), default=0)
        return self.batch * max(1, -(-most // self.batch))

    def _of(self, tile: Tile) -> NDArray[np.intp]:
        """Return the numbers of a tile's points that are of the kind."""
        return np.flatnonzero(self.tiling.sloped(tile) == self.grad)
