"""`gs.study`: the same points in several variants of a scene, each compared with a reference."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, Unpack, cast

from .call import current, verb
from .options import (
    ARGUMENT,
    FigureWidth,
    Force,
    MadeKeywords,
    Names,
    Out,
    Point,
    Scene,
    SceneKeywords,
    Seed,
    Share,
    at_least,
)
from .scene import spec_of
from .values import as_names, as_path, as_share, as_widths

if TYPE_CHECKING:
    from ..studies.variants import StudyRecord


@verb
def study(
    kind: Annotated[Literal["fidelity", "convergence", "model", "mixed", "extremes", "symmetry", "updates"], ARGUMENT],
    scene: Scene,
    *,
    points: Annotated[int | None, at_least(2)] = None,
    seed: Seed = 0,
    settings: Names = (),
    pairs: Names | None = None,
    precisions: Names = (),
    grid: Annotated[int | None, at_least(2, lte=64)] = None,
    width: float | None = None,
    tolerance: Share | None = None,
    reference: str | None = None,
    max_cost: float | None = None,
    time_limit: float | None = None,
    chaotic: bool = False,
    through: Point | None = None,
    noise: Share | None = None,
    rate: float | None = None,
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    force: Force = False,
    **keywords: Unpack[MadeKeywords],
) -> StudyRecord:
    """Measure several variants of an environment at the same points and compare them with a reference.

    fidelity: errors and times of cheaper and more expensive variants. The reference is the last fidelity. The result is
    also stored for --tolerance of other verbs.

    convergence: is the reference converged? It refines each setting of the reference. 16 points are enough.

    model: the effect of each part of the model. It removes each part, or adds it if it is missing. The reference is the
    full model at --fidelity.

    mixed: the best settings for draft and standard, by a search over all settings together.

    extremes: how far time step, grid, stiffness, controls and horizon can be changed before a simulation fails. It
    scans each setting, bisects to the first failure, and maps pairs of settings. The default fidelity is standard.
    `landscape envs NAME` shows the result for the time step.

    symmetry: the numerical floor, or how much losses and gradients change if only the numerics change. The scene
    provides the replicas: a shifted grid, other particles, another mesh, shorter steps. For your own function, give
    them with replicas=.

    updates: the distribution of losses after one update along the gradient and after random steps of the same length,
    with the left-tail probability. Each update follows the gradient at a randomly shifted point. This is mostly used
    for the weights of a policy (--policy).

    The folder then contains KIND.json and KIND.png. Stop at any time: the same command continues with the next variant.

    Raises ValueError if the kind does not take an option, or if there is nothing to compare. Raises StoreMismatchError
    if the folder contains another study, and Stopped when it is interrupted.

    Example: landscape study fidelity bounce --settings dt,precision

    Parameters
    ----------
    kind
        Study to run: fidelity, convergence, model, mixed, extremes, symmetry or updates.
    points
        Number of points at which every variant is measured. The default is 64, or 16 for extremes and 32 for symmetry.
        For updates: the number of updates, by default 256.
    settings
        Settings to change, as a,b or repeated. For fidelity: dt, resolution, particles, precision, stiffness, engine,
        device. For convergence: dt, resolution, particles, joint, precision. For extremes: dt, resolution, box, horizon
        and options that are positive numbers. The default is all that the environment has.
    pairs
        For extremes: pairs of settings to map, as dt:ke, or none. The default is dt with each other setting.
    precisions
        For extremes: precisions to test, float32, float64 or both. The default is all that the environment has.
    grid
        For extremes: number of values of each setting on a map. The default is 8.
    width
        For extremes: relative width at which the bisection of a limit stops. The default is 0.05.
    tolerance
        For extremes: largest accurate loss error, at the 95th percentile, as a share of the spread of losses. The
        default is 10%.
    reference
        For extremes: fidelity that finite losses are compared with. The default is the last.
    max_cost
        For mixed: largest cost of a variant, as a multiple of the present one. The default is 4.
    time_limit
        For mixed: time to spend on measurements [s]. The default is 600.
    chaotic
        For mixed: ignore gradients, because the motion is chaotic.
    through
        For updates: point that the updates start from, as for `landscape slice`. The default is the center.
    noise
        For updates: standard deviation of the random shift of points before their gradient is taken, as a share of the
        box. The default is 1%.
    rate
        For updates: learning rate, by which gradients are multiplied. The default makes updates 1 % of the box long.
    """
    spec = spec_of(scene, cast("SceneKeywords", keywords))
    from ..jobs.study import StudyJob
    from ..studies.kept import keep
    from ..studies.variants import StudyOptions

    asked = StudyOptions(
        points=points, seed=seed, settings=tuple(as_names(settings)),
        pairs=None if pairs is None else tuple(as_names(pairs)), precisions=tuple(as_names(precisions)), grid=grid,
        width=width, tolerance=as_share(tolerance, "--tolerance"), reference=reference, max_cost=max_cost,
        time_limit=time_limit, chaotic=chaotic, noise=as_share(noise, "--noise"), rate=rate,
    )  # fmt: skip
    call = current()
    job = StudyJob.open(
        kind, spec, asked, through=through, out=as_path(out), force=force, prints=as_widths(figure_width_mm),
        command=call.command,
    )  # fmt: skip
    found = job.run(call.watch)
    if path := keep(found):
        call.watch.note(f"stored for other verbs: {path}")
    return found
