"""Fill a slice: evaluate the points of its tiles, coarse to fine, and write each tile whole."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any

import xarray as xr

from ..identity import check_identity, record_parameters, with_stride
from ..objective import Objective, Status
from ..plane import Plane
from ..space import as_stride, as_whole
from ..storage.files import full, is_full
from ..storage.store import SliceStore
from .distribution import PortableObjective, WorkersLostError, fill_tiles


@dataclass(frozen=True)
class Progress:
    """The progress of a slice.

    `done` of `total` points are finished, `resumed` of them before this run began; `statuses` counts the finished ones.
    `levels` coarse pictures are complete, each finer than the last. `level_complete`: one has just become complete, so
    it is time to draw `SliceStore.coarse()`.
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
    gradients: int = 1,
    batch: int | None = None,
    progress: Callable[[Progress], None] | None = None,
    executor: Executor | None = None,
    made: Callable[[], Objective] | None = None,
    conclude: Callable[[xr.Dataset], Mapping[str, Any]] | None = None,
) -> xr.Dataset:
    """Evaluate an objective on a plane and return the slice; points already in `store` are not evaluated again.

    Up to three points of a store on disk are evaluated again, to verify that they come from this objective. Without a
    store the slice is in memory. Losses are at all samples, and `gradients` is the stride of the samples with gradients
    along each axis, 0 for none; a store has its own stride. `batch` is the number of points per evaluation, rounded up
    to whole tiles (default: the objective's `preferred_batch`, else one tile). If some samples have no gradient, these
    and the others have separate batches, as in `Batches`. `progress` is called once at the start and after every tile.
    You can stop it at any moment: the same call continues. The result is bit for bit that of an uninterrupted one, if
    rows of the objective do not depend on their batch. A batch that does not fit into memory is halved.

    With an `executor` its workers evaluate batches. Threads share the objective. In a process, `made`, a function that
    can be pickled, makes it once; otherwise the objective itself is pickled. Batches are equal then, and of at most
    `batch` points.

    `conclude` is called with the complete slice, and returns attributes to store with it. It is not called for a slice
    that was finished before.

    Raises ValueError where `gradients` or `batch` is no whole number. Raises StoreMismatchError where the store has
    other settings or other numbers than the objective gives now, and TooLargeError where the slice does not fit into
    memory. Raises DiskFullError and WorkersLostError where filling ended early, with a message on what is kept, and
    MemoryError where a single point is too much for the device.
    """
    gradients = as_stride(gradients)
    if store is None:
        about = describe(objective)
        about["identity"] = with_stride(about["identity"], gradients)
        store = SliceStore.in_memory(plane, objective.space, **about, grad=gradients > 0)
    check_store(store, objective, plane, grad=gradients > 0)
    store.verify(objective)
    batch = as_whole(objective.preferred_batch if batch is None else batch, "sample's batch", least=1)
    status, pending = store.status(), store.pending()
    counts: Counter[Status] = Counter({kind: int((status == kind).sum()) for kind in Status if kind != Status.MISSING})
    resumed, tiling = counts.total(), store.tiling
    left = Counter(tile.level for tile in pending)  # tiles, by level
    all_levels = 1 + store.tiles()[-1].level
    levels = min(left, default=all_levels)
    for tile in store.damaged_tiles(pending):
        warnings.warn(
            f"{store.place}: tile {tile.index} is damaged and is computed again", RuntimeWarning, stacklevel=2
        )

    def report() -> None:
        nonlocal levels
        before, levels = levels, min(left, default=all_levels)
        if progress is not None:
            progress(Progress(counts.total(), status.size, resumed, dict(counts), levels, levels > before))

    report()
    sent = PortableObjective.of(objective, made)
    with resumable(store, counts), closing(fill_tiles(sent, tiling, pending, batch, executor)) as tiles:
        for filled in tiles:
            store.write(filled.tile, filled.found)
            for note in filled.notes:
                warnings.warn(note, RuntimeWarning, stacklevel=2)
            counts.update(map(Status, filled.found.status.tolist()))
            left -= Counter([filled.tile.level])  # none is kept at zero
            report()
            if store.tiling is not tiling:  # another process has finished the slice, which has other tiles since
                break
        dataset = store.dataset()
        if not bool((dataset["status"] == Status.MISSING).any()):
            if conclude is not None and not store.ascending:
                dataset = dataset.assign_attrs(conclude(dataset))
            store.finish(dataset)
    return dataset


def describe(objective: Objective) -> dict[str, dict[str, Any]]:
    """Return an objective's description: fidelity and options of an environment, name and unit of any."""
    return {"identity": objective.identity(), "provenance": {"loss_unit": objective.loss_unit}}


def check_store(store: SliceStore, objective: Objective, plane: Plane, *, grad: bool | None = None) -> None:
    """Raise StoreMismatchError where a store has another plane, other parameters, or another choice of gradients."""
    wanted: dict[str, Any] = {"plane": plane.record(), **record_parameters(objective.space)}
    wanted |= {} if grad is None else {"gradients": grad}
    check_identity(store.path, wanted=wanted, found={name: store.identity[name] for name in wanted})


@contextmanager
def resumable(store: SliceStore, counts: Counter[Status]) -> Iterator[None]:
    """Describe what is kept when the disk is full or the workers are lost.

    Raises DiskFullError and WorkersLostError then, and any other error unchanged.
    """
    try:
        yield
    except OSError as error:
        kept = f"{counts.total()} of {math.prod(store.shape)} points are kept in {store.place or 'memory'}"
        if isinstance(error, WorkersLostError):
            raise WorkersLostError(f"{error}; {kept}, and the same command continues from there") from error
        if is_full(error):
            raise full(error, kept) from error
        raise
