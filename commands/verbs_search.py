"""Verbs that search: methods, runs of one, races of several, runs laid over a slice."""

from __future__ import annotations

from typing import Annotated

import typer

from .arguments import (
    Budget,
    Deterministic,
    Device,
    Engine,
    Env,
    Fidelity,
    ForceRun,
    Json,
    Of,
    OutOfRun,
    Print,
    Scheduler,
    Set,
    Tolerance,
)


def methods(name: Annotated[str | None, typer.Argument(help="One method, to see all of it.")] = None) -> None:
    """List the optimisation methods: what each does, its options and their defaults."""
    from .search_report import describe_method, list_methods

    describe_method(name) if name else list_methods()


def optimize(
    env: Env,
    method: Annotated[str, typer.Option(help="The method; `landscape methods` lists them.")],
    budget: Budget = 1000,
    seed: Annotated[int, typer.Option(min=0, help="What the method's random numbers begin with.")] = 0,
    fidelity: Fidelity = None,
    tolerance: Tolerance = None,
    device: Device = "auto",
    engine: Engine = "warp",
    deterministic: Deterministic = False,
    set_: Set = None,
    option: Annotated[list[str] | None, typer.Option(help="A method's option, name=value; may be repeated.")] = None,
    out: OutOfRun = None,
    print_: Print = None,
    json_: Json = False,
    force: ForceRun = False,
) -> None:
    """Search an environment's parameters for the least loss, and keep every point that was evaluated.

    Stop it at any moment: the same command goes on where it stopped. With a larger budget it goes on from the end, to
    the run that had this budget from the beginning.
    """
    from .search_report import optimize as report

    report(
        env,
        method,
        budget=budget,
        seed=seed,
        fidelity=fidelity,
        tolerance=tolerance,
        device=device,
        engine=engine,
        deterministic=deterministic,
        settings=set_ or [],
        method_settings=option or [],
        out=out,
        prints=print_ or [],
        as_json=json_,
        force=force,
    )


def race(
    env: Env,
    methods: Annotated[
        list[str] | None,
        typer.Option(help="Methods, a,b or repeated; by default all that can run here (`landscape methods`)."),
    ] = None,
    budget: Budget = 1000,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each method, with seeds 0, 1, ...")] = 10,
    workers: Annotated[
        int, typer.Option(min=1, help="Runs at a time, each in a thread; losses do not depend on it, seconds do.")
    ] = 1,
    scheduler: Scheduler = None,
    fidelity: Fidelity = None,
    device: Device = "auto",
    engine: Engine = "warp",
    deterministic: Deterministic = False,
    set_: Set = None,
    option: Annotated[
        list[str] | None, typer.Option(help="A method's option, METHOD.NAME=VALUE; may be repeated.")
    ] = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the race.")
    ] = None,
    print_: Print = None,
    json_: Json = False,
    report: Annotated[bool, typer.Option("--report", help="Say which of the paper's orderings hold.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Begin anew where these runs exist already.")] = False,
) -> None:
    """Let methods compete on the same budget, with several seeds each: best loss, targets reached, ranks.

    Stop it at any moment: the same command goes on where it stopped. More methods, seeds or episodes go on from there
    too; runs that are finished are not repeated.
    """
    from .race_report import race as report_race

    report_race(
        env,
        methods or [],
        budget=budget,
        seeds=seeds,
        workers=workers,
        fidelity=fidelity,
        device=device,
        engine=engine,
        deterministic=deterministic,
        settings=set_ or [],
        method_settings=option or [],
        out=out,
        prints=print_ or [],
        as_json=json_,
        report=report,
        force=force,
        scheduler=scheduler,
    )


def overlay(
    slice_: Annotated[str, typer.Argument(metavar="SLICE", help="A slice's folder.")],
    runs: Annotated[list[str], typer.Argument(metavar="RUN", help="Folders of runs; a race's for all of it.")],
    env: Of = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results; by default one under out/ named after the overlay.")
    ] = None,
    print_: Print = None,
    through: Annotated[
        str | None, typer.Option(help="Cut anew through the best point of all runs (best) or of one run's folder.")
    ] = None,
    plane: Annotated[str | None, typer.Option(help="Cut anew along the runs' two principal directions: pca.")] = None,
    resolution: Annotated[
        int | None, typer.Option(min=2, help="Points along each axis of a new slice; by default as in SLICE.")
    ] = None,
    device: Device = "auto",
    spawn: Annotated[bool, typer.Option("--spawn", help="Open it in rerun's viewer.")] = False,
    serve: Annotated[bool, typer.Option("--serve", help="Serve it to a browser here, until Ctrl-C.")] = False,
) -> None:
    """Draw runs over a slice: where they went, how far off its plane, and what it does not show of what they found.

    Writes overlay.png, and overlay.rrd to walk around in and to play back.
    """
    from .overlay_report import overlay as report

    report(
        slice_,
        runs,
        source=env,
        out=out,
        prints=print_ or [],
        through=through,
        plane=plane,
        resolution=resolution,
        device=device,
        spawn=spawn,
        serve=serve,
    )
