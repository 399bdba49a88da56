"""The result of a check, on the terminal: what is wrong and what to try, then tables, then each check."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

from .terminal import SIMPLE, Console, Table, Text, table

if TYPE_CHECKING:
    from ..jobs.check import CheckReport
    from ..landscapes.checks.diagnosis import Diagnosis
    from ..landscapes.checks.finding import Finding
    from ..landscapes.checks.parameters import ParameterRow

STYLES = {
    "pass": "green",
    "fail": "bold red",
    "skip": "dim",
    "warn": "yellow",
    "known": "yellow",
    "unexpected": "bold red",
}
FEW_PARAMETERS = 12  # of which every one has a line
SOUND = ("agrees", "moved with others only")
WIDTH = 110


def show(found: CheckReport, console: Console) -> int:
    """Print what is wrong, tables, and each check; the exit code is 1 where the environment fails."""
    console.soft_wrap = True
    for diagnosis in found.diagnoses:
        _show_diagnosis(diagnosis, console)
    if rows := _interesting(found.parameters):
        console.print(_parameters(rows))
    for finding in found.findings:
        if finding.table:
            console.print(_ladder(finding))
    for outcome in ("fail", "unexpected", "known", "warn"):
        for finding in found.findings:
            if finding.outcome == outcome:
                _show(finding, console)
    for finding in found.findings:
        if finding.outcome == "pass":
            _show(finding, console)
    _show_skipped(found.findings, console)
    _conclude(found, console)
    return 0 if found.passed else 1


def _show_diagnosis(one: Diagnosis, console: Console) -> None:
    line = Text(f"{one.outcome:10}", STYLES[one.outcome])
    line.append(f"{one.cause or 'no known cause'}", "bold")
    line.append(f" ({one.certainty}): {one.what}", "")
    console.print(line)
    console.print(Text(f"{'':10}Try: {one.remedy}"))


def _interesting(rows: Sequence[ParameterRow]) -> Sequence[ParameterRow]:
    """Return the parameters to show: all where they are few and some are wrong, else those that are wrong."""
    odd = [row for row in rows if row.verdict not in SOUND]
    return rows if odd and len(rows) <= FEW_PARAMETERS else odd[:FEW_PARAMETERS]


def _parameters(rows: Sequence[ParameterRow]) -> Table:
    found = table("parameter", "share exactly 0", "gradient / slope over 1e-2", "verdict", box=SIMPLE)
    for row in rows:
        ratio = "-" if row.ratio != row.ratio else f"{row.ratio:.4g}"
        found.add_row(row.parameter, f"{row.zero:.0%}" if row.zero == row.zero else "-", ratio, row.verdict)
    return found


def _show(finding: Finding, console: Console) -> None:
    line = Text(f"{finding.outcome:10}", STYLES[finding.outcome])
    line.append(f"{finding.check:25} {finding.figure}", "")
    if finding.why:
        line.append(f" ({finding.why})", STYLES[finding.outcome])
    console.print(line)


def _show_skipped(findings: Sequence[Finding], console: Console) -> None:
    left = [f"{one.check} ({one.why or one.figure})" for one in findings if one.outcome == "skip"]
    if left:
        lines = textwrap.wrap(", ".join(left), WIDTH)
        text = f"\n{'':10}".join(lines)
        console.print(Text(f"{'skip':10}{text}", STYLES["skip"]))


def _ladder(finding: Finding) -> Table:
    headings = ("compared", "failed", "cosine", "sign right", "relative error, median")
    found = table("step [of the box]", *headings, box=SIMPLE)
    for column in found.columns[1:]:
        column.justify = "right"
    formats = {"compared": ".0f", "failed": ".0f", "cosine": ".4f", "sign": ".0%", "error": ".1e"}
    for row in finding.table:
        cells = ("-" if row[key] is None else format(row[key], form) for key, form in formats.items())
        found.add_row(f"{row['step']:.0e}", *cells)
    return found


def _conclude(found: CheckReport, console: Console) -> None:
    counts = {kind: sum(finding.outcome == kind for finding in found.findings) for kind in STYLES}
    said = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    console.print(Text(f"{'passes' if found.passed else 'fails'}: {said}", STYLES["pass" if found.passed else "fail"]))
