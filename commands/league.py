"""`landscape league`: the same methods raced in many scenes, and how each came off over all of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .arguments import (
    Budget,
    Claims,
    Deterministic,
    Device,
    Fidelity,
    ForceRuns,
    Json,
    Methods,
    Print,
    Processes,
    Scheduler,
    Seeds,
    read_names,
    refuse_words,
)

if TYPE_CHECKING:
    from rich.table import Table

    from ..optim.league import League


def league(
    envs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ENV...]",
            help="Environments to race in, as ENV or ENV@FIDELITY. The default is all sixteen that "
            "gradscape simulates itself.",
        ),
    ] = None,
    methods: Methods = None,
    budget: Budget = 1000,
    seeds: Seeds = 10,
    fidelity: Fidelity = None,
    device: Device = "auto",
    deterministic: Deterministic = False,
    workers: Processes = None,
    scheduler: Scheduler = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results. The default, under out/, holds all leagues on a device.")
    ] = None,
    print_: Print = None,
    json_: Json = False,
    report: Claims = False,
    force: ForceRuns = False,
) -> None:
    """Race the same methods in many environments, and rank them in each and overall.

    It first says what is there of each environment and how long the others take to simulate. The folder then holds a
    race per environment, as `landscape race` leaves it, league.png (mean ranks) and league.json (a row per environment
    and method, and the best points). Stop at any time: the same command goes on from there. More environments,
    methods, seeds or episodes also continue from there. An environment that fails is named with the reason, the others
    are raced, and the exit code is 1.

    Example: landscape league bounce fluid@standard --methods random,cma-es,bo-leap --budget 200 --seeds 3
    """
    from ..jobs.methods import check_methods
    from ..jobs.scene import SceneSpec, read_scene
    from .terminal import Bars, command_line, print_json

    if workers and scheduler:
        raise ValueError(f"--scheduler has workers of its own, so --workers is left out; got {workers}")
    bars, one = Bars(), SceneSpec("", fidelity, device=device, deterministic=deterministic)
    chosen = read_names(methods)
    check_methods(chosen)
    for text in envs or ():
        refuse_words(read_scene(text, one))
    from ..envs.engines.runtime import cores
    from ..gallery.paper import read_paper
    from ..jobs.league import PICTURE, RECORD, LeagueJob, simulated_scenes
    from ..jobs.workers import workers as cluster
    from ..landscapes.convert import to_json

    how: dict[str, Any] = {"out": Path(out) if out else None, "force": force, "prints": print_ or []}
    scenes = [read_scene(text, one) for text in envs or simulated_scenes()]
    job = LeagueJob.of(scenes, chosen, budget=budget, seeds=seeds, command=command_line(), **how)
    claims = {fixture.name: read_paper().claims_about(fixture.name) for fixture in job.fixtures}
    with cluster(scheduler, device) as executor:
        found = replace(job, claims=claims, workers=workers or cores(), executor=executor).run(bars)
    if json_:
        print_json(to_json(found), folder=str(job.folder))
    else:
        _print(found, claims=report)
    bars.note(f"{job.folder}: {RECORD}, {PICTURE}, and a race in each folder")
    if found.failed:
        bars.note(f"{len(found.failed)} of {len(job.fixtures)} scenes were left out: {', '.join(found.failed)}")
        raise typer.Exit(1)


def _print(found: League, *, claims: bool) -> None:
    """Print mean ranks by scene, and if asked what the paper claims beside what was measured."""
    from .terminal import Console

    console = Console(soft_wrap=True, highlight=False)
    console.print(_ranks(found))
    for scene in found.scenes:
        if best := scene.best:
            unit = f" {scene.loss_unit}" if scene.loss_unit else ""
            console.print(f"{scene.env}: least loss {best.loss:.6g}{unit}, by {best.method}, seed {best.seed}")
    if claims:
        shown = _claims(found)
        console.print(shown if shown.row_count else "The paper compares no optimisers in these scenes.")


def _ranks(found: League) -> Table:
    from .terminal import table

    shown = table("scene", *found.methods, title="mean ranks, 1 is best, with 95 % intervals over seeds")
    for scene in found.scenes:
        by = {one.method: _format(one.rank, one.rank_low, one.rank_high) for one in scene.standings}
        shown.add_row(f"{scene.env} ({scene.fidelity})", *(by.get(method, "") for method in found.methods))
    shown.add_row("all scenes", *(_format(one.rank, one.low, one.high) for one in found.overall))
    return shown


def _claims(found: League) -> Table:
    from ..gallery.paper import read_paper
    from .terminal import table

    headings = ("scene", "claim", "this league", "wins", "corrected p", "where the paper says so")
    shown = table(*headings, title="what the paper claims, and this league")
    for scene in found.scenes:
        for finding in scene.findings(read_paper().claims_about(scene.env)):
            one = finding.superiority
            wins, p = (f"{one.probability:.0%}", f"{one.corrected:.2g}") if one else ("", "")
            shown.add_row(scene.env, str(finding.claim), finding.verdict, wins, p, finding.claim.source)
    return shown


def _format(value: float, low: float, high: float) -> str:
    from math import isfinite

    return f"{value:.2f}" + (f" [{low:.1f}, {high:.1f}]" if isfinite(low) else "")
