"""`gs.overlay`: lay runs over a slice."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..jobs.watch import Watch
from .progress import default_watch

if TYPE_CHECKING:
    import xarray as xr

    from ..envs.base import Environment
    from ..jobs.overlay import Overlay, OverlayJob
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
    watch = default_watch()
    several = [runs] if isinstance(runs, str | Path) or not isinstance(runs, Sequence) else list(runs)
    return open_overlay(
        slice, several, through=through, plane=plane, resolution=resolution, device=device,
        out=Path(out) if out else None, command="gradscape.overlay(...)", watch=watch,
    ).run(watch)  # fmt: skip


def open_overlay(
    slice: str | Path | Slice,
    runs: Sequence[str | Path | Run],
    *,
    through: str | None,
    plane: str | None,
    resolution: int | None,
    device: str,
    out: Path | None,
    command: str,
    watch: Watch,
    prints: Sequence[float] = (),
) -> OverlayJob:
    """Open what `overlay` runs, and refuse what does not belong together; what more there is belongs to the command."""
    from ..jobs.folder import SLICE_STORE, store_in
    from ..jobs.overlay import Cut, OverlayJob
    from ..jobs.scene import environment_of
    from ..landscapes.slice import Slice
    from ..landscapes.storage.store import open_slice

    cut = Cut.of(through, plane, resolution)
    if not isinstance(slice, Slice):
        slice = Slice(open_slice(store_in(Path(slice), SLICE_STORE)), Path(slice))
    data, remake = slice.data, slice.remake

    def make() -> Environment:
        from ..envs.base import Environment

        env = remake() if remake else None
        return env if isinstance(env, Environment) else environment_of(data, device)

    how: dict[str, Any] = {"cut": cut, "out": out, "prints": prints, "watch": watch}
    return OverlayJob.of(slice, _tables(runs), remake=make, command=command, **how)


def _tables(runs: Sequence[str | Path | Run]) -> list[xr.Dataset]:
    """Return what runs evaluated, first of those on disk; those without an episode are left out."""
    from ..jobs.folder import run_tables

    paths = [str(run) for run in runs if isinstance(run, str | Path)]
    given = [run.data for run in runs if not isinstance(run, str | Path)]
    tables = [*(run_tables(paths) if paths else []), *(data for data in given if data.sizes["evaluation"])]
    if not tables:
        raise ValueError("there are no episodes yet in these runs; `gradscape.optimize` evaluates them")
    return tables
