"""`gs.overlay`: lay runs over a slice."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .progress import default_watch
from .slice import open_slice

if TYPE_CHECKING:
    from typing import Protocol, TypeAlias

    import pandas as pd

    from ..jobs.overlay import Overlay
    from ..landscapes.slice import Slice
    from ..optim.runs.run import Run

    class Study(Protocol):
        """An Optuna study, as far as an overlay knows it."""

        study_name: str

        def trials_dataframe(self, attrs: tuple[str, ...]) -> pd.DataFrame:
            """Return its trials as a table."""

    class Experiment(Protocol):
        """An experiment of Ax, or a client that holds one, as far as an overlay knows it."""

        name: str

        def lookup_data(self) -> Any:
            """Return what its metrics measured."""

    Points: TypeAlias = str | Path | Run | pd.DataFrame | Study | Experiment


def overlay(
    slice: str | Path | Slice,
    runs: Points | Sequence[Points],
    *,
    through: str | None = None,
    plane: str | None = None,
    resolution: int | None = None,
    device: str = "auto",
    out: str | Path | None = None,
) -> Overlay:
    """Lay runs over a slice of a plane: where their points lie, how far off it, and what the slice shows there.

    Slice and runs are folders, a race's for all of its runs, or what `gradscape.slice` and `gradscape.optimize` return.
    Points that another program evaluated are a CSV or Parquet file or a pandas table, with a column for each parameter,
    called as it is, and one called loss, which is missing where an evaluation failed; or an Optuna study, or what its
    `trials_dataframe()` returns; or an experiment of Ax, or its client. Values of a study or an experiment that
    maximises are negated, and its name says so. Rows without a number for each parameter are skipped and counted.
    The slice is cut anew `through` the best point of all runs (best) or of one run's folder, or any other point that
    `gradscape.slice` goes through by its name, and along the runs' two principal directions with `plane` pca, with
    `resolution` points along each axis, on `device`. The files lie in the folder `out`, by default one under out/ named
    after the overlay.

    Raises ValueError for runs of other landscapes than the slice's, for a slice of a line, where there is no slice or
    run, where a table lacks a column, has one twice or holds no point, and where the folder holds something else;
    Stopped where it is interrupted.
    """
    from ..jobs.foreign import tables_over
    from ..jobs.overlay import Cut, OverlayJob

    watch, cut = default_watch(), Cut.of(through, plane, resolution)
    several = [runs] if isinstance(runs, str | Path) or not isinstance(runs, Sequence) else list(runs)
    beneath = open_slice(slice) if isinstance(slice, str | Path) else slice
    job = OverlayJob.of(
        beneath,
        tables_over(beneath, several, watch),
        command="gradscape.overlay(...)",
        cut=cut,
        device=device,
        out=Path(out) if out is not None else None,
        watch=watch,
    )
    return job.run(watch)
