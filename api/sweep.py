"""`gs.sweep`: sample slices of a scene as something else moves, and film them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from ..jobs.scene import SceneSpec, plane_through
from .progress import default_watch
from .scene import SceneKeywords, environment, say_call

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from ..envs.base import Environment
    from ..landscapes.draw.figures.sweep import Sweep


def sweep(
    scene: str | type[Environment] | Environment | SceneSpec,
    dims: Sequence[int | str],
    over: int | str,
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
    watch = default_watch()
    env = environment(scene, keywords, watch)
    plane = plane_through(env, dims, through=through, extent=extent, resolution=resolution)
    command = say_call("sweep", scene, tuple(dims), over, frames=frames, resolution=resolution, **keywords)
    from ..jobs.sweep import SweepJob

    folder = Path(out) if out is not None else None
    job = SweepJob.of(env, plane, over, frames, command=command, out=folder, grad=gradients, force=force)
    job.run(watch)
    return job.sample()
