"""`gs.slice`, `gs.bounce`, `gs.sample` and `gs.open_slice`: sample a slice of a scene, or open one."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

from cyclopts import Parameter

from ..jobs.scene import environment_of
from .call import current, verb
from .options import (
    Device,
    Dims,
    FigureWidth,
    Force,
    Gradients,
    Out,
    Point,
    Scene,
    SceneKeywords,
    SceneOptions,
    Scheduler,
    Share,
    Side,
    Window,
    at_least,
)
from .scene import environment, is_in_memory
from .values import as_path, as_share, as_widths, as_window

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from ..landscapes.objective import Objective
    from ..landscapes.plane import Plane
    from ..landscapes.sampling.refine import Refinement
    from ..landscapes.slice import Slice
    from ..landscapes.training import Training


@verb
def slice(
    scene: Scene,
    dims: Dims | None = None,
    *,
    along: str | None = None,
    resolution: Side = 16,
    through: Point = "center",
    window: Window | None = None,
    refine: Share | None = None,
    budget: Annotated[int | None, at_least(1)] = None,
    floor: bool = False,
    picture: Annotated[bool, Parameter(negative="--no-picture", show_default=False)] = True,
    gradients: Gradients = True,
    scheduler: Scheduler = None,
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    force: Force = False,
    **keywords: Unpack[SceneKeywords],
) -> Slice:
    """Sample losses and gradients on a plane through parameter space, and draw them.

    The folder then contains slice.zarr.zip (the samples), landscape.png and summary.json. Stop at any time: the same
    command continues from there. The status of a sample says whether it is interpolated, and no measure uses
    interpolated samples. In Python, your own function is sampled in memory unless you give a folder.

    Raises ValueError if the environment does not support a keyword, or if the folder contains something else or another
    slice. Raises Stopped when it is interrupted.

    Example: landscape slice fluid --dims 6 8 --resolution 24

    Parameters
    ----------
    dims
        One or two parameters to vary, by number or by name. With at most two parameters the default is all.
    along
        Directions to vary instead of --dims: random:SEED, filters:SEED (normalised by the weights of each neuron),
        gradient, hessian, pca:RUN, training:FOLDER (of checkpoints), the line A:B through two points, or the plane
        A:B:C through three. Samples outside the bounds are left out.
    resolution
        Number of points along each axis.
    through
        Point that the slice passes through: center, random:SEED, example:NAME, best, best:RUN, a file of numbers, a
        checkpoint of a training (.pt, .pth, .npz, .zip), or a row of a table, TABLE.csv:ROW. Row 1 of a table is its
        heading. Without ROW it takes the row with the lowest loss. The command also takes several points, A,B, and
        makes a slice for each, in separate folders.
    window
        Range to cover: a fraction of the box around the point, or the values LOW:HIGH. The default is the whole box.
    refine
        Adaptive sampling: refine until 95 % of the interpolated points are within this fraction of the loss range, such
        as 1%.
    budget
        Adaptive sampling with at most this many episodes, alone or together with --refine.
    floor
        Also evaluate the replicas of the environment, the same physics with other numerics, at every sample. It draws a
        map of the numerical floor, the standard deviation between their losses. Each replica costs as much as the
        slice.
    picture
        Draw landscape.png. For a fast function this takes longer than the samples, and --no-picture skips it. You can
        draw it from the samples later.
    """
    from ..jobs.cut import PlaneSpec

    call, fine = current(), as_share(refine, "--refine")
    spec = PlaneSpec(dims, along, through, as_window(window), resolution)
    env = environment(scene, keywords, dims=dims)
    from ..landscapes.identity import BOXED, record_cut
    from ..landscapes.objective import BoxedObjective
    from ..landscapes.sampling.refine import Refinement
    from ..landscapes.space import as_stride

    stride = as_stride(gradients or 0) if env.has_gradient else 0
    in_memory = is_in_memory(env, out)
    begun: dict[str, Any] = {"out": as_path(out), "gradients": stride, "refinement": Refinement.of(fine, budget)}
    plane, training = spec.make(env, None if force or in_memory else begun), spec.training(env)
    if in_memory:
        boxed = BoxedObjective(env) if BOXED in record_cut(spec.cut) else env
        return _sample_in_memory(boxed, plane, begun["refinement"], stride, floor, training)
    from ..jobs.slice import SliceJob
    from ..jobs.workers import workers

    with workers(scheduler, env.device) as executor:
        job = SliceJob.of(
            env, plane, command=call.command, cut=spec.cut, force=force, floor=floor, picture=picture,
            executor=executor, prints=as_widths(figure_width_mm), training=training, **begun,
        )  # fmt: skip
        job.run(call.watch)
    return _opened(job.store.dataset(), job.folder, lambda: env)


@verb
def bounce(
    *,
    axis: str,
    resolution: Side = 512,
    through: Point = "example:aim",
    window: Window | None = None,
    fidelity: str = "standard",
    device: Device = "auto",
    options: SceneOptions = (),
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    force: Force = False,
) -> Slice:
    """Draw loss and gradient of the bouncing ball along one velocity, and mark where the number of bounces changes.

    The folder then contains slice.zarr.zip (the samples), landscape.png and summary.json.

    Raises ValueError for another axis, and the errors of `slice`.

    Example: landscape bounce --axis y

    Parameters
    ----------
    axis
        Component of the initial velocity to vary: x, y or z.
    resolution
        Number of velocities.
    through
        Point that the line passes through, as for `landscape slice`.
    window
        Range to cover: a fraction of the box around the point, or the values LOW:HIGH [m/s].
    fidelity
        Accuracy of the simulation: draft, standard or reference.
    """
    if axis not in ("x", "y", "z"):
        raise ValueError(f"bounce varies the velocity along axis x, y or z; got {axis!r}")
    return slice(
        "bounce", (f"velocity {axis}",), resolution=resolution, through=through, window=window, fidelity=fidelity,
        device=device, options=options, figure_width_mm=figure_width_mm, out=out, force=force,
    )  # fmt: skip


def sample(scene: Scene, plane: Plane, *, gradients: bool | int = True) -> xr.Dataset:
    """Evaluate a simulator on any plane, in memory, and return the samples.

    `gradients` is as for `slice`. Raises ValueError if `scene` is not a simulator, or if the plane is in another space.
    """
    from ..envs.registry import as_environment
    from ..landscapes.sampling.fill import sample as fill
    from ..landscapes.space import as_stride

    return fill(as_environment(scene), plane, gradients=as_stride(gradients))


def open_slice(path: str | Path, *, env: Scene = None) -> Slice:
    """Open a slice from the folder that `slice` or `landscape slice` wrote, or from its store.

    `env` is the simulator that it was sampled from, if that is not registered by name: a function, a class or
    FILE.py:NAME. Only methods that evaluate it again need it, such as `report`.

    Samples that are still missing are NaN, with status MISSING. Raises StoreError, a ValueError, if there is no slice,
    or if it is damaged.
    """
    from ..landscapes.storage.store import open_slice as read

    dataset = read(path)
    return _opened(dataset, Path(path), lambda: environment_of(dataset, "auto", env))


def slices(folder: str | Path, where: str | None = None) -> pd.DataFrame:
    """Return a table of all slices in a folder, one row each, from their summaries.

    It searches subfolders at any depth, and opens no slice. `where` is an SQLite condition over the columns, such as
    "env = 'branin' and lowest < 0.5". The table is stored as .slices.sqlite in the folder. The next call reads only
    summaries that are new or changed.

    Raises ValueError if there is no such folder, or if `where` is not a valid condition.
    """
    from ..jobs.slices import find_slices

    return find_slices(Path(folder), where).rows


def as_slice(given: str | Path | Slice, *, env: Scene = None) -> Slice:
    """Return a slice that is given as it is, or by its folder. Raises ValueError where there is none."""
    if not isinstance(given, str | Path):
        return given
    from ..landscapes.storage.paths import refuse_missing

    refuse_missing(str(given), "slice")
    return open_slice(given, env=env)


def _opened(dataset: xr.Dataset, path: Path, remake: Callable[[], Objective]) -> Slice:
    """Return a slice that lies at a path, with its map of the numerical floor."""
    from ..landscapes.slice import Slice
    from ..landscapes.storage.floor_map import open_floor_map, with_map
    from ..landscapes.storage.paths import FILLING, FOLDER

    mapped = open_floor_map(path, dataset)
    folder = path if path.is_dir() and path.suffix not in (FOLDER, FILLING) else None
    return Slice(with_map(dataset, mapped), folder, remake, mapped)


def _sample_in_memory(
    objective: Objective,
    plane: Plane,
    refinement: Refinement | None,
    gradients: int,
    floor: bool,
    training: Training | None,
) -> Slice:
    from ..jobs.slice import conclude_slice
    from ..landscapes.lattice import check_gradients
    from ..landscapes.measures.slice_floor import map_floor, refuse_without_replicas
    from ..landscapes.sampling.fill import describe, sample
    from ..landscapes.sampling.refine import refine
    from ..landscapes.slice import Slice
    from ..landscapes.storage.floor_map import with_map
    from ..landscapes.storage.store import SliceStore

    gradients = check_gradients(gradients, plane, refined=refinement is not None)
    if floor:
        refuse_without_replicas(objective, refined=refinement is not None)
    with current().watch.progress(math.prod(plane.resolution), "evaluations") as advance:
        how: dict[str, Any] = {
            "progress": lambda now: advance(now.done),
            "conclude": lambda whole: conclude_slice(objective, whole, training=training),
        }
        if refinement is None:
            dataset = sample(objective, plane, gradients=gradients, **how)
        else:
            store = SliceStore.in_memory(plane, objective.space, **describe(objective), grad=gradients > 0)
            dataset = refine(objective, plane, store, refinement, **how)
    mapped = None
    if floor:
        found = {name: sample(one, plane, gradients=gradients) for name, one in objective.replicas().items()}
        mapped = map_floor(objective, dataset, found)
    return Slice(with_map(dataset, mapped), None, lambda: objective, mapped)
