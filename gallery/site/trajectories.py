"""The searches that a page lays over its slice."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from ...landscapes.identity import stored_identity, stored_provenance
from ...landscapes.objective import failed
from ...landscapes.overlay import improvements, lay
from ..files import RUN_SUFFIX, RUNS
from ..runs import open_run, searched
from .manifest import Trajectory
from .page_data import round_off


def read_runs(data: Path) -> list[xr.Dataset]:
    """Return every run that `save_run` left in the gallery's data and that has an episode."""
    tables = [open_run(file) for file in sorted((data / RUNS).glob(f"*/*{RUN_SUFFIX}"))]
    return [table for table in tables if table.sizes["evaluation"]]


def lay_runs(dataset: xr.Dataset, tables: Sequence[xr.Dataset]) -> list[Trajectory]:
    """Lay the runs of a slice's environment and options over it, the least loss first."""
    from ...landscapes.draw.figures.overlay import farthest_distance

    own = [table for table in tables if searched(stored_identity(table), stored_identity(dataset))]
    runs = [lay(dataset, table, f"{table.attrs['method']}, seed {table.attrs['seed']}") for table in own]
    reach = farthest_distance(runs)
    points = sum(run.sizes["evaluation"] for run in runs)
    top = math.inf if "v" in dataset.dims else float(dataset["loss"].max())  # of what a line's map shows
    laid = [_trajectory(run, reach, points, top) for run in runs]
    return sorted(laid, key=lambda run: math.inf if run.best is None else run.best)


def _trajectory(run: xr.Dataset, reach: float, points: int, top: float) -> Trajectory:
    from ...landscapes.draw.style import method, point_areas

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
    )
