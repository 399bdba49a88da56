"""What a page needs of a slice: its numbers, its nodes for the map to hover over, and its films."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from ...jobs.slice import flat_points
from ...landscapes.identity import plane_of
from ...landscapes.objective import Status
from ...landscapes.storage.records import number, optional, read_json, reading, text, verify

EPISODES = "episodes.json"
REMAKE = "delete it, and `landscape gallery compute --part {}` makes it anew"


def numbers(dataset: xr.Dataset) -> dict[str, Any]:
    """Return loss range, how many evaluations ended how, and the share of them whose gradient is exactly zero."""
    loss, status = dataset["loss"].to_numpy(), dataset["status"].to_numpy()
    finite = loss[np.isfinite(loss)]
    evaluated = int((status != Status.MISSING).sum())
    flat = flat_points(dataset)
    return {
        "points": int(status.size),
        "status": {kind.name.lower(): int((status == kind).sum()) for kind in Status},
        "lowest": float(finite.min()) if finite.size else None,
        "highest": float(finite.max()) if finite.size else None,
        "flat": None if flat is None or not evaluated else flat / evaluated,
    }


def nodes(dataset: xr.Dataset, episodes: Sequence[dict[str, Any]], runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return a slice as plain lists, row by row from the lowest v: what the map draws and says of a node.

    `slope` is the gradient along the axes, `gradient` its length in all dimensions; `azimuth` is where the surface is
    seen from at first [degrees].
    """
    from ...landscapes.draw.render.relief import Relief, azimuth
    from ...landscapes.draw.style import LOSS_MAP, Scale, round_values

    plane, loss = plane_of(dataset), dataset["loss"].to_numpy()
    labelled = zip(plane.labels, (axis.tolist() for axis in plane.axes()), strict=True)
    found: dict[str, Any] = {
        "axes": [
            {"label": label, "values": values, "ticks": round_values(values[0], values[-1])}
            for label, values in labelled
        ],
        "unit": str(dataset["loss"].attrs.get("units", "")),
        "loss": rounded(loss.ravel()),
        "status": [Status(code).name for code in dataset["status"].to_numpy().ravel()],
        "scale": _scale(loss, [run["best"] for run in runs if run["best"] is not None]),
        "palette": [bytes(round(255 * part) for part in LOSS_MAP(number)[:3]).hex() for number in range(256)],
        "episodes": list(episodes),
        "runs": list(runs),
    }
    if plane.rank == 2:
        found["azimuth"] = azimuth(Relief(plane, Scale.of_loss(loss)), dataset)
    if "grad" in dataset:
        grad = dataset["grad"].to_numpy().reshape(loss.size, -1)
        found["slope"] = [rounded(column) for column in plane.slope(torch.from_numpy(grad)).numpy().T]
        found["gradient"] = rounded(np.linalg.norm(grad, axis=1))
    return found


def _scale(loss: np.ndarray[Any, Any], below: Sequence[float]) -> dict[str, Any]:
    """Return the scale of a map's colours, or of a line's height: that is linear and goes down to what lies below."""
    from ...landscapes.draw.style import Scale

    scale = Scale.of_loss(loss)
    if loss.ndim == 1 and np.isfinite(loss).any():
        low, high = float(np.nanmin([*loss, *below])), float(np.nanmax(loss))
        room = 0.04 * (high - low) or 0.5
        scale = Scale.linear(low - room, high + room)
    return {
        "low": float(scale.norm.vmin or 0.0),
        "high": float(scale.norm.vmax or 0.0),
        "logarithmic": scale.logarithmic,
        "extend": scale.extend,
        "ticks": scale.ticks(),
    }


def read_episodes(folder: Path, dataset: xr.Dataset) -> list[dict[str, Any]]:
    """Return the episodes that `episodes.json` lists, one a node, with their files and the parameters varied."""
    listed = folder / EPISODES
    if not listed.exists():
        return []
    with reading(listed, REMAKE.format("episodes")):
        plane = plane_of(dataset)
        axes = [axis.tolist() for axis in plane.axes()]
        found: dict[tuple[int, int], dict[str, Any]] = {}
        for said in map(verify, json.loads(listed.read_text())):
            row, column = place = int(said["row"]), int(said["column"])
            if place in found:
                found[place]["why"] += ", " + text(said["why"])
                continue
            files = {kind: f"episode-{row}-{column}.{kind}" for kind in ("mp4", "webp")}
            found[place] = {
                **{"row": row, "column": column, "why": text(said["why"])},
                **{"loss": optional(number, said["loss"]), "status": Status[said["status"]].name},
                "at": {
                    label: axis[_counted(at)]
                    for label, axis, at in zip(plane.labels, axes, (column, row), strict=False)
                },
                **{kind: name for kind, name in files.items() if (folder / name).exists()},
            }
    return [episode for episode in found.values() if "mp4" in episode or "webp" in episode]


def read_sweep(folder: Path) -> dict[str, Any]:
    """Return what `sweep.json` says of the film beside it, nothing where there is none."""
    path = folder / "sweep.json"
    if not path.exists():
        return {}
    with reading(path, REMAKE.format("sweeps")):
        found = read_json(path)
        for name in ("label", "fidelity", "command"):
            text(found[name])
        for value in (found["low"], found["high"], found["frames"], *found["resolution"]):
            number(value)
        if not found["label"]:
            raise ValueError("its label is empty")
    return found


def read_measures(path: Path) -> dict[str, str | float]:
    """Return the numbers of a slice's report by their names, none where there is no report."""
    if not path.exists():
        return {}
    with reading(path, REMAKE.format("reports")):
        found = read_json(path)
        return {name: value if isinstance(value, str) else number(value) for name, value in found.items()}


def _counted(place: int) -> int:
    if place < 0:
        raise ValueError(f"a place is counted from 0; got {place}")
    return place


def rounded(values: np.ndarray[Any, Any]) -> list[float | None]:
    """Return numbers to six digits, None for what is not finite."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in values.tolist()]
