"""`landscape export`: write a slice or a run as a file that other programs read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def export(
    what: Annotated[str, typer.Argument(metavar="SLICE|RUN", help="The folder of a slice or of a run.")],
    to: Annotated[str, typer.Option(help="csv, parquet or netcdf.")] = "csv",
    out: Annotated[str | None, typer.Option(help="The file to write; by default one beside the slice or run.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file where it exists already.")] = False,
) -> None:
    """Write a slice or a run as a table that other programs read.

    The file has a row for each sample or episode, and columns with units; it is slice.csv or run.csv in the folder,
    unless --out says another. netCDF holds the arrays themselves, with names, units and how they were made.

    Example: landscape export out/my-run --to parquet
    """
    from ..landscapes.storage.paths import refuse_missing

    refuse_missing(what, "slice and no run")
    from ..jobs.export import export as write
    from .terminal import Bars

    Bars().note(write(Path(what), to, out=Path(out) if out else None, force=force).outcome())
