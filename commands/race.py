"""`landscape race`: let methods compete, and say which of them is better than which."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..jobs.scene import SceneSpec
from .arguments import (
    Budget,
    Claims,
    ForceRuns,
    Json,
    MethodOption,
    Methods,
    Print,
    Processes,
    Scheduler,
    Seeds,
    read_names,
    read_settings,
    takes_scene,
)

if TYPE_CHECKING:
    from rich.table import Table

    from ..jobs.race_summary import RaceSummary

ENOUGH = 10  # seeds, as the paper has


@takes_scene("tolerance")
def race(
    scene: SceneSpec,
    methods: Methods = None,
    budget: Budget = 1000,
    seeds: Seeds = 10,
    workers: Processes = None,
    scheduler: Scheduler = None,
    option: MethodOption = None,
    out: Annotated[
        str | None, typer.Option(help="Folder for the results. The default is named after the race, under out/.")
    ] = None,
    best_known: Annotated[
        float | None, typer.Option(help="Lowest loss known from elsewhere, at which the targets end.")
    ] = None,
    print_: Print = None,
    json_: Json = False,
    report: Claims = False,
    force: ForceRuns = False,
) -> None:
    """Compare methods on the same budget over several seeds: best losses, targets reached and ranks.

    All runs advance in lockstep, and one batch evaluates the proposals of all of them. The folder then holds race.png,
    race.json (ranks, pairwise comparisons, running times, curves) and a folder per run. Stop at any time: the same
    command goes on from there. More methods, seeds or episodes also continue from there, and finished runs are not
    repeated. --workers and --scheduler exclude each other.

    Example: landscape race fluid --methods random,bo-leap --budget 200 --seeds 3
    """
    from ..jobs.methods import check_methods
    from .terminal import Bars, command_line, print_json

    if workers and scheduler:
        raise ValueError(f"--scheduler has workers of its own, so --workers is left out; got {workers}")
    chosen = check_methods(read_names(methods))
    bars, options = Bars(), read_method_options(option or [], chosen)
    env = scene.make(bars)
    from ..envs.engines.runtime import cores
    from ..gallery.paper import read_paper
    from ..jobs.race import RaceJob
    from ..jobs.workers import workers as cluster

    how: dict[str, Any] = {"out": Path(out) if out else None, "force": force, "prints": print_ or [], "watch": bars}
    how |= {
        "claims": read_paper().claims_about(env.name),
        "command": command_line(),
        "options": options,
        "workers": workers or cores(),
        "best_known": best_known,
    }
    job = RaceJob.of(env, chosen, budget=budget, seeds=seeds, **how)
    with cluster(scheduler, env.device) as executor:
        summary = replace(job, executor=executor).run(bars)
    if json_:
        short = {key: value for key, value in summary.record().items() if key not in ("curves", "ecdf")}
        print_json(short, folder=str(job.folder))
    else:
        _print(summary, claims=report)
    bars.note(f"{job.folder}: {', '.join(summary.files)}")


def read_method_options(settings: Sequence[str], chosen: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return options given as METHOD.NAME=VALUE, method -> name -> value. Raises ValueError for other methods'."""
    from ..optim.registry import methods

    names = chosen or list(methods())
    found: dict[str, dict[str, str]] = {}
    for setting, value in read_settings(settings, "--option").items():
        method, dot, name = setting.partition(".")
        if not dot or method not in names:
            raise ValueError(
                f"--option takes METHOD.NAME=VALUE for one of {', '.join(names)}; got {setting + '=' + value!r}"
            )
        found.setdefault(method, {})[name] = value
    return found


def _print(summary: RaceSummary, *, claims: bool) -> None:
    """Print the ranks, and if asked what the paper claims beside what was measured."""
    from .terminal import Console

    console = Console(soft_wrap=True, highlight=False)
    console.print(_ranks(summary))
    if len(summary.race.statistics.targets.loss):
        console.print(_running_times(summary))
    for line in _comparisons(summary):
        console.print(line)
    if summary.seeds < ENOUGH:
        console.print(_doubt(summary.seeds))
    if claims:
        console.print(_claims(summary) if summary.claims else summary.silence)


def _ranks(summary: RaceSummary) -> Table:
    from ..optim.race import name_seeds
    from .terminal import table

    seeds = name_seeds(summary.seeds)
    shown = table(
        *("method", "mean rank", "wins", f"best loss{_unit(summary)}", "failed", "forward equivalents", "seconds"),
        title=f"{summary.env} · {summary.fidelity} · {summary.budget} episodes · {seeds}",
    )
    for rank in summary.race.statistics.ranks:
        none = f"; none with {name_seeds(rank.unsuccessful)}" if rank.unsuccessful else ""
        shown.add_row(
            rank.method,
            _format_interval(rank.rank, rank.rank_low, rank.rank_high, 2),
            str(rank.wins),
            _format_interval(rank.mean, rank.low, rank.high, 3) + none,
            str(rank.failed),
            f"{rank.forward_equivalents:.0f}",
            f"{rank.seconds:.3g}",
        )
    return shown


def _running_times(summary: RaceSummary) -> Table:
    """Show the expected running time of every method for some of the targets, the easiest first."""
    from math import isfinite

    from .terminal import table

    figures = summary.race.statistics
    some = figures.targets.some[::-1]
    losses = [f"{figures.targets.loss[number]:.3g}" for number in some]
    title = f"episodes that a method takes to reach a loss{_unit(summary)}, by restarts until it does"
    shown = table("method", *losses, title=title)
    for rank in figures.ranks:
        times = figures.times[rank.method][some]
        shown.add_row(rank.method, *(f"{one:.0f}" if isfinite(one) else "never" for one in times))
    return shown


def _comparisons(summary: RaceSummary) -> list[str]:
    """Say of each method, by rank, which others it is better than, and how often it wins against each."""
    figures, lines = summary.race.statistics, list[str]()
    pairs = list(zip(figures.differences, figures.superiorities, strict=True))
    for better in (rank.method for rank in figures.ranks):
        seen = [chance if chance.first == better else chance.reversed for one, chance in pairs if one.better == better]
        if seen:
            said = (f"{one.second} (wins {one.probability:.0%}, corrected p {one.corrected:.2g})" for one in seen)
            lines.append(f"{better} is better than {', '.join(said)}")
    return lines


def _doubt(seeds: int) -> str:
    from ..optim.race import name_seeds

    if seeds == 1:
        return "one seed: no intervals, so no method is better than another"
    return (
        f"{name_seeds(seeds)}: too few for intervals as wide as they should be "
        "(with 3 they cover the true mean in 75 % of cases, with 10 in 91 %; "
        "of two equal methods they call one better in 20 % and 7 %)"
    )


def _claims(summary: RaceSummary) -> Table:
    from .terminal import table

    means = f"difference of mean losses{_unit(summary)}"
    headings = ("claim", "this race", "wins", "corrected p", means, "where the paper says so")
    shown = table(*headings, title="what the paper claims, and this race")
    for finding in summary.claims:
        one = finding.difference
        numbers = _format_interval(one.mean, one.low, one.high, 3) if one else ""
        chance = finding.superiority
        wins, p = (f"{chance.probability:.0%}", f"{chance.corrected:.2g}") if chance else ("", "")
        shown.add_row(str(finding.claim), finding.verdict, wins, p, numbers, finding.claim.source)
    return shown


def _unit(summary: RaceSummary) -> str:
    return f" [{summary.loss_unit}]" if summary.loss_unit else ""


def _format_interval(value: float, low: float, high: float, digits: int) -> str:
    """Write a number and its interval, as far as they are finite."""
    from math import isfinite

    if not isfinite(value):
        return "none"
    return f"{value:.{digits}g}" + (f" [{low:.{digits}g}, {high:.{digits}g}]" if isfinite(low) else "")
