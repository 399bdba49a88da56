"""What a page needs of a slice: its numbers, and its nodes for the map to hover over."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from ..landscapes.job import flat_points
from ..landscapes.objective import Status
from ..landscapes.store import plane_of

EPISODE = re.compile(r"episode-(\d+)(?:-(\d+))?\.(mp4|png)")


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


def nodes(dataset: xr.Dataset, folder: Path) -> dict[str, Any]:
    """Return a slice as plain lists, row by row from the lowest v: what the map draws and says of a node.

    `slope` is the gradient along the axes, `gradient` its length in all dimensions, `shade` a colour's number in
    `palette` (-1 where there is no loss). `episodes` and `runs` are what `folder` has of them.
    """
    plane, loss = plane_of(dataset), dataset["loss"].to_numpy()
    shade, palette = _shades(loss)
    labelled = zip(plane.labels, plane.axes(), strict=True)
    found: dict[str, Any] = {
        "axes": [{"label": label, "values": axis.tolist()} for label, axis in labelled],
        "unit": str(dataset["loss"].attrs.get("units", "")),
        "loss": _rounded(loss.ravel()),
        "status": [Status(code).name for code in dataset["status"].to_numpy().ravel()],
        "shade": shade,
        "palette": palette,
        "episodes": episodes(folder),
        "runs": _runs(folder),
    }
    if "grad" in dataset:
        grad = dataset["grad"].to_numpy().reshape(loss.size, -1)
        found["slope"] = [_rounded(column) for column in plane.slope(torch.from_numpy(grad)).numpy().T]
        found["gradient"] = _rounded(np.linalg.norm(grad, axis=1))
    return found


def episodes(folder: Path) -> list[dict[str, Any]]:
    """Return the episodes of a slice: `episode-ROW-COLUMN.mp4` or `.png` at a node, `episode-COLUMN` on a line."""
    found: dict[tuple[int, int], dict[str, Any]] = {}
    for file in sorted(folder.glob("episode-*")):
        if match := EPISODE.fullmatch(file.name):
            first, second, kind = int(match[1]), match[2], match[3]
            row, column = (first, int(second)) if second else (0, first)
            found.setdefault((row, column), {"row": row, "column": column})[kind] = file.name
    return [found[at] for at in sorted(found)]


def _runs(folder: Path) -> list[dict[str, Any]]:
    """Return the trajectories in `overlay.json`, a list of {method, u, v, loss}, each with its method's colour."""
    from ..landscapes.draw.style import METHODS, OTHER_METHOD

    path = folder / "overlay.json"
    runs = json.loads(path.read_text()) if path.exists() else []
    return [run | {"colour": METHODS.get(run["method"], OTHER_METHOD)["color"]} for run in runs]


def _shades(loss: np.ndarray[Any, Any]) -> tuple[list[int], list[str]]:
    from ..landscapes.draw.style import LOSS_MAP, Scale

    finite = np.isfinite(loss)
    share = np.clip(np.ma.getdata(Scale.of_loss(loss).norm(np.where(finite, loss, 1.0))), 0, 1)
    shade = np.where(finite, np.round(255 * share), -1).astype(int)
    palette = [bytes(round(255 * part) for part in LOSS_MAP(number)[:3]).hex() for number in range(256)]
    return shade.ravel().tolist(), palette


def _rounded(values: np.ndarray[Any, Any]) -> list[float | None]:
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in values.tolist()]
