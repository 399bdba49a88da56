"""`gs.sweep`: sample slices of a scene as something else moves, and film them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from ..jobs.cut import cut, describe_cut
from .progress import default_watch
from .scene import Scene, SceneKeywords, environment, say_call, say_cut

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from ..landscapes.draw.figures.sweep import Sweep


def sweep(
    scene: Scene,
    dims: Sequence[int | str] | None = None,
    over: int | str | None = None,
    *,
    along: str | None = None,
    frames: int = 24,
    resolution: int = 16,
    through: str | Float[Tensor, " dim"] = "center",
    extent: float | tuple[float, float] | None = None,
    gradients: bool | int = True,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Sweep:
    """Sample a slice for each of `frames` values of what `over` names, film them, and return them.

    `over` is a third parameter, by number or by name, or horizon, the episode's duration, or smoothing, of one slice.
    Along directions, which `along` names instead of `dims` as for `slice`, a parameter is moved at the point that the
    slices go through, and what lies off the box is left out. The samples and the films lie in the folder `out`, by
    default one under out/ named after the sweep: the same call goes on there where it stopped. The rest is that of
    `slice`. Of smoothed losses there are no gradients.

    Raises ValueError for what the scene does not have or cannot be swept, where nothing is to move, and where the
    folder holds something else or another sweep, which `force` replaces; Stopped where it is interrupted.
    """
    if over is None:
        raise ValueError("a sweep takes over: a third parameter, horizon or smoothing; got None")
    watch = default_watch()
    env = environment(scene, keywords, watch)
    plane = cut(env, dims, along, through=through, extent=extent, resolution=resolution)
    from ..jobs.sweep import SweepJob

    said: dict[str, Any] = {"over": over, "frames": frames, "resolution": resolution}
    said |= say_cut(along, through, extent, gradients=gradients)
    settings: dict[str, Any] = {
        "command": say_call("sweep", scene, *([tuple(dims)] if dims else []), **said, **keywords),
        "out": Path(out) if out is not None else None,
        "cut": describe_cut(along, through, extent),
    }
    job = SweepJob.of(env, plane, over, frames, gradients=gradients, force=force, **settings)
    job.run(watch)
    return job.sample()
