"""`gs.slice` and `gs.open_slice`: sample a slice of a scene, or open one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from ..jobs.scene import SceneSpec, cut, environment_of
from ..jobs.watch import Watch
from ..landscapes.adapters import within_box
from .progress import default_watch
from .scene import SceneKeywords, is_environment, objective_of, say_call

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from ..envs.base import Environment
    from ..landscapes.objective import Objective
    from ..landscapes.plane import Plane
    from ..landscapes.slice import Slice


def slice(
    scene: str | type[Environment] | Objective | SceneSpec,
    dims: Sequence[int | str] | None = None,
    *,
    along: str | None = None,
    resolution: int | Sequence[int] = 16,
    through: str | Float[Tensor, " dim"] = "center",
    extent: float | tuple[float, float] | None = None,
    gradients: bool = True,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Slice:
    """Sample losses and gradients of a scene over a plane through its parameter space, and return the slice.

    `scene` is an environment's name, FILE.py:Class, its class, itself, or anyone's objective (`from_torch`,
    `from_numpy`). `dims` are one or two parameters, by number or by name; `through` is the point that the plane goes
    through, and `extent` what it covers: a fraction of the box around that point, or two ends [the parameters' unit];
    the whole box by default. `along` names directions instead of `dims`: random:SEED, gradient, hessian, pca:RUN, a
    line A:B or a plane A:B:C between points; what lies off the box is left out. The samples lie in the folder `out`,
    by default one under out/ named after the slice: the same call goes on there where it stopped. An objective that is
    no environment is sampled in memory without `out`.

    Raises ValueError for what the scene does not have, and where the folder holds something else or another slice,
    which `force` replaces; Stopped where it is interrupted.
    """
    watch = default_watch()
    objective = objective_of(scene, keywords, watch)
    plane = cut(objective, dims, along, through=through, extent=extent, resolution=resolution)
    if out is None and not is_environment(objective):
        return _sample_in_memory(within_box(objective) if along else objective, plane, gradients, watch)
    from ..jobs.slice import SliceJob

    point = through if isinstance(through, str) else through.tolist()
    how = {
        "along": along,
        "through": None if point == "center" else point,
        "extent": extent,
        "gradients": None if gradients else False,
    }
    command = say_call("slice", scene, *([tuple(dims)] if dims else []), resolution=resolution, **how, **keywords)
    folder = Path(out) if out is not None else None
    job = SliceJob.of(
        objective, plane, command=command, out=folder, grad=gradients, force=force, boxed=along is not None
    )
    job.run(watch)
    return _open(job.folder, lambda: objective)


def open_slice(path: str | Path) -> Slice:
    """Open a slice: the folder that `slice` or `landscape slice` left it in, or its store.

    What is not sampled yet is NaN, with status MISSING. Raises StoreError, a ValueError, where there is no slice, and
    where it is damaged.
    """
    return _open(Path(path), None)


def _open(path: Path, remake: Callable[[], Objective] | None) -> Slice:
    from ..landscapes.slice import Slice
    from ..landscapes.storage.store import open_slice

    dataset = open_slice(path)
    return Slice(dataset, path if path.suffix != ".zarr" else None, remake or (lambda: environment_of(dataset, "auto")))


def _sample_in_memory(objective: Objective, plane: Plane, grad: bool, watch: Watch) -> Slice:
    from ..landscapes.sampling.fill import sample
    from ..landscapes.slice import Slice

    with watch.progress(math.prod(plane.resolution), "evaluations") as advance:
        dataset = sample(objective, plane, grad=grad, progress=lambda now: advance(now.done))
    return Slice(dataset, None, lambda: objective)
