"""`landscape check`: whether an environment keeps what every environment promises."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from ..jobs.scene import SceneSpec
from .arguments import Json, Seed, takes_scene

if TYPE_CHECKING:
    from rich.table import Table

    from ..landscapes.conformance.finding import Finding
    from .terminal import Console

STYLES = {
    "pass": "green",
    "fail": "bold red",
    "skip": "dim",
    "warn": "yellow",
    "known": "yellow",
    "unexpected": "bold red",
}


@takes_scene("tolerance", "deterministic")
def check(
    scene: SceneSpec,
    points: Annotated[int, typer.Option(min=2, help="Number of random points to check at.")] = 4,
    seed: Seed = 0,
    json_: Json = False,
) -> None:
    """Check that the gradients of an environment are right, and that it behaves at the extremes.

    It checks shapes, refusals, batches, determinism, gradients against differences at several steps and at special
    points, their growth with the horizon, forward against reverse differentiation if both exist, corners of the box
    and beyond, long time steps, materials, horizons and precision. Each check prints a line. A warning is no failure:
    the gradient is right, but useless over an optimiser's step. The exit code is 0 if the environment passes, else 1.
    It writes no file.

    Example: landscape check bounce
    """
    from ..jobs.check import CheckJob
    from .terminal import Bars, Console, command_line, print_json

    bars = Bars()
    console = bars.console if json_ else Console(soft_wrap=True, highlight=False)
    job = CheckJob.open(scene, points=points, seed=seed, command=command_line())
    found = []
    for finding in job.findings(bars):
        found.append(finding)
        _show(finding, console)
    report = job.report(tuple(found))
    _conclude(found, report.passed, console)
    if json_:
        print_json(report.record())
    sys.exit(0 if report.passed else 1)


def _show(finding: Finding, console: Console) -> None:
    from rich.text import Text

    line = Text(f"{finding.outcome:10}", STYLES[finding.outcome])
    line.append(f"{finding.check:25} {finding.figure}", "")
    if finding.why:
        line.append(f" ({finding.why})", STYLES[finding.outcome])
    console.print(line)
    if finding.table:
        console.print(_table(finding))


def _table(finding: Finding) -> Table:
    from rich.box import SIMPLE

    from .terminal import table

    headings = ("compared", "failed", "cosine", "sign right", "relative error, median")
    found = table("step [of the box]", *headings, box=SIMPLE)
    for column in found.columns[1:]:
        column.justify = "right"
    formats = {"compared": ".0f", "failed": ".0f", "cosine": ".4f", "sign": ".0%", "error": ".1e"}
    for row in finding.table:
        cells = ("-" if row[key] is None else format(row[key], form) for key, form in formats.items())
        found.add_row(f"{row['step']:.0e}", *cells)
    return found


def _conclude(found: Sequence[Finding], passed: bool, console: Console) -> None:
    from rich.text import Text

    counts = {kind: sum(finding.outcome == kind for finding in found) for kind in STYLES}
    said = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    console.print(Text(f"{'passes' if passed else 'fails'}: {said}", STYLES["pass" if passed else "fail"]))
