"""A league, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .terminal import Console, Table, table

if TYPE_CHECKING:
    from ..optim.league import League


def show(found: League, console: Console, *, claims: bool = False) -> int:
    """Print mean ranks by scene, and the paper's claims with the results if asked.

    The exit code is 1 if a scene could not be raced.

    Parameters
    ----------
    claims
        Check the paper's claims about which method wins.
    """
    console.soft_wrap = True
    console.print(_ranks(found))
    console.print(_cost_ranks(found))
    for scene in found.scenes:
        console.print(f"{scene.env} ({scene.fidelity}): {scene.describe_lead()}")
        if lost := scene.not_told_from_random:
            console.print(f"{scene.env}: not distinguishable from random search: {', '.join(lost)}")
        if best := scene.best:
            unit = f" {scene.loss_unit}" if scene.loss_unit else ""
            console.print(f"{scene.env}: lowest loss {best.loss:.6g}{unit}, by {best.method}, seed {best.seed}")
    if claims:
        shown = _claims(found)
        console.print(shown if shown.row_count else "The paper compares no optimisers in these scenes.")
    return 1 if found.failed else 0


def _ranks(found: League) -> Table:
    title = "mean ranks after all episodes (1 is best), with 95 % intervals over seeds"
    shown = table("scene", *found.methods, title=title)
    for scene in found.scenes:
        by = {one.method: _format(one.rank, one.rank_low, one.rank_high) for one in scene.standings}
        shown.add_row(f"{scene.env} ({scene.fidelity})", *(by.get(method, "") for method in found.methods))
    shown.add_row("all scenes", *(_format(one.rank, one.low, one.high) for one in found.overall))
    return shown


def _cost_ranks(found: League) -> Table:
    """Show ranks within the same cost, because a gradient costs more than a loss."""
    title = "mean ranks at equal forward equivalents, with 95 % intervals over seeds"
    shown = table("scene", *found.methods, title=title)
    for scene in found.scenes:
        by = {one.method: _format(one.rank, one.low, one.high) for one in scene.equal_cost.ranks}
        name = f"{scene.env} ({scene.fidelity}), {scene.equal_cost.forwards:.0f}"
        shown.add_row(name, *(by.get(method, "") for method in found.methods))
    by = {one.method: _format(one.rank, one.low, one.high) for one in found.overall_at_equal_cost}
    shown.add_row("all scenes", *(by[method] for method in found.methods))
    return shown


def _claims(found: League) -> Table:
    from ..gallery.paper import read_paper

    headings = ("scene", "claim", "this league", "wins", "corrected p", "place in the paper")
    shown = table(*headings, title="claims of the paper, and this league")
    for scene in found.scenes:
        for finding in scene.findings(read_paper().claims_about(scene.env)):
            one = finding.superiority
            wins, p = (f"{one.probability:.0%}", f"{one.corrected:.2g}") if one else ("", "")
            shown.add_row(scene.env, str(finding.claim), finding.verdict, wins, p, finding.claim.source)
    return shown


def _format(value: float, low: float, high: float) -> str:
    from math import isfinite

    return f"{value:.2f}" + (f" [{low:.1f}, {high:.1f}]" if isfinite(low) else "")
