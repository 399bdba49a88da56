"""What a scene is like, costs and needs: `gs.check`, `card`, `pairs`, `hessian`, `remedy`, `census`, `bench`."""

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
    Parameter(help="Further environments, each as above; FILE.py:* stands for all that are in a file of your own."),
]
Junit = Annotated[
    str | Path | None,
    Parameter(help="Also write the findings to this file, in the XML of JUnit that services for tests read."),
]
CheckFolder = Annotated[
    str | Path | None, Parameter(help="Folder of the results of one environment; without it they are not kept.")
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
    """Check that the gradients of an environment are right: where they are not, why, and what to do.

    It holds gradients against differences over many steps at random points, at special places and by every parameter,
    and says at which share of the box they are wrong, with its interval, in which region, by which parameters and from
    which cause. It also checks shapes, refusals, batches, determinism, growth with the horizon, corners of the box and
    beyond, long time steps, materials, horizons and precision. A warning is no failure: the gradient is right, but
    useless over an optimiser's step. The exit code is 0 if the environment passes, else 1. Of several environments
    there is a line and a verdict for each, and the exit code is 1 where one fails or cannot be checked.

    It writes no file but those that --junit and --out name. The folder then holds check.json and check.png: over which
    steps gradients say how the loss changes.

    Raises ValueError for what the scene does not have, TooLargeError for more points than there is memory for,
    StoreMismatchError where the folder holds another check; Stopped where it is interrupted.

    Example: landscape check bounce

    Parameters
    ----------
    power
        Share of the box, as 5% or 0.05: a defect that fills it is found with 95 %. A smaller one takes more points (59
        at 5 %, 299 at 1 %, 14 at 20 %).
    jobs
        Number of processes that check environments, one each at a time. In Python, more than one needs a script whose
        own work stands under `if __name__ == '__main__':`.
    """
    call, share, folder, prints = current(), as_power(power), as_path(out), as_widths(figure_width_mm)
    if prints and folder is None:
        raise ValueError("--figure-width-mm is of a figure in a folder; give --out, too")
    names = [name for one in (scene, *others) for name in (names_in_file(one) if isinstance(one, str) else [one])]
    specs = [spec_of(name, keywords).resolve(call.watch) for name in names]
    from ..jobs.check import CheckJob
    from ..jobs.checks import CheckReports, ChecksJob, write_junit

    found: CheckReport | CheckReports
    if (many := bool(others) or len(specs) > 1) and folder is not None:
        raise ValueError(f"--out is the folder of one environment; got {len(specs)} environments")
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

    Every installed engine, ours included, goes through the same `landscape check` and is sampled on one small plane.
    The folder then holds card.html, a page of its own with a table and a panel for each engine, card.json, card.npz
    (the slices) and card.png. The table says at which share of the points gradients are wrong, with its interval, the
    cause, and, in scenes with a closed form, how far gradients are from that. All of it is measured, so another release
    of an engine is measured again. Stop at any time: the same command continues with the next engine. The exit code is
    always 0.

    Raises ValueError for a scene that the card does not have, StoreMismatchError where the folder holds a card of other
    versions; Stopped where it is interrupted.

    Example: landscape card --scene "flight"

    Parameters
    ----------
    scenes
        A scene of the card, such as flight. It may be repeated; the default is all scenes.
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

    The folder then holds pairs.json (all pairs) and the evaluated episodes. Stop at any time: the same command
    continues from there.

    Raises ValueError where the scene has one parameter, StoreMismatchError where the folder holds another study;
    Stopped where it is interrupted.

    Example: landscape pairs fluid

    Parameters
    ----------
    samples
        Number of base points, of 1 + 5 x dim + 28 episodes each (fewer below 8 parameters). The default is 16, and down
        to 4 with many parameters.
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

    All is in box units: every parameter runs from 0 to 1 between its bounds. The Hessian is of central differences of
    gradients, whose step is chosen, or of losses where there are no gradients, of up to 30 parameters. Of up to 100
    parameters the whole matrix is computed; of more, the ends of the spectrum by ARPACK, and trace and density by
    Lanczos' method from random probes. An eigenvalue whose error is larger than itself "cannot be told". The folder
    then holds hessian.json, hessian.npz (eigenvalues, eigenvectors, density) and hessian.png. Stop at any time: the
    same command continues from there.

    Raises ValueError for what the scene does not have, and where points fail that the Hessian needs; StoreMismatchError
    where the folder holds another Hessian; Stopped where it is interrupted.

    Example: landscape hessian rosenbrock --through center

    Parameters
    ----------
    through
        Point to measure at: center, random:SEED, example:NAME, best, best:RUN, a file of numbers, or a row of a table,
        TABLE.csv:ROW. In Python also its numbers.
    eigenpairs
        Number of eigenvalues to examine at each end of the spectrum, with their directions.
    probes
        Number of random directions that sample the spectrum of more than 100 parameters.
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
        Names, Parameter(help="A remedy to try, as --remedy takes it. It may be repeated. The default is all.")
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
    """Find out which remedy helps a search: descents from the same starts at the same cost, with each and without.

    A remedy is smoothing, clipping, an average over numerical replicas, another scale of parameters, a shorter episode
    or softer contact; docs/remedies.md explains them. L-BFGS-B descends from random starts. What it finds is evaluated
    without the remedy, and compared start by start. The folder then holds remedy.json, remedy.npz (losses on a plane)
    and remedy.png. Stop at any time: the same command continues with the next remedy.

    Raises ValueError for what the scene does not have; StoreMismatchError where the folder holds another study; Stopped
    where it is interrupted.

    Example: landscape remedy branin --starts 8 --budget 48

    Parameters
    ----------
    starts
        Number of random starts.
    budget
        Cost of each descent, as a number of episodes with gradient. A remedy that takes several episodes a point gets
        fewer points.
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

    A census measures each slice as `landscape report` does. It says to which fraction of the slices each word applies,
    how each measure is distributed, and how much of its variance comes from the point, the orientation, the resolution
    and the fidelity. The folder then holds census.json, census.npz (the losses, in half precision from 0 to 1 between
    `low` and `high` of each slice) and census.png. Stop at any time: the same command continues with the next slice.

    Raises ValueError where the scene has one parameter, StoreMismatchError where the folder holds another census;
    Stopped where it is interrupted.

    Example: landscape census bounce --slices 16

    Parameters
    ----------
    slices
        Number of slices.
    resolution
        Number of points along each axis of a slice.
    gradients
        Compute gradients only at every N-th sample per axis. 2 halves the time if a gradient costs as much as three
        losses.
    along
        How slices are oriented: pairs of parameters, or random directions, both over the whole box.
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

    Rates are the median of alternating repetitions, each at other points of the box. With --second-engine the engines
    alternate too, so that ratios come from one run. It writes no file.

    Raises ValueError for an engine that the scene does not have, TooLargeError for a batch that does not fit.

    Example: landscape bench fluid --second-engine taichi

    Parameters
    ----------
    second_engine
        A second engine, timed in turn with the first.
    batch
        Batch size in episodes. It may be repeated; the default is 1 and the preferred batch of the environment.
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
