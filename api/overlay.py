"""`gs.overlay`: lay runs over a slice."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .progress import default_watch
from .slice import open_slice

if TYPE_CHECKING:
    import xarray as xr

    from ..jobs.overlay import Overlay
    from ..landscapes.slice import Slice
    from ..optim.runs.run import Run


def overlay(
    slice: str | Path | Slice,
    runs: str | Path | Run | Sequence[str | Path | Run],
    *,
    through: str | None = None,
    plane: str | None = None,
    resolution: int | None = None,
    device: str = "auto",
    out: str | Path | None = None,
) -> Overlay:
    """Lay runs over a slice of a plane: where their points lie, how far off it, and what the slice shows there.

    Slice and runs are folders, a race's for all of its runs, or what `gradscape.slice` and `gradscape.optimize` return.
    The slice is cut anew `through` the best point of all runs (best) or of one run's folder, and along the runs' two
    principal directions with `plane` pca, with `resolution` points along each axis, on `device`. The files lie in the
    folder `out`, by default one under out/ named after the overlay.

    Raises ValueError for runs of other landscapes than the slice's, for a slice of a line, where there is no slice or
    run, and where the folder holds something else; Stopped where it is interrupted.
    """
    from ..jobs.overlay import Cut, OverlayJob

    watch, cut = default_watch(), Cut.of(through, plane, resolution)
    several = [runs] if isinstance(runs, str | Path) or not isinstance(runs, Sequence) else list(runs)
    job = OverlayJob.of(
        open_slice(slice) if isinstance(slice, str | Path) else slice,
        _tables(several),
        command="gradscape.overlay(...)",
        cut=cut,
        device=device,
        out=Path(out) if out is not None else None,
        watch=watch,
    )
    return job.run(watch)


def _tables(runs: Sequence[str | Path | Run]) -> list[xr.Dataset]:
    """Return what runs evaluated, first of those on disk; those without an episode are left out."""
    from ..jobs.folder import run_tables

    paths = [str(run) for run in runs if isinstance(run, str | Path)]
    given = [run.data for run in runs if not isinstance(run, str | Path)]
    tables = [*(run_tables(paths) if paths else []), *(data for data in given if data.sizes["evaluation"])]
    if not tables:
        raise ValueError("there are no episodes yet in these runs; `gradscape.optimize` evaluates them")
    return tables
