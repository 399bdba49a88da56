"""A race in words and numbers: the table of ranks, and the paper's claims beside what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from .terminal import Console, table

ENOUGH = 10  # seeds, as the paper has


def show(figures: Mapping[str, Any], console: Console, *, claims: bool) -> None:
    """Print the ranks, and if asked what the paper claims beside what was measured."""
    console.print(_ranks(figures))
    for method, others in _beaten(figures).items():
        console.print(f"{method} is better than {', '.join(others)}")
    if figures["seeds"] < ENOUGH:
        console.print(_doubt(figures["seeds"]))
    if claims:
        console.print(_claims(figures) if figures["claims"] else figures["silence"])


def _ranks(figures: Mapping[str, Any]) -> Table:
    unit = f" [{figures['loss_unit']}]" if figures["loss_unit"] else ""
    title = f"{figures['env']} · {figures['fidelity']} · {figures['budget']} episodes · {seeds_said(figures['seeds'])}"
    headings = ("method", "mean rank", "wins", f"best loss{unit}", "failed", "forwards", "seconds")
    found = table(*headings, title=title)
    for rank in figures["ranks"]:
        none = f"; none with {seeds_said(rank['unsuccessful'])}" if rank["unsuccessful"] else ""
        found.add_row(
            rank["method"],
            _ranged(rank["rank"], rank["rank_low"], rank["rank_high"], 2),
            str(rank["wins"]),
            _ranged(rank["mean"], rank["low"], rank["high"], 3) + none,
            str(rank["failed"]),
            f"{rank['forwards']:.0f}",
            f"{rank['seconds']:.3g}",
        )
    return found


def _beaten(figures: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the methods that are better than others, by rank: the intervals of these differences exclude zero."""
    found: dict[str, list[str]] = {}
    for better in (rank["method"] for rank in figures["ranks"]):
        pairs = [{one["first"], one["second"]} for one in figures["differences"] if one["better"] == better]
        if pairs:
            found[better] = [(pair - {better}).pop() for pair in pairs]
    return found


def _doubt(seeds: int) -> str:
    if seeds == 1:
        return "one seed: no intervals, so no method is better than another"
    return (
        f"{seeds_said(seeds)}: too few for intervals as wide as they should be "
        "(with 3 they cover the true mean in 75 % of cases, with 10 in 91 %; "
        "of two equal methods they call one better in 20 % and 7 %)"
    )


def _claims(figures: Mapping[str, Any]) -> Table:
    unit = f" [{figures['loss_unit']}]" if figures["loss_unit"] else ""
    headings = ("claim", "this race", f"difference of mean losses{unit}", "where the paper says so")
    shown = table(*headings, title="what the paper claims, and this race")
    for claim in figures["claims"]:
        found = claim["difference"]
        numbers = _ranged(found["mean"], found["low"], found["high"], 3) if found else ""
        shown.add_row(claim["claim"], claim["verdict"], numbers, claim["source"])
    return shown


def _ranged(value: float | None, low: float | None, high: float | None, digits: int) -> str:
    if value is None:
        return "none"
    return f"{value:.{digits}g}" + (f" [{low:.{digits}g}, {high:.{digits}g}]" if low is not None else "")


def seeds_said(count: int) -> str:
    """Return a number of seeds in words."""
    return f"{count} seed{'s' if count > 1 else ''}"
