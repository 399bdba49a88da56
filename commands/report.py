"""Reports of landscapes, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .terminal import Console, Table, table

if TYPE_CHECKING:
    from ..jobs.report import Report, Reports
    from ..landscapes.measures.features import Features


def show(report: Report, console: Console) -> None:
    """Print one slice's measures and verdict."""
    found = table("measure", "value, 95 % interval", title=f"{report.name} ({report.env})")
    for name, text in report.measures.items():
        found.add_row(name, text)
    console.print(found)
    for line in report.verdict_lines():
        console.print(line)
    if report.features:
        console.print(_features_table(report.features))


def _features_table(features: Features) -> Table:
    """Return the features over all parameters, a row each."""
    found = table("feature over all parameters", "value, 95 % interval", "meaning")
    for row in features.rows():
        found.add_row(*row)
    return found


def show_several(found: Reports, console: Console) -> int:
    """Print a row for each slice; the exit code is 1 where one failed."""
    from ..jobs.report import HEADINGS, slice_rows

    rows = table(*HEADINGS, title="landscapes")
    for row in slice_rows(found.reports):
        rows.add_row(*row)
    console.print(rows)
    return 1 if found.failed else 0
