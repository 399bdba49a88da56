"""`landscape surface`: draw a slice as a lit surface."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .arguments import Print


def surface(
    slice_: Annotated[str, typer.Argument(metavar="SLICE", help="Folder of the slice.")],
    runs: Annotated[
        list[str] | None, typer.Argument(metavar="[RUN]...", help="Folders of runs, or of a race for all of its runs.")
    ] = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results. The default is named after the surface, under out/.")
    ] = None,
    print_: Print = None,
) -> None:
    """Draw a slice as a lit surface with the loss as height and colour, and runs on top.

    The folder then holds surface.png, and surface.gltf for any viewer of 3-D models. Failed samples are holes.

    Example: landscape surface out/my-slice out/my-run
    """
    from ..landscapes.storage.paths import refuse_missing

    refuse_missing(slice_, "slice")
    for run in runs or ():
        refuse_missing(run, "run")
    from ..jobs.surface import SurfaceJob
    from .terminal import Bars

    bars = Bars()
    job = SurfaceJob.of(Path(slice_), runs or [], Path(out) if out else None)
    files = job.run(bars, print_ or [])
    bars.note(f"{job.folder}: {', '.join(files)}")
