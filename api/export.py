"""`gs.export`: write a slice or a run as a file that other programs read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from .call import current, verb
from .options import ARGUMENT, Force
from .values import as_path


@verb
def export(
    what: Annotated[str | Path, ARGUMENT],
    *,
    to: Literal["csv", "parquet", "netcdf"] = "csv",
    out: Annotated[str | Path | None, Parameter(help="File to write. The default is in the same folder.")] = None,
    force: Force = False,
) -> Path:
    """Write a slice or a run as CSV, Parquet or netCDF, for other programs.

    A table has a row per sample or episode, and columns with units. netCDF stores the arrays with names, units and
    provenance. The default file is slice.csv or run.csv in the folder. In Python it returns the path of the file.

    Raises ValueError if there is no slice or run, or if the file exists already.

    Example: landscape export out/my-run --to parquet

    Parameters
    ----------
    what
        Folder of a slice or of a run.
    to
        Format to write: csv, parquet or netcdf.
    """
    from ..landscapes.storage.paths import refuse_missing

    refuse_missing(str(what), "slice or run")
    from ..jobs.export import export as write

    written = write(Path(what), to, out=as_path(out), force=force)
    current().watch.note(written.outcome())
    return written.path
