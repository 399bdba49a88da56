"""Stores in the folders that verbs leave."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr

SLICE, RUN = "slice.zarr", "run.zarr"


def inside(path: Path, store: str) -> Path:
    """Return the store in a results folder, or the path itself."""
    return path / store if (path / store).exists() else path


def run_tables(paths: Sequence[str]) -> list[xr.Dataset]:
    """Return what runs, or all runs of races, evaluated; those without an episode are left out."""
    from .optim.run import Run

    tables = []
    for path in paths:
        found = [inside(Path(path), RUN)]
        if not Path(path, RUN).exists() and (members := sorted(Path(path).glob(f"*/{RUN}"))):
            found = members
        tables += [Run.open(store).table() for store in found]
    if not any(table.sizes["evaluation"] for table in tables):
        raise ValueError(f"{', '.join(paths)}: there are no episodes yet; `landscape optimize` evaluates them")
    return [table for table in tables if table.sizes["evaluation"]]
