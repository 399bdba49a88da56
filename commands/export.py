"""`landscape export`: write a slice or a run as a file that other programs read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def export(
    what: Annotated[str, typer.Argument(metavar="SLICE|RUN", help="Folder of a slice or of a run.")],
    to: Annotated[str, typer.Option(help="Format to write: csv, parquet or netcdf.")] = "csv",
    out: Annotated[str | None, typer.Option(help="File to write. The default lies beside the slice or run.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists already.")] = False,
) -> None:
    """Write a slice or a run as CSV, Parquet or netCDF, for other programs.

    A table has a row per sample or episode, and columns with units. netCDF holds the arrays with names, units and
    provenance. The default file is slice.csv or run.csv in the folder.

    Example: landscape export out/my-run --to parquet
    """
    from ..landscapes.storage.paths import refuse_missing

    refuse_missing(what, "slice and no run")
    from ..jobs.export import export as write
    from .terminal import Bars

    Bars().note(write(Path(what), to, out=Path(out) if out else None, force=force).outcome())
