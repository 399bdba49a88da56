"""What a check found, on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from .terminal import Console, table

if TYPE_CHECKING:
    from rich.table import Table

    from ..jobs.check import CheckReport
    from ..landscapes.checks.finding import Finding

STYLES = {
    "pass": "green",
    "fail": "bold red",
    "skip": "dim",
    "warn": "yellow",
    "known": "yellow",
    "unexpected": "bold red",
}


def show(found: CheckReport, console: Console) -> int:
    """Print a line for each check and the sum of them; the exit code is 1 where the environment fails."""
    console.soft_wrap = True
    for finding in found.findings:
        _show(finding, console)
    _conclude(found.findings, found.passed, console)
    return 0 if found.passed else 1


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
