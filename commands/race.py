"""A race, on the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite
from typing import TYPE_CHECKING

from .terminal import Console, Table, table

if TYPE_CHECKING:
    from ..optim.race import Race
    from ..optim.statistics import Superiority

PAPER_SEEDS = 10  # as many as the paper has


def show(race: Race, console: Console, *, claims: bool = False) -> None:
    """Print ranks and comparisons, and the paper's claims with the results if asked.

    Parameters
    ----------
    claims
        Check the paper's claims about which method wins.
    """
    console.soft_wrap = True
    console.print(_ranks(race))
    if len(race.statistics.targets.loss):
        console.print(_running_times(race))
    for line in _comparisons(race):
        console.print(line)
    if race.seeds < PAPER_SEEDS:
        console.print(_doubt(race.seeds))
    if claims:
        console.print(_claims(race))


def _ranks(race: Race) -> Table:
    from ..optim.race import name_seeds

    seeds, at_cost = name_seeds(race.seeds), race.statistics.equal_cost
    cost_ranks = {one.method: _format_interval(one.rank, one.low, one.high, 2) for one in at_cost.ranks}
    shown = table(
        *("method", "mean rank", "at equal cost", "wins"),
        *(f"best loss{_unit(race)}", "failed", "forward equivalents", "seconds"),
        title=f"{race.identity['objective']} · {race.identity['fidelity']} · {race.budget} episodes · {seeds}",
    )
    for rank in race.statistics.ranks:
        none = f"; none with {name_seeds(rank.unsuccessful)}" if rank.unsuccessful else ""
        shown.add_row(
            rank.method,
            _format_interval(rank.rank, rank.rank_low, rank.rank_high, 2),
            cost_ranks[rank.method],
            str(rank.wins),
            _format_interval(rank.mean, rank.low, rank.high, 3) + none,
            str(rank.failed),
            f"{rank.forwards:.0f}",
            f"{rank.seconds:.3g}",
        )
    return shown


def _running_times(race: Race) -> Table:
    """Show the expected running time of every method for some of the targets, the easiest first."""
    figures = race.statistics
    some = figures.targets.some[::-1]
    losses = [f"{figures.targets.loss[number]:.3g}" for number in some]
    title = f"expected episodes to reach a loss{_unit(race)}, with restarts"
    shown = table("method", *losses, title=title)
    for rank in figures.ranks:
        times = figures.running_times[rank.method][some]
        shown.add_row(rank.method, *(f"{one:.0f}" if isfinite(one) else "never" for one in times))
    return shown


def _comparisons(race: Race) -> Iterator[str]:
    """Say which method leads, and which others each method is better than, or not distinguishable from, by rank."""
    figures = race.statistics
    seen = [one for pair in figures.superiorities for one in (pair, pair.reversed)]
    if not seen:
        return
    count = len(figures.superiorities)
    yield f"after {race.budget} episodes: {figures.lead.describe()}"
    at_cost = figures.equal_cost
    yield f"within {at_cost.forwards:.0f} forward equivalents each: {at_cost.lead.describe()}"
    yield f"p is from the rank test, corrected for {count} comparison{'s' if count > 1 else ''}"
    for method in (rank.method for rank in figures.ranks):
        own = [one for one in seen if one.first == method]
        if said := [_pair(one) for one in own if one.better == method]:
            yield f"{method} is better than {', '.join(said)}"
        if said := [_pair(one) for one in own if one.better is None]:
            yield f"{method} is not distinguishable from {', '.join(said)}"


def _pair(one: Superiority) -> str:
    return f"{one.second} (wins {one.probability:.0%}, corrected p {one.corrected:.2g})"


def _doubt(seeds: int) -> str:
    from ..optim.race import name_seeds

    if seeds == 1:
        return "one seed gives no intervals, so no method counts as better than another"
    return (
        f"the intervals from {name_seeds(seeds)} are too narrow "
        "(with 3 seeds they cover the true mean in 75 % of cases, with 10 in 91 %)"
    )


def _claims(race: Race) -> Table | str:
    """Return the paper's claims about the environment with the results of this race, or why there is no claim."""
    from ..gallery.paper import read_paper
    from ..optim.claims import check_claims

    claimed = read_paper().claims_about(str(race.identity["objective"]))
    if not claimed.claims:
        return claimed.silence or ""
    means = f"difference of mean losses{_unit(race)}"
    headings = ("claim", "this race", "wins", "corrected p", means, "place in the paper")
    shown = table(*headings, title="claims of the paper, and this race")
    for finding in check_claims(claimed.claims, race.statistics.differences, race.statistics.superiorities):
        one = finding.difference
        numbers = _format_interval(one.mean, one.low, one.high, 3) if one else ""
        chance = finding.superiority
        wins, p = (f"{chance.probability:.0%}", f"{chance.corrected:.2g}") if chance else ("", "")
        shown.add_row(str(finding.claim), finding.verdict, wins, p, numbers, finding.claim.source)
    return shown


def _unit(race: Race) -> str:
    return f" [{race.loss_unit}]" if race.loss_unit else ""


def _format_interval(value: float, low: float, high: float, digits: int) -> str:
    """Write a number and its interval, as far as they are finite."""
    if not isfinite(value):
        return "none"
    return f"{value:.{digits}g}" + (f" [{low:.{digits}g}, {high:.{digits}g}]" if isfinite(low) else "")
