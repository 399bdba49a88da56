"""Measures of a scene: `gs.check`, `card`, `pairs`, `hessian`, `remedy`, `census`, `bench`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Unpack, overload

from cyclopts import Parameter

from ..envs.registry import names_in_file
from .call import current, verb
from .options import (
    ARGUMENT,
    Count,
    Device,
    Dims,
    FigureWidth,
    Force,
    Names,
    Out,
    Point,
    Scene,
    SceneKeywords,
    Scheduler,
    Seed,
    Share,
    at_least,
)
from .scene import spec_of
from .values import as_path, as_power, as_widths

if TYPE_CHECKING:
    from ..jobs.bench import Bench
    from ..jobs.check import CheckReport
    from ..jobs.checks import CheckReports
    from ..jobs.pairs import PairRanking
    from ..landscapes.measures.card import Card
    from ..landscapes.measures.census import Census
    from ..landscapes.measures.hessian import Hessian
    from ..studies.remedies import RemedyStudy

OtherScenes = Annotated[
    Any,
    ARGUMENT,
    Parameter(help="Further environments, each as above. FILE.py:* means all simulators in your own file."),
]
Junit = Annotated[
    str | Path | None,
    Parameter(help="Also write the findings to this file as JUnit XML, which CI services read."),
]
CheckFolder = Annotated[
    str | Path | None, Parameter(help="Folder for the results of one environment. Without it nothing is saved.")
]


@overload
def check(
    scene: Scene,
    *,
    power: Share = "5%",
    seed: Seed = 0,
    jobs: int = 1,
    junit: str | Path | None = None,
    figure_width_mm: FigureWidth = (),
    out: str | Path | None = None,
    force: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> CheckReport: ...


@overload
def check(
    scene: Scene,
    other: Scene,
    /,
    *others: Scene,
    power: Share = "5%",
    seed: Seed = 0,
    jobs: int = 1,
    junit: str | Path | None = None,
    **keywords: Unpack[SceneKeywords],
) -> CheckReports: ...


@verb
def check(
    scene: Scene,
    *others: OtherScenes,
    power: Share = "5%",
    seed: Seed = 0,
    jobs: Count = 1,
    junit: Junit = None,
    figure_width_mm: FigureWidth = (),
    out: CheckFolder = None,
    force: Force = False,
    **keywords: Unpack[SceneKeywords],
) -> CheckReport | CheckReports:
    """Check the gradients of an environment: where they are wrong, why, and what to do.

    It compares gradients with finite differences over many steps, at random points, at special points and for every
    parameter. It reports the share of the box where they are wrong, with its interval, the region, the parameters and
    the cause. It also checks shapes, refused input, batches, determinism, growth with the horizon, points at the
    corners of the box and outside it, long time steps, materials, horizons and precision. A warning is not a failure:
    the gradient is right, but useless over an optimiser's step. The exit code is 0 if the environment passes, else 1.
    For several environments it prints a line and a verdict each. The exit code is then 1 if one fails or cannot be
    checked.

    It writes only the files that --junit and --out name. The folder then contains check.json and check.png, which shows
    over which steps gradients predict the change of the loss.

    Raises ValueError if the environment does not support a keyword, TooLargeError if the points do not fit in memory,
    and StoreMismatchError if the folder contains another check. Raises Stopped when it is interrupted.

    Example: landscape check bounce

    Parameters
    ----------
    power
        Share of the box, such as 5% or 0.05. A defect that fills this share is found with a probability of 95 %. A
        smaller share takes more points (59 at 5 %, 299 at 1 %, 14 at 20 %).
    jobs
        Number of processes. Each checks one environment after another. In Python, more than one requires a script whose
        code is under `if __name__ == '__main__':`.
    """
    call, share, folder, prints = current(), as_power(power), as_path(out), as_widths(figure_width_mm)
    if prints and folder is None:
        raise ValueError("--figure-width-mm writes a figure to a folder; give --out, too")
    names = [name for one in (scene, *others) for name in (names_in_file(one) if isinstance(one, str) else [one])]
    specs = [spec_of(name, keywords).resolve(call.watch) for name in names]
    from ..jobs.check import CheckJob
    from ..jobs.checks import CheckReports, ChecksJob, write_junit

    found: CheckReport | CheckReports
    if (many := bool(others) or len(specs) > 1) and folder is not None:
        raise ValueError(
            f"--out takes the results of one environment; got {len(specs)} environments, so check each by itself"
        )
    if many:
        found = whole = ChecksJob(specs, share, seed, jobs, call.command).run(call.watch)
    else:
        job = CheckJob.open(specs[0], power=share, seed=seed, command=call.command)
        found = (job if folder is None else job.into(folder, force=force, prints=prints)).run(call.watch)
        whole = CheckReports((found,), {})
    if junit is not None:
        write_junit(Path(junit), whole)
    return found


@verb
def card(
    scenes: Annotated[Sequence[str], Parameter(name="--scene")] = (),
    *,
    resolution: Annotated[int, at_least(3)] = 17,
    device: Device = "auto",
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    force: Force = False,
) -> Card:
    """Check the gradients of several engines in the same scenes, and show their landscapes side by side.

    It runs the same `landscape check` on every installed engine, ours included, and samples each on one small plane.
    The folder then contains card.html (a single page with a table and a panel for each engine), card.json, card.npz
    (the slices) and card.png. The table gives the share of points where gradients are wrong, with its interval, and the
    cause. In scenes with a closed form it also gives the error of gradients against that. A new release of an engine is
    measured again. Stop at any time: the same command continues with the next engine. The exit code is always 0.

    Raises ValueError if the card does not have a scene, and StoreMismatchError if the folder contains a card of other
    versions. Raises Stopped when it is interrupted.

    Example: landscape card --scene "flight"

    Parameters
    ----------
    scenes
        A scene of the card, such as flight. It can be repeated. The default is all scenes.
    resolution
        Number of points along each axis of the small slices.
    """
    from ..jobs.card import CardJob

    call = current()
    job = CardJob.open(
        scenes, resolution=resolution, device=device, out=as_path(out), force=force,
        prints=as_widths(figure_width_mm), command=call.command,
    )  # fmt: skip
    return job.run(call.watch)


@verb
def pairs(
    scene: Scene,
    *,
    samples: Annotated[int | None, at_least(2)] = None,
    seed: Seed = 0,
    out: Out = None,
    force: Force = False,
    **keywords: Unpack[SceneKeywords],
) -> PairRanking:
    """Rank pairs of parameters by sensitivity, ruggedness and misleading gradients, to choose which to slice.

    The folder then contains pairs.json (all pairs) and the evaluated episodes. Stop at any time: the same command
    continues from there.

    Raises ValueError if the environment has only one parameter, and StoreMismatchError if the folder contains another
    study. Raises Stopped when it is interrupted.

    Example: landscape pairs fluid

    Parameters
    ----------
    samples
        Number of base points. Each takes 1 + 5 x dim + 28 episodes, or fewer below 8 parameters. The default is 16,
        falling to 4 with many parameters.
    """
    spec = spec_of(scene, keywords)
    from ..jobs.pairs import PairsJob

    call = current()
    job = PairsJob.open(
        spec.resolve(call.watch), samples=samples, seed=seed, out=as_path(out), force=force, command=call.command
    )
    return job.run(call.watch)


@verb
def hessian(
    scene: Scene,
    through: Point = "center",
    *,
    eigenpairs: Count = 5,
    probes: Annotated[int, at_least(2)] = 8,
    seed: Seed = 0,
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    force: Force = False,
    **keywords: Unpack[SceneKeywords],
) -> Hessian:
    """Measure the Hessian of an environment at a point: eigenvalues with errors, trace, condition, negative curvature.

    All values are in box units: every parameter runs from 0 to 1 between its bounds. The Hessian comes from central
    differences of gradients, with a step chosen automatically. Without gradients it comes from losses, for up to 30
    parameters. With up to 100 parameters the whole matrix is computed. With more, ARPACK finds the ends of the
    spectrum, and Lanczos' method estimates trace and density from random probes. The sign of an eigenvalue is "cannot
    tell" if its error is larger than its size. The folder then contains hessian.json, hessian.npz (eigenvalues,
    eigenvectors, density) and hessian.png. Stop at any time: the same command continues from there.

    Raises ValueError if the environment does not support a keyword, or if points fail that the Hessian needs. Raises
    StoreMismatchError if the folder contains another Hessian, and Stopped when it is interrupted.

    Example: landscape hessian rosenbrock --through center

    Parameters
    ----------
    through
        Point to measure at: center, random:SEED, example:NAME, best, best:RUN, a file of numbers, or a row of a table,
        TABLE.csv:ROW. Python also takes the numbers themselves.
    eigenpairs
        Number of eigenvalues to examine at each end of the spectrum, with their directions.
    probes
        Number of random directions that sample the spectrum if there are more than 100 parameters.
    """
    spec = spec_of(scene, keywords)
    from ..jobs.hessian import HessianJob

    call = current()
    job = HessianJob.open(
        spec.resolve(call.watch), through, pairs=eigenpairs, probes=probes, seed=seed, out=as_path(out), force=force,
        prints=as_widths(figure_width_mm), command=call.command,
    )  # fmt: skip
    return job.run(call.watch)


@verb
def remedy(
    scene: Scene,
    *,
    remedies: Annotated[
        Names, Parameter(help="A remedy to try, written as for --remedy. It can be repeated. The default is all.")
    ] = (),
    dims: Annotated[Dims, Parameter(help="Parameters of the plane that is drawn. The default is the first two.")] = (),
    starts: Annotated[int, at_least(6)] = 32,
    budget: Annotated[int, at_least(16)] = 320,
    seed: Seed = 0,
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    force: Force = False,
    **keywords: Unpack[SceneKeywords],
) -> RemedyStudy:
    """Find out which remedy helps a search, by descents from the same starts at the same cost.

    A remedy is smoothing, clipping, an average over numerical replicas, another scale of parameters, a shorter episode
    or softer contact. docs/remedies.md explains them. L-BFGS-B descends from random starts, with each remedy and
    without. The points it finds are evaluated without the remedy, and compared start by start. The folder then contains
    remedy.json, remedy.npz (losses on a plane) and remedy.png. Stop at any time: the same command continues with the
    next remedy.

    Raises ValueError if the environment does not support a keyword, and StoreMismatchError if the folder contains
    another study. Raises Stopped when it is interrupted.

    Example: landscape remedy branin --starts 8 --budget 48

    Parameters
    ----------
    starts
        Number of random starts.
    budget
        Cost of each descent, in episodes with gradient. A remedy that takes several episodes per point gets fewer
        points.
    """
    spec = spec_of(scene, keywords)
    from ..jobs.remedy import RemedyJob

    call = current()
    job = RemedyJob.open(
        spec.resolve(call.watch), [remedies] if isinstance(remedies, str) else list(remedies), dims=dims,
        starts=starts, budget=budget, seed=seed, out=as_path(out), force=force, prints=as_widths(figure_width_mm),
        command=call.command,
    )  # fmt: skip
    return job.run(call.watch)


@verb
def census(
    scene: Scene,
    *,
    slices: Count = 64,
    resolution: Annotated[int, at_least(6)] = 24,
    gradients: Count = 1,
    along: Literal["pairs", "random"] = "pairs",
    second_fidelity: str | None = None,
    seed: Seed = 0,
    scheduler: Scheduler = None,
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    force: Force = False,
    **keywords: Unpack[SceneKeywords],
) -> Census:
    """Measure many random slices of an environment, and report what they have in common.

    A census measures each slice as `landscape report` does. It reports the fraction of slices that each word fits, and
    how each measure is distributed. It also reports how much of a measure's variance comes from the point, the
    orientation, the resolution and the fidelity. The folder then contains census.json, census.npz (losses in half
    precision, scaled to 0 to 1 between `low` and `high` of each slice) and census.png. Stop at any time: the same
    command continues with the next slice.

    Raises ValueError if the environment has only one parameter, and StoreMismatchError if the folder contains another
    census. Raises Stopped when it is interrupted.

    Example: landscape census bounce --slices 16

    Parameters
    ----------
    slices
        Number of slices.
    resolution
        Number of points along each axis of a slice.
    gradients
        Compute gradients only at every N-th sample per axis. 2 halves the time if a gradient costs three times a loss.
    along
        Orientation of the slices: pairs of parameters, or random directions, both over the whole box.
    second_fidelity
        Repeat every fourth slice at this fidelity, to see its effect.
    """
    spec = spec_of(scene, keywords)
    from dataclasses import replace

    from ..jobs.census import CensusJob
    from ..jobs.workers import workers

    call = current()
    job = CensusJob.open(
        spec.resolve(call.watch), slices=slices, resolution=resolution, gradients=gradients, along=along,
        also=second_fidelity, seed=seed, out=as_path(out), force=force, prints=as_widths(figure_width_mm),
        command=call.command,
    )  # fmt: skip
    with workers(scheduler, job.env.device) as executor:
        return replace(job, executor=executor).run(call.watch)


@verb
def bench(
    scene: Scene,
    *,
    second_engine: str | None = None,
    batch: Annotated[Sequence[int], at_least(1)] = (),
    seconds: Annotated[float, at_least(0)] = 10.0,
    same_points: bool = False,
    **keywords: Unpack[SceneKeywords],
) -> Bench:
    """Measure episodes per second, with and without gradients, and where the time goes.

    Rates are the median of alternating repetitions, each at different points of the box. With --second-engine the
    engines alternate too, so ratios come from one run. It writes no file.

    Raises ValueError if the environment does not have the engine, and TooLargeError if a batch does not fit in memory.

    Example: landscape bench fluid --second-engine taichi

    Parameters
    ----------
    second_engine
        A second engine, timed in turn with the first.
    batch
        Batch size in episodes. It can be repeated. The default is 1 and the preferred batch of the environment.
    seconds
        Approximate time to spend on each batch size [s].
    same_points
        Evaluate the same points in every repetition, to compare kernels alone.
    """
    spec = spec_of(scene, keywords)
    if second_engine is not None:
        spec_of(scene, {**keywords, "engine": second_engine})
    from ..jobs.bench import BenchJob

    call = current()
    job = BenchJob.of(
        spec.resolve(call.watch), against=second_engine, batches=sorted(set(batch)), seconds=seconds,
        same_points=same_points,
    )  # fmt: skip
    return job.run(call.watch)
