"""`gs.sweep`: sample slices of a scene over a third quantity, and film them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Unpack

from .call import current, verb
from .options import (
    Dims,
    Force,
    Gradients,
    Out,
    Parameter_,
    Point,
    Scene,
    SceneKeywords,
    Scheduler,
    Side,
    Window,
    at_least,
)
from .scene import environment
from .values import as_path, as_window

if TYPE_CHECKING:
    from ..landscapes.draw.figures.sweep import Sweep


@verb
def sweep(
    scene: Scene,
    dims: Dims | None = None,
    over: Parameter_ | None = None,
    *,
    along: str | None = None,
    frames: Annotated[int, at_least(2)] = 24,
    resolution: Side = 16,
    through: Point = "center",
    window: Window | None = None,
    gradients: Gradients = True,
    scheduler: Scheduler = None,
    out: Out = None,
    force: Force = False,
    **keywords: Unpack[SceneKeywords],
) -> Sweep:
    """Sample one slice per value of a third parameter, and film them on one colour scale.

    The folder then contains frames/ (the samples of each frame, or slice.zarr.zip if there is only one slice),
    sweep.mp4, sweep.gif, sweep.rrd (a 3-D scene, which `landscape view` opens) and summary.json. Stop at any time: the
    same command continues from there. Smoothed losses have no gradients.

    Raises ValueError if the environment does not support a keyword, if `over` is missing or cannot be swept, or if the
    folder contains something else or another sweep. Raises Stopped when it is interrupted.

    Example: landscape sweep fluid --dims 6 8 --over 7 --frames 12

    Parameters
    ----------
    dims
        Two parameters to vary, by number or by name. An environment with two parameters needs none.
    over
        Quantity that changes from frame to frame: a third parameter between its bounds, horizon (the duration of the
        episode), or smoothing (of one slice).
    along
        Directions to vary instead of --dims, as for `landscape slice`.
    frames
        Number of frames, both ends included.
    resolution
        Number of points along each axis.
    through
        Point that the slices pass through, as for `landscape slice`. The command also takes several points, A,B.
    window
        Range to cover: a fraction of the box around the point, or the values LOW:HIGH. The default is the whole box.
    """
    if over is None:
        raise ValueError("sweep takes --over: a third parameter, horizon or smoothing; got none")
    from ..jobs.cut import PlaneSpec

    spec, call = PlaneSpec(dims, along, through, as_window(window), resolution), current()
    env = environment(scene, keywords, dims=[*(dims or ()), over])
    plane = spec.make(env)
    from ..jobs.sweep import SweepJob
    from ..jobs.workers import workers
    from ..landscapes.space import as_stride

    with workers(scheduler, env.device) as executor:
        with call.watch.busy(f"opening {frames} slices"):
            job = SweepJob.of(
                env, plane, over, frames, command=call.command, force=force, out=as_path(out), cut=spec.cut,
                gradients=as_stride(gradients or 0) if env.has_gradient else 0,
            )  # fmt: skip
        replace(job, executor=executor).run(call.watch)
    return job.sample()
