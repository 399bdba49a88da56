"""`landscape overlay`: draw runs over a slice."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .arguments import Device, Of, Print


def overlay(
    slice_: Annotated[str, typer.Argument(metavar="SLICE", help="Folder of the slice.")],
    runs: Annotated[
        list[str],
        typer.Argument(
            metavar="RUN",
            help="Folders of runs or of races, or CSV and Parquet tables of points. A table has a column "
            "per parameter, with its name, and a column loss, or is what Optuna's trials_dataframe() "
            "returns.",
        ),
    ],
    env: Of = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results. The default is named after the overlay, under out/.")
    ] = None,
    print_: Print = None,
    through: Annotated[
        str | None,
        typer.Option(
            help="Sample a new slice through a point: best for the best of all runs, the folder of a run "
            "for its best, or any point of `landscape slice --through`."
        ),
    ] = None,
    plane: Annotated[
        str | None, typer.Option(help="Sample a new slice along the two principal directions of the runs: pca.")
    ] = None,
    resolution: Annotated[
        int | None,
        typer.Option(min=2, help="Number of points along each axis of a new slice. The default is that of SLICE."),
    ] = None,
    device: Device = "auto",
    spawn: Annotated[bool, typer.Option("--spawn", help="Open the overlay in the rerun viewer.")] = False,
    serve: Annotated[
        bool, typer.Option("--serve", help="Serve the overlay to a browser on this machine, until Ctrl-C.")
    ] = False,
) -> None:
    """Draw runs over a slice, with their distance from its plane.

    The folder then holds overlay.png, and overlay.rrd to walk around in and to play back. It also says how many points
    the slice does not show.

    Example: landscape overlay out/fluid-6-8 out/race-fluid --through best
    """
    from ..envs.registry import refuse_unknown
    from ..landscapes.storage.paths import refuse_missing

    refuse_missing(slice_, "slice")
    for run in runs:
        if not Path(run).suffix:  # a table is looked for by whoever reads it
            refuse_missing(run, "run")
    if env is not None:
        refuse_unknown(env)
    from ..api.slice import open_slice
    from ..jobs.foreign import tables_over
    from ..jobs.overlay import STREAM, Cut, OverlayJob
    from .terminal import Bars, command_line
    from .view import check_display, show_recording

    bars, cut = Bars(), Cut.of(through, plane, resolution)
    how: dict[str, Any] = {"out": Path(out) if out else None, "prints": print_ or [], "watch": bars, "device": device}
    beneath = open_slice(slice_, env=env)
    job = OverlayJob.of(beneath, tables_over(beneath, runs, bars), command=command_line(), cut=cut, **how)
    recording = job.folder / STREAM
    if spawn and not serve:
        check_display(recording, "leave out --spawn, or take --serve to look at it in a browser")
    drawn = job.run(bars)
    bars.note(f"{drawn.summary.outcome()}\n{drawn.folder}: {', '.join(drawn.files)}")
    if spawn or serve:
        show_recording(recording, bars, serve=serve)
