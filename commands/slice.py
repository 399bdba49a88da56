"""`landscape slice` and `landscape bounce`: sample a plane, or a line, through parameter space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from ..jobs.scene import SceneSpec, with_policy
from .arguments import (
    Along,
    Extent,
    Force,
    Gradients,
    Json,
    NoGradients,
    Out,
    Policy,
    Print,
    Refine,
    RefineBudget,
    Resolution,
    Scheduler,
    SomeDims,
    Through,
    read_extent,
    read_share,
    refuse_words,
    takes_scene,
)


@takes_scene()
def slice_(
    scene: SceneSpec,
    dims: SomeDims = None,
    along: Along = None,
    resolution: Resolution = 16,
    through: Through = "center",
    extent: Extent = None,
    refine: Refine = None,
    budget: RefineBudget = None,
    policy: Policy = None,
    gradients: Gradients = 1,
    no_gradients: NoGradients = False,
    scheduler: Scheduler = None,
    out: Out = None,
    print_: Print = None,
    json_: Json = False,
    force: Force = False,
) -> None:
    """Sample losses and gradients on a plane through parameter space, and draw them.

    The folder then holds slice.zarr (the samples), landscape.png and summary.json. Stop at any time: the same command
    goes on from there. --refine and --budget sample adaptively, on a grid of at most --resolution; the status tells
    which points are interpolated, and no measure uses those. With several points, --through A,B, each has a slice in a
    folder of its own.

    Example: landscape slice fluid --dims 6 8 --resolution 24
    """
    how: dict[str, Any] = {"resolution": resolution, "through": through}
    how |= {"refine": refine, "budget": budget, "along": along, "policy": policy}
    how |= {"gradients": 0 if no_gradients else gradients}
    _sample(scene, dims, extent, print_, out, **how, as_json=json_, force=force, scheduler=scheduler)


@takes_scene("env", "tolerance", "engine", "deterministic", env="bounce", fidelity="standard")
def bounce(
    scene: SceneSpec,
    axis: Annotated[str, typer.Option(help="Component of the initial velocity to vary: x, y or z.")],
    resolution: Annotated[int, typer.Option(min=2, help="Number of velocities.")] = 512,
    through: Through = "example:aim",
    extent: Extent = None,
    out: Out = None,
    print_: Print = None,
    json_: Json = False,
    force: Force = False,
) -> None:
    """Draw loss and gradient of the bouncing ball along one velocity, and mark where the number of bounces changes.

    The folder then holds slice.zarr (the samples), landscape.png and summary.json.

    Example: landscape bounce --axis y
    """
    if axis not in ("x", "y", "z"):
        raise ValueError(f"bounce varies the velocity along axis x, y or z; got {axis!r}")
    how: dict[str, Any] = {"resolution": resolution, "through": through}
    _sample(scene, (f"velocity {axis}",), extent, print_, out, **how, as_json=json_, force=force)


def _sample(
    scene: SceneSpec,
    dims: Sequence[str] | None,
    extent: str | None,
    prints: Sequence[float] | None,
    out: str | None,
    *,
    resolution: int,
    through: str,
    as_json: bool,
    force: bool,
    gradients: int = 1,
    scheduler: str | None = None,
    refine: str | None = None,
    budget: int | None = None,
    along: str | None = None,
    policy: str | None = None,
) -> None:
    """Sample a slice, and say what came out."""
    from ..jobs.cut import cut, describe_cut, folder_for, refuse_cut, split_points
    from .terminal import Bars, command_line, print_json

    refuse_words(scene, dims, policy)
    refuse_cut(dims, along)
    where: dict[str, Any] = {"extent": read_extent(extent), "resolution": resolution}
    share, bars = read_share(refine, "--refine"), Bars()
    env = scene.make(bars)
    subject = with_policy(env, policy)
    from ..jobs.slice import SliceJob
    from ..jobs.workers import workers
    from ..landscapes.sampling.refine import Refinement

    points = split_points(through)
    how: dict[str, Any] = {
        "command": command_line(),
        "gradients": gradients if policy is None else 0,
        "force": force,
        "prints": prints or [],
    }
    how["refinement"] = Refinement.of(share, budget)
    folders = {point: folder_for(Path(out), point, points) if out else None for point in points}
    kept = {name: how[name] for name in ("gradients", "refinement")}
    planes = {  # all of them, or none is sampled
        point: cut(subject, dims, along, through=point, **where, kept=None if force else {**kept, "out": folder})
        for point, folder in folders.items()
    }
    said = list[dict[str, Any]]()
    with workers(scheduler, env.device) as executor:
        for point, plane in planes.items():
            named = describe_cut(along, point, where["extent"])
            job = SliceJob.of(subject, plane, out=folders[point], cut=named, executor=executor, **how)
            summary = job.run(bars)
            bars.note(f"{summary.outcome()}\n{job.folder}: {', '.join(summary.files)}")
            said.append({**asdict(summary), "folder": str(job.folder)})
    if as_json:
        print_json(said[0] if len(said) == 1 else {"slices": said})
