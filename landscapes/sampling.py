"""Fill a slice: evaluate the points of its tiles, coarse to fine, and write down each tile whole."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
import xarray as xr

from .identity import check_identity
from .objective import Evaluation, Objective, Status, evaluated, name_of
from .plane import Plane
from .store import SliceStore
from .tiling import Tile


@dataclass(frozen=True)
class Progress:
    """Say how far a slice is.

    `done` of `total` points are finished, `resumed` of them before this run began; `statuses` counts the finished ones.
    `levels` coarse pictures are complete, each finer than the last, and `level_complete` says that one has just become
    so: the time to draw `SliceStore.coarse()`.
    """

    done: int
    total: int
    resumed: int
    statuses: Mapping[Status, int]
    levels: int
    level_complete: bool


def sample(
    objective: Objective,
    plane: Plane,
    store: SliceStore | None = None,
    *,
    grad: bool = True,
    batch: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> xr.Dataset:
    """Evaluate an objective on a plane and return the slice; what `store` holds already is not evaluated again.

    Without a store the slice lives in memory. `batch` is the least number of points per evaluation (default: the
    objective's `preferred_batch`, else one tile); `progress` is called once at the start and after every tile. Stop it
    at any instant: the same call goes on, and the result is bit for bit that of an uninterrupted one, given an
    objective whose rows do not depend on their batch.
    """
    if store is None:
        store = SliceStore.in_memory(plane, objective.space, identity={"objective": name_of(objective)}, grad=grad)
    _check_store(store, objective, plane, grad=grad)
    batch = getattr(objective, "preferred_batch", 1) if batch is None else batch
    status = store.status()
    counts: Counter[Status] = Counter({kind: int((status == kind).sum()) for kind in Status if kind != Status.MISSING})
    resumed, pending = counts.total(), store.pending(status)
    levels = _levels(store, pending)

    def report(left: Sequence[Tile]) -> None:
        nonlocal levels
        before, levels = levels, _levels(store, left)
        if progress is not None:
            progress(Progress(counts.total(), status.size, resumed, dict(counts), levels, levels > before))

    report(pending)
    left = list(pending)
    for tiles in _batches(store, batch, set(pending)):
        for tile, part in _evaluate(objective, store, tiles, grad=grad):
            store.write(tile, part)
            counts.update(Status(int(kind)) for kind in part.status)
            left.remove(tile)
            report(left)
    return store.dataset()


def _check_store(store: SliceStore, objective: Objective, plane: Plane, *, grad: bool) -> None:
    wanted = {"plane": plane.record(), "parameters": list(objective.space.names), "gradients": grad}
    check_identity(store.path, wanted=wanted, found={name: store.identity[name] for name in wanted})


def _levels(store: SliceStore, pending: Sequence[Tile]) -> int:
    return pending[0].level if pending else 1 + store.tiles()[-1].level


def _batches(store: SliceStore, batch: int, pending: set[Tile]) -> Iterator[list[Tile]]:
    """Group all tiles the same way however many are pending, so that a resumed run repeats the same batches."""
    group: list[Tile] = []
    size = 0
    for tile in store.tiles():
        group.append(tile)
        size += store.count(tile)
        if size >= batch:
            yield [member for member in group if member in pending]
            group, size = [], 0
    yield [member for member in group if member in pending]


def _evaluate(
    objective: Objective, store: SliceStore, tiles: Sequence[Tile], *, grad: bool
) -> Iterator[tuple[Tile, Evaluation]]:
    if not tiles:
        return
    parts = [store.points(tile) for tile in tiles]
    evaluation = evaluated(objective, torch.cat(parts), grad=grad)
    start = 0
    for tile, part in zip(tiles, parts, strict=True):
        rows = slice(start, start := start + len(part))
        gradient = None if evaluation.grad is None else evaluation.grad[rows]
        yield tile, Evaluation(evaluation.loss[rows], gradient, evaluation.status[rows])
