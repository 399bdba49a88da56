"""What a page needs of a slice: its numbers, its nodes for the map to hover over, and its films."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from ...jobs.slice import count_statuses, flat_points
from ...landscapes.convert import to_json
from ...landscapes.identity import plane_of
from ...landscapes.lattice import own_cells
from ...landscapes.measures.undersampled import Undersampled, contradicted_cells
from ...landscapes.objective import NOT_EVALUATED, Status
from ...landscapes.plain import number
from ...landscapes.plane import Plane
from ...landscapes.space import LOG10
from ...landscapes.storage.records import read_json, reading
from ..files import EPISODE_KINDS, EPISODES, MEASURES, REMAKE, SWEEP_FILM, SWEEP_RECORD
from ..records import Node, SweepRecord, read_nodes
from .manifest import Axis, ColourScale, EpisodeEntry, Nodes, Numbers, Trajectory

LINEAR, LOGARITHMIC = "linear", "logarithmic"


def count_numbers(dataset: xr.Dataset) -> Numbers:
    """Count how the points of a slice ended, and find the range of their losses."""
    loss, status, flat = dataset["loss"].to_numpy(), dataset["status"].to_numpy(), flat_points(dataset)
    between = Undersampled.of(dataset)
    finite, evaluated = loss[np.isfinite(loss)], int(np.isin(status, NOT_EVALUATED, invert=True).sum())
    return Numbers(
        points=int(status.size),
        status=count_statuses(dataset),
        lowest=float(finite.min()) if finite.size else None,
        highest=float(finite.max()) if finite.size else None,
        flat=None if flat is None or not evaluated else flat / evaluated,
        undersampled=to_json(between.share) if between else None,
    )


def read_off_nodes(dataset: xr.Dataset, episodes: Sequence[EpisodeEntry], runs: Sequence[Trajectory]) -> Nodes:
    """Read off a slice what the map draws and says of its nodes."""
    from ...landscapes.draw.render.relief import Relief, azimuth
    from ...landscapes.draw.style import LOSS_MAP, Scale

    plane, loss = plane_of(dataset), dataset["loss"].to_numpy()
    own = Scale.of_loss(loss)
    nodes = Nodes(
        axes=_axes(plane),
        unit=str(dataset["loss"].attrs.get("units", "")),
        loss=pack(loss),
        status=pack(dataset["status"].to_numpy(), "u1"),
        statuses={int(code): code.name for code in Status},
        scale=LOGARITHMIC if own.logarithmic and plane.rank == 2 else LINEAR,
        scales=_scales(loss, [run.best for run in runs if run.best is not None]),
        palette=[bytes(round(255 * part) for part in LOSS_MAP(level)[:3]).hex() for level in range(256)],
        episodes=episodes,
        runs=runs,
        azimuth=azimuth(Relief(plane, own), dataset) if plane.rank == 2 else None,
    )
    if (dataset["status"] == Status.INTERPOLATED).any() and plane.rank == 2:
        drawn = own_cells(dataset)
        nodes = replace(nodes, cells=pack(drawn["loss"].to_numpy()), looks=pack(drawn["status"].to_numpy(), "u1"))
    if "grad" not in dataset:
        return nodes
    grad = dataset["grad"].to_numpy().reshape(loss.size, -1)
    slope = [pack(column) for column in plane.slope(torch.from_numpy(grad)).numpy().T]
    finer = contradicted_cells(dataset) if plane.rank == 2 else np.zeros(0)
    return replace(
        nodes,
        slope=slope,
        gradient=pack(np.linalg.norm(grad, axis=1)),
        finer=pack(finer, "u1") if finer.any() else None,
    )


def pack(values: np.ndarray[Any, Any], kind: str = "f4") -> str:
    """Return an array, in its own order, as little-endian numbers in base64: a browser decodes it once."""
    return base64.b64encode(values.astype(f"<{kind}").tobytes()).decode()


def _axes(plane: Plane) -> list[Axis]:
    from ...landscapes.draw.style import decades, round_values

    found = list[Axis]()
    for label, places, scale in zip(plane.labels, (axis.tolist() for axis in plane.axes()), plane.scales, strict=True):
        ticks = (decades if scale == LOG10 else round_values)(places[0], places[-1])
        found.append(Axis(label, places, ticks, scale == LOG10))
    return found


def _scales(loss: np.ndarray[Any, Any], below: Sequence[float]) -> dict[str, ColourScale]:
    """Return the scales that a map's colours can have, or a line's height, which goes down to what lies below.

    A logarithmic one is there where all losses are positive.
    """
    from ...landscapes.draw.style import Scale

    scale, finite = Scale.of_loss(loss), loss[np.isfinite(loss)]
    low, high = scale.ends
    found = {LINEAR: Scale.between(low, high, logarithmic=False, extend=scale.extend)}
    if loss.ndim == 1 and finite.size:
        low, high = min([float(finite.min()), *below]), float(finite.max())
        room = 0.04 * (high - low) or 0.5
        found = {LINEAR: Scale.linear(low - room, high + room)}
    if finite.size and 0 < low < high and finite.min() > 0:
        found[LOGARITHMIC] = Scale.between(low, high, logarithmic=True, extend=scale.extend)
    return {name: ColourScale(*one.ends, one.logarithmic, one.extend, one.ticks()) for name, one in found.items()}


def read_episodes(folder: Path, dataset: xr.Dataset) -> list[EpisodeEntry]:
    """Return the episodes that `episodes.json` lists and that have a film or a picture, one a node."""
    listed = folder / EPISODES
    if not listed.exists():
        return []
    nodes = read_nodes(listed)
    with reading(listed, REMAKE.format("episodes")):  # a node may lie beyond the slice
        shown: dict[tuple[int, int], EpisodeEntry] = {}
        for node in nodes:
            place = (node.row, node.column)
            if place in shown:
                shown[place] = replace(shown[place], why=f"{shown[place].why}, {node.why}")
            else:
                shown[place] = _episode(node, folder, plane_of(dataset))
    return [episode for episode in shown.values() if episode.files]


def _episode(node: Node, folder: Path, plane: Plane) -> EpisodeEntry:
    place = torch.stack([axis[at] for axis, at in zip(plane.axes(), (node.column, node.row), strict=False)])
    at = dict(zip(plane.labels, plane.to_values(place).tolist(), strict=True))
    files = {kind: f"{node.name}.{kind}" for kind in EPISODE_KINDS}
    there = {kind: name for kind, name in files.items() if (folder / name).exists()}
    return EpisodeEntry(node.row, node.column, node.why, node.loss, node.status, at, **there)


def read_sweep(folder: Path) -> SweepRecord | None:
    """Return what the film of a sweep shows, None where there is no film or nothing is said of it."""
    there = (folder / SWEEP_FILM).exists() and (folder / SWEEP_RECORD).exists()
    return SweepRecord.read(folder / SWEEP_RECORD) if there else None


def read_measures(folder: Path) -> dict[str, str | float]:
    """Return the numbers of a slice's report by their names, none where there is no report."""
    path = folder / MEASURES
    if not path.exists():
        return {}
    with reading(path, REMAKE.format("reports")):
        found = read_json(path)
        return {name: value if isinstance(value, str) else number(value) for name, value in found.items()}


def round_off(values: np.ndarray[Any, Any]) -> list[float | None]:
    """Return numbers to six digits, None for what is not finite."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in values.tolist()]
