"""One slice from start to files: its folder, its cost, its pictures on the way and its summary."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from torch import Tensor

from ..landscapes.objective import Objective, Status
from ..landscapes.plane import Plane
from ..landscapes.sampling.distribution import RemoteSite, Site, results, workers_of
from ..landscapes.sampling.fill import Progress, sample
from ..landscapes.sampling.memory import Halving
from ..landscapes.storage.arrays import need_of
from ..landscapes.storage.files import clear, tidy, visible, write_json
from ..landscapes.storage.paths import SLICE, there
from ..landscapes.storage.store import SliceStore, plane_of
from ..landscapes.storage.tiles import Tile

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STORE, PICTURE, SUMMARY = SLICE, "landscape.png", "summary.json"
PAUSE, DRAWING = 10.0, 0.1  # between pictures of an unfinished slice: least seconds, and most of the time for them
PATIENCE, FIRST_PATIENCE = 1.0, 10.0  # seconds that do for an estimate, and those that a first evaluation is given


@dataclass(frozen=True)
class Cost:
    """Say what is left of a slice to compute: episodes, seconds they should take, bytes of memory."""

    episodes: int
    seconds: float
    memory: int


@dataclass(frozen=True)
class Job:
    """A slice to sample into `folder`, and how to draw it; `executor` and `made` are those of `sample`.

    `prints` are widths of pages [mm] that it is also drawn for.
    """

    objective: Objective
    plane: Plane
    folder: Path
    store: SliceStore
    draw: Callable[..., Figure]
    executor: Executor | None = None
    made: Callable[[], Objective] | None = None
    prints: Sequence[float] = ()

    @classmethod
    def open(
        cls,
        objective: Objective,
        plane: Plane,
        folder: Path,
        draw: Callable[..., Figure],
        *,
        identity: Mapping[str, Any],
        provenance: Mapping[str, Any],
        grad: bool = True,
        force: bool = False,
        executor: Executor | None = None,
        made: Callable[[], Objective] | None = None,
        prints: Sequence[float] = (),
    ) -> Job:
        """Go on with the slice in `folder`, or begin it there; `force` begins anew where another slice is."""
        path = folder / STORE
        if not there(path) and visible(folder):
            raise ValueError(f"{folder} holds other files and no slice; give --out a new or an empty folder")
        settings: dict[str, Any] = {"identity": identity, "provenance": provenance, "grad": grad}
        if force and there(path):
            store = SliceStore.create(path, plane, objective.space, overwrite=True, **settings)
            clear(folder, (PICTURE, SUMMARY), PICTURE)
        else:
            store = SliceStore.open_or_create(path, plane, objective.space, **settings)
        return cls(objective, plane, folder, store, draw, executor, made, prints)

    def cost(self) -> Cost:
        """Estimate what is left; workers that compute it do, which warms them, and leaves a GPU of theirs alone."""
        if self.executor is None:
            return cost_of(self.objective, self.store)
        site = Site(Halving(self.objective), self.store, self.made)
        costs = list(results(self.executor, _cost_there, [(site,)] * workers_of(self.executor)))
        shares = [1 / cost.seconds for cost in costs if cost.seconds]
        return replace(costs[0], seconds=1 / sum(shares) if shares else 0.0)

    def run(self, progress: Callable[[Progress], None], *, command: str) -> dict[str, Any]:
        """Sample what is missing, draw each finer picture as it completes, write and return the summary."""
        start, drawn, pause = time.monotonic(), -PAUSE, PAUSE
        last: Progress | None = None

        def follow(now: Progress) -> None:
            nonlocal drawn, pause, last
            last = now
            progress(now)
            if now.level_complete and now.done < now.total and (began := time.monotonic()) - drawn > pause:
                self.picture()
                drawn = time.monotonic()
                pause = pause_after(drawn - began)

        how: dict[str, Any] = {"grad": self.store.grad, "executor": self.executor, "made": self.made}
        dataset = sample(self.objective, self.plane, self.store, progress=follow, **how)
        self._save(dataset)
        printed = self._print(dataset)
        computed = last.done - last.resumed if last else 0
        summary = self._summary(dataset, computed, time.monotonic() - start, command)
        summary["files"] = [STORE, PICTURE, *printed, SUMMARY]
        write_json(self.folder / SUMMARY, summary)
        tidy(self.folder)
        return summary

    def kept(self) -> str:
        """Say how much of it is on disk."""
        status = self.store.status()
        return f"{int((status > 0).sum())} of {status.size} points are kept in {self.folder}"

    def picture(self) -> None:
        """Draw the finest complete picture of the whole so far, if there is one."""
        if (coarse := self.store.coarse()) is not None:
            self._save(coarse)

    def _save(self, dataset: xr.Dataset) -> None:
        from ..landscapes.draw.figures.page import save

        save(self.draw(dataset), self.folder / PICTURE)

    def _print(self, dataset: xr.Dataset) -> list[str]:
        from ..landscapes.draw.figures.page import save_prints

        return save_prints(lambda width: self.draw(dataset, width=width), self.folder / PICTURE, self.prints)

    def _summary(self, dataset: xr.Dataset, computed: int, seconds: float, command: str) -> dict[str, Any]:
        identity, status = self.store.identity, dataset["status"].to_numpy()
        loss = dataset["loss"].to_numpy()
        ends = [float(np.nanmin(loss)), float(np.nanmax(loss))] if np.isfinite(loss).any() else [None, None]
        return {
            "env": identity.get("objective"),
            "dims": list(self.plane.names),
            "fidelity": identity.get("fidelity"),
            "device": identity.get("device"),
            "options": identity.get("options"),
            "resolution": list(self.plane.resolution),
            "gradients": self.store.grad,
            "episodes": computed,
            "resumed": int(status.size) - computed,
            "seconds": round(seconds, 3),
            "status": {kind.name.lower(): int((status == kind).sum()) for kind in Status},
            "loss": {"lowest": ends[0], "highest": ends[1]},
            "flat": flat_points(dataset),
            "command": command,
        }


def pause_after(seconds: float) -> float:
    """Return how long no picture of an unfinished slice follows one that took so many seconds."""
    return max(PAUSE, seconds / DRAWING)


def cost_of(objective: Objective, store: SliceStore) -> Cost:
    """Estimate what is left of a slice from its own first points, evaluated as they will be; that takes seconds."""
    pending = store.pending()
    left = sum(store.count(tile) for tile in pending)
    if not left:
        return Cost(0, 0.0, peak_memory())
    getattr(objective, "prepare", lambda: None)()
    batch = first_points(store, pending, getattr(objective, "preferred_batch", 1))
    seconds = left * _seconds_per_point(objective, batch, grad=store.grad)
    arrays = need_of(store.shape, store.plane.dim, grad=store.grad)
    return Cost(left, seconds, peak_memory() + round(arrays.memory))


def _cost_there(site: Site | RemoteSite) -> Cost:
    here = site.here()
    return cost_of(here.objective.objective, here.store)


def first_points(store: SliceStore, tiles: Sequence[Tile], count: int) -> Float[Tensor, "point dim"]:
    """Return the first points of tiles, or all there are where they are fewer."""
    parts, size = list[Tensor](), 0
    for tile in tiles:
        if size < count:
            parts.append(store.points(tile))
            size += len(parts[-1])
    return torch.cat(parts)[:count]


def _seconds_per_point(objective: Objective, points: Float[Tensor, "batch dim"], *, grad: bool) -> float:
    """Time as many points as there are threads, again (a first time is longer), then more until they take long.

    A GPU takes a whole batch at once: of one point most would be launches.
    """
    whole = getattr(objective, "device", "cpu") == "cuda"
    rows = len(points) if whole else min(len(points), getattr(objective, "threads", 1))
    seconds = _seconds(objective, points[:rows], grad=grad)
    if seconds < FIRST_PATIENCE:
        seconds = _seconds(objective, points[:rows], grad=grad)
    while seconds < PATIENCE and rows < len(points):
        rows = min(4 * rows, len(points))
        seconds = _seconds(objective, points[:rows], grad=grad)
    return seconds / rows


def _seconds(objective: Objective, points: Float[Tensor, "batch dim"], *, grad: bool) -> float:
    start = time.perf_counter()
    objective.evaluate(points, grad=grad)
    return time.perf_counter() - start


def flat_points(dataset: xr.Dataset) -> int | None:
    """Count the points whose gradient along the plane is exactly zero, none if gradients are not there."""
    if "grad" not in dataset:
        return None
    slope = plane_of(dataset).slope(torch.from_numpy(dataset["grad"].to_numpy()))
    return int((slope == 0).all(dim=-1).sum())


def peak_memory() -> int:
    """Return the most memory this process has held [bytes]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
