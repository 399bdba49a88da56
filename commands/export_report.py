"""What `landscape export` does and prints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..jobs.folder import RUN_STORE as RUN
from ..jobs.folder import SLICE_STORE as SLICE
from ..jobs.folder import store_in as inside
from .terminal import Console

if TYPE_CHECKING:
    import xarray as xr


def export(what: str, *, to: str, out: str | None, force: bool) -> None:
    """Write a slice or a run as a file that other programs read."""
    from ..landscapes.export import SUFFIXES, save_as

    if to not in SUFFIXES:
        raise ValueError(f"--to takes {', '.join(SUFFIXES)}; got {to!r}")
    dataset, store = _read(Path(what))
    path = Path(out) if out else store.with_suffix(SUFFIXES[to])
    if path.exists() and not force:
        raise ValueError(f"{path} exists already; write elsewhere with --out, or replace it with --force")
    save_as(dataset, path, to)
    rows = dataset["loss"].size
    missing = int((dataset["status"] == 0).sum())
    so_far = f"; {missing} of them are not sampled yet" if missing else ""
    kind = "episodes" if "x" in dataset else "samples"
    Console(stderr=True, soft_wrap=True, highlight=False).print(f"{path}: {rows} {kind}{so_far}", markup=False)


def _read(path: Path) -> tuple[xr.Dataset, Path]:
    """Return what is in a results folder or a store, and where the store is."""
    from ..landscapes.storage.paths import finished_path, is_slice
    from ..landscapes.storage.store import open_slice
    from ..optim.run import is_run, open_run

    slice_, run = inside(path, SLICE), inside(path, RUN)
    if is_slice(slice_) or slice_ != path:  # one that is damaged is refused by what opens it
        return open_slice(slice_), finished_path(slice_)
    if is_run(run) or run != path:
        return open_run(run), run
    raise ValueError(f"{path} is no slice and no run; give the folder that `landscape slice` or `optimize` left")
