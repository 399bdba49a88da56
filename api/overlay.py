"""`gs.overlay`: draw runs over a slice."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from .call import current, verb
from .options import ARGUMENT, Device, FigureWidth, Of, Out, Side
from .slice import as_slice
from .values import as_path, as_widths

if TYPE_CHECKING:
    from typing import TypeAlias

    from ..jobs.overlay import Overlay
    from ..landscapes.slice import Slice

    SliceFolder: TypeAlias = str | Path | Slice
    RunFolders: TypeAlias = Any  # folders, runs, tables of pandas, studies of Optuna, experiments of Ax, one or several
else:
    SliceFolder, RunFolders = str, list[str]


@verb
def overlay(
    slice: Annotated[SliceFolder, ARGUMENT],
    runs: Annotated[RunFolders, ARGUMENT],
    *,
    env: Of = None,
    through: str | None = None,
    plane: Literal["pca"] | None = None,
    resolution: Side | None = None,
    device: Device = "auto",
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    spawn: bool = False,
    serve: bool = False,
) -> Overlay:
    """Draw runs over a slice, with their distance from its plane.

    The folder then contains overlay.png, and overlay.rrd, a 3-D recording to move around in and to play back. It prints
    how many points are outside the map. In Python, runs can also be results of `gradscape.optimize`, pandas tables, an
    Optuna study, or an Ax experiment or its client. If a study maximises, its values are negated. Rows without a number
    for each parameter are skipped and counted.

    Raises ValueError if a run searched another landscape, if the slice is a line, if a table lacks a column, has one
    twice or contains no point, or if the folder contains something else. Raises Stopped when it is interrupted.

    Example: landscape overlay out/fluid-6-8 out/race-fluid --through best

    Parameters
    ----------
    slice
        Folder of the slice.
    runs
        Folders of runs or of races, or CSV and Parquet tables of points. A table has a column with the name of each
        parameter and a column loss, or comes from Optuna's trials_dataframe().
    through
        Sample a new slice through a point: best for the best point of all runs, the folder of a run for its best point,
        or any point that `landscape slice --through` takes.
    plane
        Sample a new slice along the two principal directions of the runs: pca.
    resolution
        Number of points along each axis of a new slice. The default is that of SLICE.
    spawn
        Open the overlay in the rerun viewer.
    serve
        Serve the overlay to a browser on this machine, until Ctrl-C.
    """
    several = [runs] if isinstance(runs, str | Path) or not isinstance(runs, Sequence) else list(runs)
    from ..landscapes.storage.paths import refuse_missing

    if isinstance(slice, str | Path):
        refuse_missing(str(slice), "slice")
    for run in several:
        if isinstance(run, str | Path) and not Path(run).suffix:  # a table is looked for by whoever reads it
            refuse_missing(str(run), "run")
    if isinstance(env, str):
        from ..envs.registry import refuse_unknown

        refuse_unknown(env)
    from ..jobs.foreign import tables_over
    from ..jobs.overlay import STREAM, OverlayJob, OverlayPlane
    from .view import check_display, show_recording

    call, new = current(), OverlayPlane.of(through, plane, resolution)  # type: ignore[arg-type] # one number for both axes
    beneath = as_slice(slice, env=env)
    job = OverlayJob.of(
        beneath, tables_over(beneath, several, call.watch), command=call.command, plane=new, device=device,
        out=as_path(out), prints=as_widths(figure_width_mm), watch=call.watch,
    )  # fmt: skip
    recording = job.folder / STREAM
    if spawn and not serve:
        check_display(recording, "leave out --spawn, or use --serve to open it in a browser")
    drawn = job.run(call.watch)
    if spawn or serve:
        show_recording(recording, serve=serve)
    return drawn
