"""`landscape sweep`: sample slices as something else moves, and film them."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from ..jobs.scene import SceneSpec
from .arguments import (
    Along,
    Extent,
    Gradients,
    Json,
    NoGradients,
    Resolution,
    Scheduler,
    SomeDims,
    Through,
    read_extent,
    refuse_words,
    takes_scene,
)


@takes_scene("tolerance")
def sweep(
    scene: SceneSpec,
    over: Annotated[
        str,
        typer.Option(
            help="What changes from frame to frame: a third parameter over its bounds, horizon, or smoothing."
        ),
    ],
    dims: SomeDims = None,
    along: Along = None,
    frames: Annotated[int, typer.Option(min=2, help="Number of frames, both ends included.")] = 24,
    resolution: Resolution = 16,
    through: Through = "center",
    extent: Extent = None,
    gradients: Gradients = 1,
    no_gradients: NoGradients = False,
    scheduler: Scheduler = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results. The default is named after the sweep, under out/.")
    ] = None,
    json_: Json = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a sweep that exists already.")] = False,
) -> None:
    """Sample one slice per value of a third parameter, and film them on one colour scale.

    The folder then holds frames/ (the samples of each frame; slice.zarr if there is only one slice), sweep.mp4,
    sweep.gif, sweep.rrd (a 3-D scene, which `landscape view` opens) and summary.json. Stop at any time: the same
    command goes on from there.

    Example: landscape sweep fluid --dims 6 8 --over 7 --frames 12
    """
    from ..jobs.cut import cut, describe_cut, folder_for, refuse_cut, split_points
    from .terminal import Bars, command_line, print_json

    refuse_words(scene, [*(dims or ()), over])
    refuse_cut(dims, along)
    bars, points, ends = Bars(), split_points(through), read_extent(extent)
    env = scene.make(bars)
    from ..jobs.sweep import SweepJob
    from ..jobs.workers import workers

    how: dict[str, Any] = {"command": command_line(), "gradients": 0 if no_gradients else gradients, "force": force}
    planes = {point: cut(env, dims, along, through=point, extent=ends, resolution=resolution) for point in points}
    said = list[dict[str, Any]]()
    with workers(scheduler, env.device) as executor:
        for point, plane in planes.items():
            named, folder = describe_cut(along, point, ends), folder_for(Path(out), point, points) if out else None
            with bars.busy(f"opening {frames} slices"):
                job = SweepJob.of(env, plane, over, frames, out=folder, cut=named, **how)
            summary = replace(job, executor=executor).run(bars)
            bars.note(f"{summary.outcome()}\n{job.folder}: {', '.join(summary.files)}")
            said.append({**asdict(summary), "folder": str(job.folder)})
    if json_:
        print_json(said[0] if len(said) == 1 else {"sweeps": said})
