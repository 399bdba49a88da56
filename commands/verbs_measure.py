"""Verbs that measure: cost, speed, promises, accuracy, parameters, character."""

from __future__ import annotations

from typing import Annotated

import typer

from .arguments import (
    Data,
    Deterministic,
    Device,
    Dims,
    Engine,
    Env,
    Extent,
    Fidelity,
    ForceStudy,
    Json,
    NoGradients,
    Of,
    OutOfStudy,
    Print,
    Set,
    Through,
)


def plan(
    what: Annotated[str, typer.Argument(metavar="ENV|FIGURES.toml", help="An environment, or a list of figures.")],
    dims: Dims = ["0", "1"],  # noqa: B006 -- typer reads it, nobody changes it
    over: Annotated[
        str | None, typer.Option(help="Plan a sweep: what moves from frame to frame, as for `landscape sweep`.")
    ] = None,
    frames: Annotated[int, typer.Option(min=2, help="Frames of the sweep.")] = 24,
    resolution: Annotated[
        int | None, typer.Option(min=2, help="Points along each axis; 16, or what the figures say.")
    ] = None,
    fidelity: Fidelity = None,
    device: Device = "auto",
    engine: Engine = "warp",
    through: Through = "center",
    extent: Extent = None,
    set_: Set = None,
    no_gradients: NoGradients = False,
    workers: Annotated[int, typer.Option(min=1, help="Workers, each with a device such as this one.")] = 1,
    json_: Json = False,
) -> None:
    """Predict episodes, time, memory and disk of a slice, a sweep or the gallery's slices, without making them.

    A few episodes, tiles and pictures are made and thrown away. For a CUDA device that is not here, what
    `landscape tradeoff` kept of one counts.
    """
    from .plan_report import plan as report

    report(
        what,
        dims=dims,
        over=over,
        frames=frames,
        resolution=resolution,
        fidelity=fidelity,
        device=device,
        engine=engine,
        through=through,
        extent=extent,
        settings=set_ or [],
        grad=not no_gradients,
        workers=workers,
        as_json=json_,
    )


def bench(
    env: Env,
    fidelity: Fidelity = None,
    device: Device = "auto",
    engine: Engine = "warp",
    deterministic: Deterministic = False,
    against: Annotated[str | None, typer.Option(help="Another engine, to run in turn with the first.")] = None,
    batch: Annotated[
        list[int] | None,
        typer.Option(min=1, help="Episodes at once; may be repeated. By default 1 and what the environment prefers."),
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.0, help="How long to time each batch size, about.")] = 10.0,
    set_: Set = None,
    json_: Json = False,
) -> None:
    """Measure episodes per second, forward and with gradient, and what they are spent on.

    Rates are the best of repetitions that alternate; with --against, engines alternate too, and ratios are of one run.
    """
    from .bench_report import bench as report

    report(
        env,
        fidelity=fidelity,
        device=device,
        engine=engine,
        deterministic=deterministic,
        against=against,
        batches=batch or [],
        seconds=seconds,
        settings=set_ or [],
        as_json=json_,
    )


def check(
    env: Env,
    fidelity: Fidelity = None,
    device: Device = "auto",
    engine: Engine = "warp",
    set_: Set = None,
    points: Annotated[int, typer.Option(min=2, help="Random points of the box to check at.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="What the points begin with.")] = 0,
    json_: Json = False,
) -> None:
    """Check that an environment keeps what every environment promises, and what it says at the extremes.

    Shapes, refusals, batches, determinism, gradients against differences over a ladder of steps, corners of the box and
    beyond, long time steps, materials, horizons, precision. Exit code 0 says that it passes, 1 that it fails.
    """
    from .check_report import check as report

    report(
        env,
        fidelity=fidelity,
        device=device,
        engine=engine,
        settings=set_ or [],
        points=points,
        seed=seed,
        as_json=json_,
    )


def tradeoff(
    env: Env,
    points: Annotated[int, typer.Option(min=2, help="Sobol points at which every fidelity is measured.")] = 64,
    seed: Annotated[int, typer.Option(min=0, help="What the points and the bootstrap begin with.")] = 0,
    ladder: Annotated[
        list[str] | None,
        typer.Option(
            help="What to turn beside the named fidelities, a,b or repeated: dt, resolution, particles, precision, "
            "stiffness, engine, device; by default all that the scene has."
        ),
    ] = None,
    device: Device = "auto",
    engine: Engine = "warp",
    set_: Set = None,
    out: OutOfStudy = None,
    print_: Print = None,
    json_: Json = False,
    force: ForceStudy = False,
) -> None:
    """Measure accuracy against speed: the same points at a ladder of fidelities, each against the reference.

    Writes tradeoff.png and tradeoff.json, and keeps the latter for --tolerance. Stop it at any moment: the same command
    goes on with the next rung.
    """
    from .tradeoff_report import tradeoff as report

    report(
        env,
        points=points,
        seed=seed,
        device=device,
        engine=engine,
        ladders=ladder or [],
        settings=set_ or [],
        out=out,
        prints=print_ or [],
        as_json=json_,
        force=force,
    )


def pairs(
    env: Env,
    samples: Annotated[
        int | None,
        typer.Option(
            min=2,
            help="Base points, each of 1 + 5 x dim + 28 episodes (fewer below 8 parameters); by default 16, from some "
            "20 parameters on fewer, down to 4.",
        ),
    ] = None,
    fidelity: Fidelity = None,
    device: Device = "auto",
    engine: Engine = "warp",
    seed: Annotated[int, typer.Option(min=0, help="What the points begin with.")] = 0,
    top: Annotated[int, typer.Option(min=1, help="Pairs to show.")] = 10,
    set_: Set = None,
    out: OutOfStudy = None,
    json_: Json = False,
    force: ForceStudy = False,
) -> None:
    """Rank pairs of parameters by sensitivity, ruggedness and misleading gradients: which slices to look at.

    Stop it at any moment: the same command goes on where it stopped.
    """
    from .pairs_report import pairs as report

    report(
        env,
        samples=samples,
        fidelity=fidelity,
        device=device,
        engine=engine,
        seed=seed,
        top=top,
        settings=set_ or [],
        out=out,
        as_json=json_,
        force=force,
    )


def report_(
    what: Annotated[
        str | None,
        typer.Argument(metavar="[SLICE|ENV]", help="A slice's folder, or an environment: its figures, else one slice."),
    ] = None,
    env: Of = None,
    everything: Annotated[bool, typer.Option("--all", help="Every figure of the gallery that is sampled.")] = False,
    fidelity: Fidelity = None,
    device: Device = "auto",
    points: Annotated[
        int, typer.Option(min=2, help="Points along each axis where gradients are tested by new evaluations.")
    ] = 6,
    seed: Annotated[int, typer.Option(min=0, help="What random numbers begin with.")] = 0,
    data: Data = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the report.")
    ] = None,
    print_: Print = None,
    json_: Json = False,
) -> None:
    """Say what a landscape is like: minima, flatness, jumps, correlation, gradient quality, and the verdict.

    Writes report.json, measures.json and gradient-quality.png. Stop it at any moment: finished slices are kept. With
    --all a slice that fails is named at the end, and exit code is 1. docs/measures.md says what each number means.
    """
    from .measure_report import report

    report(
        what,
        source=env,
        everything=everything,
        fidelity=fidelity,
        device=device,
        points=points,
        seed=seed,
        data=data,
        out=out,
        prints=print_ or [],
        as_json=json_,
    )
