"""`gs.sweep`: sample slices of a scene as something else moves, and film them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from ..jobs.scene import SceneSpec, point_of
from ..jobs.watch import Watch
from .progress import default_watch
from .scene import SceneKeywords, environment

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from ..envs.base import Environment
    from ..jobs.sweep import SweepJob, SweepSummary
    from ..landscapes.draw.figures.sweep import Sweep


def sweep(
    scene: str | type[Environment] | Environment | SceneSpec,
    dims: Sequence[int | str],
    over: str,
    *,
    frames: int = 24,
    resolution: int = 16,
    through: str | Float[Tensor, " dim"] = "center",
    extent: float | tuple[float, float] | None = None,
    gradients: bool = True,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Sweep:
    """Sample a slice for each of `frames` values of what `over` names, film them, and return them.

    `over` is a third parameter, by number or by name, or horizon, the episode's duration, or smoothing, of one slice.
    The samples and the films lie in the folder `out`, by default one under out/ named after the sweep: the same call
    goes on there where it stopped. The rest is that of `slice`.

    Raises ValueError for what the scene does not have or cannot be swept, and where the folder holds something else or
    another sweep, which `force` replaces; Stopped where it is interrupted.
    """
    command = f"gradscape.sweep({scene!r}, {tuple(dims)}, {over!r}, frames={frames}, resolution={resolution})"
    job, _ = film(
        scene, dims, str(over), frames=frames, resolution=resolution, through=through, extent=extent, grad=gradients,
        out=Path(out) if out else None, force=force, command=command, watch=default_watch(), keywords=keywords,
    )  # fmt: skip
    return job.sample()


def film(
    scene: str | type[Environment] | Environment | SceneSpec,
    dims: Sequence[int | str],
    over: str,
    *,
    frames: int,
    resolution: int,
    through: str | Float[Tensor, " dim"],
    extent: float | tuple[float, float] | None,
    grad: bool,
    out: Path | None,
    force: bool,
    command: str,
    watch: Watch,
    scheduler: str | None = None,
    keywords: SceneKeywords | None = None,
) -> tuple[SweepJob, SweepSummary]:
    """Sample and film a sweep as `sweep` does; return the job that is done, and its summary."""
    env = environment(scene, keywords or {}, watch)
    from ..jobs.sweep import SweepJob
    from ..jobs.workers import workers
    from ..landscapes.plane import Plane

    point = point_of(env, through) if isinstance(through, str) else through
    plane = Plane.through(env.space, point, dims, resolution=resolution, extent=extent)
    with watch.busy(f"opening {frames} slices"):
        job = SweepJob.of(env, plane, over, frames, command=command, out=out, grad=grad, force=force)
    with workers(scheduler, env.device) as executor:
        return job, replace(job, executor=executor).run(watch)
