"""`gs.surface`: draw a slice as a lit surface."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from .call import current, verb
from .options import ARGUMENT, FigureWidth, Out
from .values import as_path, as_widths


@verb
def surface(
    slice: Annotated[str | Path, ARGUMENT],
    runs: Annotated[Sequence[str], ARGUMENT] = (),
    *,
    figure_width_mm: FigureWidth = (),
    out: Out = None,
) -> Path:
    """Draw a slice as a lit surface with the loss as height and colour, and runs on top.

    The folder then contains surface.png, and surface.gltf for any viewer of 3-D models. Failed samples are holes. In
    Python it returns the folder.

    Raises ValueError if there is no slice or run, or if a run searched another landscape.

    Example: landscape surface out/my-slice out/my-run

    Parameters
    ----------
    slice
        Folder of the slice.
    runs
        Folders of runs, or of a race for all of its runs.
    """
    from ..landscapes.storage.paths import refuse_missing

    refuse_missing(str(slice), "slice")
    for run in runs:
        refuse_missing(run, "run")
    from ..jobs.surface import SurfaceJob

    job = SurfaceJob.of(Path(slice), runs, as_path(out), prints=as_widths(figure_width_mm))
    return job.run(current().watch)
