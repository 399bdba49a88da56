"""The searches that a page lays over its slice."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ...landscapes.identity import stored_identity, stored_provenance
from ...landscapes.objective import Status
from ...landscapes.overlay import improvements, lay
from ..runs import SUFFIX, open_run
from .page_data import rounded


def read_runs(root: Path) -> list[xr.Dataset]:
    """Return every run that `save_run` left under `root/ENVIRONMENT-OPTIONS/` and that has an episode."""
    tables = [open_run(file) for file in sorted(root.glob(f"*/*{SUFFIX}"))]
    return [table for table in tables if table.sizes["evaluation"]]


def trajectories(dataset: xr.Dataset, tables: Sequence[xr.Dataset]) -> list[dict[str, Any]]:
    """Lay the runs of a slice's environment and options over it, the least loss first.

    Of every point, in the order of evaluation: where it falls, its own loss, how large its mark is [pixels] (the
    smaller, the farther off the slice), whether it is beyond the map and whether it failed. `path` holds the points
    that were the best so far.
    """
    from ...landscapes.draw.figures.overlay import farthest_distance

    own = [table for table in tables if _same(stored_identity(table), stored_identity(dataset))]
    runs = [lay(dataset, table, f"{table.attrs['method']}, seed {table.attrs['seed']}") for table in own]
    reach = farthest_distance(runs)
    points = sum(run.sizes["evaluation"] for run in runs)
    top = float("inf") if "v" in dataset.dims else float(dataset["loss"].max())  # of what a line's map shows
    found = [_trajectory(run, reach, points, top) for run in runs]
    return sorted(found, key=lambda run: float("inf") if run["best"] is None else run["best"])


def _same(run: dict[str, Any], slice_: dict[str, Any]) -> bool:
    """Whether a run searched a slice's scene; an option that one of them was made without does not tell them apart."""
    ours, theirs = run.get("options", {}), slice_.get("options", {})
    shared = set(ours) & set(theirs)
    same = run["objective"] == slice_["objective"] and run["parameters"] == slice_["parameters"]
    return same and all(ours[name] == theirs[name] for name in shared)


def _trajectory(run: xr.Dataset, reach: float, points: int, top: float) -> dict[str, Any]:
    from ...landscapes.draw.style import method, point_areas

    loss, distance = run["loss"].to_numpy(), run["distance"].to_numpy()
    outside = run["outside"].to_numpy() | (loss > top)
    failed = run["status"].to_numpy() != Status.OK
    radius = np.sqrt(point_areas(distance, reach, points) / np.pi) * 4 / 3  # a point is 4/3 of a pixel
    return {
        "method": run.attrs["method"],
        "seed": run.attrs["seed"],
        "label": run.attrs["label"],
        "fidelity": run.attrs["fidelity"],
        "colour": method(run)["color"],
        "budget": run.attrs["budget"],
        "episodes": run.sizes["evaluation"],
        "best": float(np.nanmin(loss)) if np.isfinite(loss).any() else None,
        "outside": int(outside.sum()),
        "failed": int(failed.sum()),
        "distance": [float(distance.min()), float(distance.max())],
        "command": stored_provenance(run).get("command", ""),
        **{name: rounded(run[name].to_numpy()) for name in ("u", "v", "loss") if name in run},
        "radius": [round(float(size), 1) for size in radius],
        "path": improvements(run).tolist(),
        "hidden": np.flatnonzero(outside).tolist(),
    }
