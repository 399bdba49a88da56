"""`gs.slice`: sample a slice of a scene."""

from __future__ import annotations

from collections.abc import Sequence
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
    from ..jobs.slice import SliceSummary
    from ..landscapes.slice import Slice


def slice(
    scene: str | type[Environment] | Environment | SceneSpec,
    dims: Sequence[int | str],
    *,
    resolution: int | Sequence[int] = 16,
    through: str | Float[Tensor, " dim"] = "center",
    extent: float | tuple[float, float] | None = None,
    gradients: bool = True,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Slice:
    """Sample losses and gradients of a scene over a plane through its parameter space, and return the slice.

    `dims` are one or two parameters, by number or by name; `through` is the point the plane goes through, and `extent`
    what it covers: a fraction of the box around that point, or two ends; the whole box by default. The samples lie in
    the folder `out`, by default one under out/ named after the slice: the same call goes on there where it stopped.

    Raises ValueError for what the scene does not have, and where the folder holds something else or another slice,
    which `force` replaces; Stopped where it is interrupted.
    """
    command = f"gradscape.slice({scene!r}, {tuple(dims)}, resolution={resolution})"
    return sample(
        scene, dims, resolution=resolution, through=through, extent=extent, grad=gradients,
        out=Path(out) if out else None, force=force, command=command, watch=default_watch(), keywords=keywords,
    )[0]  # fmt: skip


def sample(
    scene: str | type[Environment] | Environment | SceneSpec,
    dims: Sequence[int | str],
    *,
    resolution: int | Sequence[int],
    through: str | Float[Tensor, " dim"],
    extent: float | tuple[float, float] | None,
    grad: bool,
    out: Path | None,
    force: bool,
    command: str,
    watch: Watch,
    scheduler: str | None = None,
    prints: Sequence[float] = (),
    keywords: SceneKeywords | None = None,
) -> tuple[Slice, SliceSummary]:
    """Sample a slice as `slice` does, and return it with its summary; what more there is belongs to the command."""
    env = environment(scene, keywords or {}, watch)
    from ..jobs.slice import SliceJob
    from ..jobs.workers import workers
    from ..landscapes.plane import Plane
    from ..landscapes.slice import Slice
    from ..landscapes.storage.store import open_slice

    point = point_of(env, through) if isinstance(through, str) else through
    plane = Plane.through(env.space, point, dims, resolution=resolution, extent=extent)
    with workers(scheduler, env.device) as executor:
        job = SliceJob.of(
            env, plane, command=command, out=out, grad=grad, force=force, executor=executor, prints=prints
        )
        summary = job.run(watch)
    return Slice(open_slice(job.folder / "slice.zarr"), job.folder, lambda: env), summary
