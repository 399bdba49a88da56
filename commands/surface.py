"""`landscape surface`: draw a slice as a lit surface."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .arguments import Print


def surface(
    slice_: Annotated[str, typer.Argument(metavar="SLICE", help="A slice's folder.")],
    runs: Annotated[
        list[str] | None, typer.Argument(metavar="[RUN]...", help="Folders of runs, or of a race for all of its runs.")
    ] = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the surface.")
    ] = None,
    print_: Print = None,
) -> None:
    """Draw a slice as a lit surface whose height and colour are the loss, with runs draped on it.

    The folder then holds surface.png, and surface.gltf, which any viewer of 3-D models turns around. A sample that
    failed is a hole.

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
