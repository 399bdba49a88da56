"""The data of the map on a slice's page: its nodes, and the runs that are drawn over it."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
import xarray as xr

from ...convert import to_json
from ...identity import plane_of, stored_provenance
from ...lattice import own_cells
from ...measures.undersampled import contradicted_cells
from ...objective import Status, failed
from ...overlay import improvements, lay
from ...plane import Plane
from ...space import LOG10
from ..figures.overlay import farthest_distance
from ..render.relief import Relief, azimuth
from ..style import LOSS_MAP, Scale, decades, method, point_areas, round_values

LINEAR, LOGARITHMIC = "linear", "logarithmic"
FAR = 1.0  # half-widths of the box: no line leads to a point of a run that is farther off the slice
Column = Sequence[float | None]  # of numbers, None for what is not finite


@dataclass(frozen=True)
class EpisodeShown:
    """A node whose episode is shown, the parameters it is `at`, and its film and picture."""

    row: int
    column: int
    why: str
    loss: float | None
    status: str
    at: Mapping[str, float]
    mp4: str | None = None
    webp: str | None = None

    @property
    def files(self) -> list[str]:
        """The files of the episode that exist."""
        return [name for name in (self.mp4, self.webp) if name]


@dataclass(frozen=True)
class Search:
    """A run that is drawn over a slice: how it was made, and how it ended.

    `outside` counts the episodes outside the map. `distance` is the smallest and the largest distance from the slice.
    """

    method: str
    seed: int
    label: str
    fidelity: str
    colour: str
    budget: int
    episodes: int
    best: float | None
    outside: int
    failed: int
    distance: tuple[float, float]
    command: str


@dataclass(frozen=True)
class Trajectory(Search):
    """A run with its points in the order of evaluation, which only the map needs.

    Each point has its position on the map, its own loss, and the size of its mark [pixels], which falls with the
    distance from the slice. `path` lists the points that were the best so far, `hidden` those outside the map, and
    `far` those more than half a box off the slice, which no line joins.
    """

    u: Column
    v: Column | None
    loss: Column
    radius: Sequence[float]
    path: Sequence[int]
    hidden: Sequence[int]
    far: Sequence[int]

    def search(self) -> Search:
        """Return the run without its points."""
        return Search(**{one.name: getattr(self, one.name) for one in fields(Search)})


def read_off_nodes(
    dataset: xr.Dataset,
    episodes: Sequence[EpisodeShown] = (),
    runs: Sequence[Trajectory] = (),
    floor: xr.Dataset | None = None,
    *,
    growing: bool = False,
) -> dict[str, Any]:
    """Return the data of a slice's map as JSON for its script.

    Nodes go row by row from the lowest v. Arrays are packed, see `pack`. `loss` [unit] is float32, NaN where there is
    none. `status` is uint8, with the numbers of `statuses`. `cells` and `looks` are the same as they are drawn, where a
    refined slice, or one that is still `growing`, was not sampled everywhere. `slope` is the gradient along the axes
    and `gradient` its norm over all parameters, both float32. `finer` flags the cells between four samples whose
    gradients contradict their losses. `floor` is the numerical floor at every node [loss unit], if it was mapped.
    `scales` are the possible scales of the map by name, and `scale` the first one. `azimuth` is the first viewing
    direction of the surface [degrees].
    """
    plane, loss = plane_of(dataset), dataset["loss"].to_numpy()
    own, flat = Scale.of_loss(loss), plane.rank == 2
    kind = Status.MISSING if growing else Status.INTERPOLATED
    drawn = own_cells(dataset, kind) if flat and bool((dataset["status"] == kind).any()) else None
    grad = torch.from_numpy(dataset["grad"].to_numpy().reshape(loss.size, -1)) if "grad" in dataset else None
    finer = contradicted_cells(dataset) if flat and grad is not None else np.zeros(0)
    found = {
        "axes": _axes(plane),
        "unit": str(dataset["loss"].attrs.get("units", "")),
        "loss": pack(loss),
        "status": pack(dataset["status"].to_numpy(), "u1"),
        "statuses": {int(code): code.name for code in Status},
        "scale": LOGARITHMIC if own.logarithmic and flat else LINEAR,
        "scales": _scales(loss, [run.best for run in runs if run.best is not None]),
        "palette": [bytes(round(255 * part) for part in LOSS_MAP(level)[:3]).hex() for level in range(256)],
        "episodes": episodes,
        "runs": runs,
        "azimuth": azimuth(Relief(plane, own), dataset) if flat else None,
        "slope": None if grad is None else [pack(column) for column in plane.slope(grad).numpy().T],
        "gradient": None if grad is None else pack(np.linalg.norm(grad.numpy(), axis=1)),
        "cells": None if drawn is None else pack(drawn["loss"].to_numpy()),
        "looks": None if drawn is None else pack(drawn["status"].to_numpy(), "u1"),
        "finer": pack(finer, "u1") if finer.any() else None,
        "floor": None if floor is None else pack(floor["deviation"].transpose(*dataset["loss"].dims).to_numpy()),
    }
    return dict(to_json(found))


def pack(values: np.ndarray[Any, Any], kind: str = "f4") -> str:
    """Return an array in its own order as little-endian numbers in base64, which a browser decodes once."""
    return base64.b64encode(values.astype(f"<{kind}").tobytes()).decode()


def _axes(plane: Plane) -> list[dict[str, Any]]:
    """Return the axes of a map: node coordinates and labels, as logarithms on a logarithmic axis."""
    found = []
    for label, places, scale in zip(plane.labels, (axis.tolist() for axis in plane.axes()), plane.scales, strict=True):
        ticks = (decades if scale == LOG10 else round_values)(places[0], places[-1])
        found.append({"label": label, "values": places, "ticks": ticks, "logarithmic": scale == LOG10})
    return found


def _scales(loss: np.ndarray[Any, Any], below: Sequence[float]) -> dict[str, dict[str, Any]]:
    """Return the possible scales of a map's colours, or of a line's height, which includes the losses `below` it.

    There is a logarithmic scale if all losses are positive.
    """
    scale, finite = Scale.of_loss(loss), loss[np.isfinite(loss)]
    low, high = scale.ends
    found = {LINEAR: Scale.between(low, high, extend=scale.extend)}
    if loss.ndim == 1 and finite.size:
        low, high = min([float(finite.min()), *below]), float(finite.max())
        room = 0.04 * (high - low) or 0.5
        found = {LINEAR: Scale.between(low - room, high + room)}
    if finite.size and 0 < low < high and finite.min() > 0:
        found[LOGARITHMIC] = Scale.between(low, high, logarithmic=True, extend=scale.extend)
    names = ("low", "high", "logarithmic", "extend", "ticks")
    return {
        name: dict(zip(names, (*one.ends, one.logarithmic, one.extend, one.ticks()), strict=True))
        for name, one in found.items()
    }


def round_off(values: np.ndarray[Any, Any]) -> list[float | None]:
    """Return numbers with six digits, None for those that are not finite."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in values.tolist()]


def lay_runs(dataset: xr.Dataset, tables: Sequence[xr.Dataset]) -> list[Trajectory]:
    """Project runs onto a slice, the lowest loss first. Raises ValueError if one searched other parameters."""
    runs = [lay(dataset, table, f"{table.attrs['method']}, seed {table.attrs['seed']}") for table in tables]
    reach = farthest_distance(runs)
    points = sum(run.sizes["evaluation"] for run in runs)
    top = math.inf if "v" in dataset.dims else float(dataset["loss"].max())  # of what a line's map shows
    laid = [_trajectory(run, reach, points, top) for run in runs]
    return sorted(laid, key=lambda run: math.inf if run.best is None else run.best)


def _trajectory(run: xr.Dataset, reach: float, points: int, top: float) -> Trajectory:
    loss, distance = run["loss"].to_numpy(), run["distance"].to_numpy()
    outside = run["outside"].to_numpy() | (loss > top)
    lost = failed(run["status"].to_numpy())
    radius = np.sqrt(point_areas(distance, reach, points) / np.pi) * 4 / 3  # a point is 4/3 of a pixel
    return Trajectory(
        **{name: run.attrs[name] for name in ("method", "seed", "label", "fidelity", "budget")},
        colour=method(run)["color"],
        episodes=run.sizes["evaluation"],
        best=float(np.nanmin(loss)) if np.isfinite(loss).any() else None,
        outside=int(outside.sum()),
        failed=int(lost.sum()),
        distance=(float(distance.min()), float(distance.max())),
        command=stored_provenance(run).get("command", ""),
        u=round_off(run["u"].to_numpy()),
        v=round_off(run["v"].to_numpy()) if "v" in run else None,
        loss=round_off(loss),
        radius=[round(float(size), 1) for size in radius],
        path=improvements(run).tolist(),
        hidden=np.flatnonzero(outside).tolist(),
        far=np.flatnonzero(distance > FAR).tolist(),
    )
