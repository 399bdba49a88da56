"""`gs.slice` and `gs.open_slice`: sample a slice of a scene, or open one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from ..jobs.cut import cut, describe_cut
from ..jobs.scene import environment_of, with_policy
from ..jobs.watch import Watch
from ..landscapes.objective import BoxedObjective
from ..landscapes.space import as_stride
from .progress import default_watch
from .scene import Scene, SceneKeywords, environment, is_in_memory, say_call, say_cut

if TYPE_CHECKING:
    import xarray as xr
    from jaxtyping import Float
    from torch import Tensor

    from ..landscapes.objective import Objective
    from ..landscapes.plane import Plane
    from ..landscapes.sampling.refine import Refinement
    from ..landscapes.slice import Slice


def slice(
    scene: Scene,
    dims: Sequence[int | str] | None = None,
    *,
    along: str | None = None,
    resolution: int | Sequence[int] = 16,
    through: str | Float[Tensor, " dim"] = "center",
    extent: float | tuple[float, float] | None = None,
    refine: float | None = None,
    budget: int | None = None,
    policy: str | None = None,
    gradients: bool | int = True,
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Slice:
    """Sample losses and gradients of a scene over a plane through its parameter space, and return the slice.

    `scene` is an environment's name, FILE.py:NAME, its class or itself, as `from_torch` and its like make one of a
    function, or an object with `space` and `evaluate`. `dims` are one or two parameters, by number or by name, by
    default all where there are no more. `through` is the point that the plane goes through: its name, or a point as
    `evaluate` takes it, with the decimal logarithm of a logarithmic parameter. `extent` is what it covers: a fraction
    of the box around that point, or two values [the parameters' unit]; the whole box by default. `along` names
    directions instead of `dims`: random:SEED, gradient, hessian, pca:RUN, a line A:B or a plane A:B:C between points;
    what lies off the box is left out. The samples lie in the folder `out`, by default one under out/ named after the
    slice: the same call goes on there where it stopped. A function is sampled in memory without `out`.

    `gradients` says whether it has any, or at every how many samples along each axis: 4 has losses at all samples, and
    gradients at a sixteenth of them.

    With a `policy`, mlp:32x32, it is over the weights of a perceptron that takes the environment's decisions by what it
    sees, not over the environment's own parameters; it has losses only.

    With `refine`, a share of the range of the losses, it is sampled only where neighbours do not explain to that share
    what is between them, and with a `budget` at no more points than that. The others are interpolated: status says
    which, their loss is NaN, and no measure uses them.

    Raises ValueError for what the scene does not have, and where the folder holds something else or another slice,
    which `force` replaces; Stopped where it is interrupted.
    """
    watch = default_watch()
    env = environment(scene, keywords, watch)
    objective, gradients = with_policy(env, policy), gradients if policy is None else 0
    from ..landscapes.sampling.refine import Refinement

    fine, folder = Refinement.of(refine, budget), Path(out) if out is not None else None
    in_memory = is_in_memory(env, out)
    stride = as_stride(gradients)
    begun: dict[str, Any] = {"out": folder, "gradients": stride, "refinement": fine}
    where: dict[str, Any] = {"through": through, "extent": extent, "resolution": resolution}
    plane = cut(objective, dims, along, **where, kept=None if force or in_memory else begun)
    if in_memory:
        return _sample_in_memory(BoxedObjective(objective) if along else objective, plane, fine, watch, stride)
    from ..jobs.slice import SliceJob

    how = {"refine": refine, "budget": budget, "policy": policy}
    how |= say_cut(along, through, extent, gradients=gradients if policy is None else True)
    command = say_call("slice", scene, *([tuple(dims)] if dims else []), resolution=resolution, **how, **keywords)
    named = describe_cut(along, through, extent)
    job = SliceJob.of(objective, plane, command=command, cut=named, force=force, **begun)
    job.run(watch)
    return _open(job.folder, None, lambda: objective)


def sample(scene: Scene, plane: Plane, *, gradients: bool | int = True) -> xr.Dataset:
    """Evaluate a simulator on any plane, in memory, and return the samples.

    `gradients` is that of `slice`. Raises ValueError for what is no simulator, and for a plane of another space.
    """
    from ..envs.registry import as_environment
    from ..landscapes.sampling.fill import sample as fill

    return fill(as_environment(scene), plane, gradients=as_stride(gradients))


def open_slice(path: str | Path, *, env: Scene = None) -> Slice:
    """Open a slice: the folder that `slice` or `landscape slice` left it in, or its store.

    `env` is the simulator that it was sampled from, where it is not registered by its name: a function, a class or
    FILE.py:NAME. It is needed only for what evaluates anew, such as `report`.

    What is not sampled yet is NaN, with status MISSING. Raises StoreError, a ValueError, where there is no slice, and
    where it is damaged.
    """
    return _open(Path(path), env, None)


def _open(path: Path, env: Scene, remake: Callable[[], Objective] | None) -> Slice:
    from ..landscapes.slice import Slice
    from ..landscapes.storage.store import open_slice

    dataset = open_slice(path)
    folder = path if path.suffix != ".zarr" else None
    return Slice(dataset, folder, remake or (lambda: environment_of(dataset, "auto", env)))


def _sample_in_memory(
    objective: Objective, plane: Plane, refinement: Refinement | None, watch: Watch, gradients: int
) -> Slice:
    from ..jobs.slice_summary import look_between
    from ..landscapes.lattice import check_gradients
    from ..landscapes.sampling.fill import describe, sample
    from ..landscapes.sampling.refine import refine
    from ..landscapes.slice import Slice
    from ..landscapes.storage.store import SliceStore

    gradients = check_gradients(gradients, plane, refined=refinement is not None)
    with watch.progress(math.prod(plane.resolution), "evaluations") as advance:
        how: dict[str, Any] = {
            "progress": lambda now: advance(now.done),
            "conclude": lambda whole: look_between(objective, whole),
        }
        if refinement is None:
            dataset = sample(objective, plane, gradients=gradients, **how)
        else:
            store = SliceStore.in_memory(plane, objective.space, **describe(objective), grad=gradients > 0)
            dataset = refine(objective, plane, store, refinement, **how)
    return Slice(dataset, None, lambda: objective)
