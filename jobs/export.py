"""A slice or a run in a results folder as a file that other programs read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from .folder import RUN_STORE, SLICE_STORE, store_in

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Export:
    """Record the file that was written: `rows` of a `kind`, of which `missing` are not sampled yet."""

    path: Path
    kind: str
    rows: int
    missing: int

    def outcome(self) -> str:
        """Say in a line what was written."""
        so_far = f"; {self.missing} of them are not sampled yet" if self.missing else ""
        return f"{self.path}: {self.rows} {self.kind}{so_far}"


def export(source: Path, to: str, *, out: Path | None = None, force: bool = False) -> Export:
    """Write the slice or the run in a folder as csv, parquet or netcdf to `out`, by default next to it.

    Raises ValueError for another format, where there is no slice and no run, and where the file exists already, which
    `force` replaces.
    """
    from ..landscapes.export import SUFFIXES, save_as
    from ..landscapes.storage.paths import folder_path

    if to not in SUFFIXES:
        raise ValueError(f"--to takes {', '.join(SUFFIXES)}; got {to!r}")
    dataset, store = open_results(source)
    path = out or folder_path(store).with_suffix(SUFFIXES[to])
    if path.exists() and not force:
        raise ValueError(f"{path} exists already; write elsewhere with --out, or replace it with --force")
    save_as(dataset, path, to)
    kind = "episodes" if "x" in dataset else "samples"
    return Export(path, kind, dataset["loss"].size, int((dataset["status"] == 0).sum()))


def open_results(path: Path) -> tuple[xr.Dataset, Path]:
    """Return what is in a results folder or a store, and where the store is.

    Raises ValueError where that is no slice and no run, and StoreError where it is damaged.
    """
    from ..landscapes.storage.paths import finished_path, is_slice
    from ..landscapes.storage.store import open_slice
    from ..optim.runs.store import RunStore, is_run

    slice_, run = store_in(path, SLICE_STORE), store_in(path, RUN_STORE)
    if is_slice(slice_) or slice_ != path:  # one that is damaged is refused by what opens it
        return open_slice(slice_), finished_path(slice_)
    if is_run(run) or run != path:
        return RunStore.open(run).dataset(), run
    raise ValueError(
        f"{path} is neither a slice nor a run; give the folder that `landscape slice` or `landscape optimize` wrote"
    )
