"""The ladder `mixed`: what draft and standard should be, by a search with all settings changed together, printed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .study import Study, number, share

if TYPE_CHECKING:
    from ...landscapes.measures.choice import Choice
    from ...landscapes.measures.fidelity import Bootstrap
    from ...landscapes.measures.mixed import MixedTradeoff
    from ..terminal import Console


def run(study: Study) -> None:
    """Search the front of a scene's mixed variants, and print what its draft and its standard should be.

    Raises ValueError where the scene is to be at a fidelity.
    """
    from ...jobs.mixed import PICTURE, RECORD, MixedJob
    from ...jobs.tolerance import keep
    from ..terminal import Bars, Console, print_json

    if study.scene.fidelity is not None:
        raise ValueError(
            f"--ladder mixed says what every fidelity should be; got --fidelity {study.scene.fidelity}, leave it out"
        )
    how: dict[str, Any] = {"points": study.points, "seed": study.seed, "out": study.out, "prints": study.prints}
    how |= {"force": study.force, "command": study.command, **study.limits}
    bars, job = Bars(), MixedJob.open(study.scene, **how)
    found = job.run(bars)
    files, kept = [PICTURE, *job.print(found), RECORD], keep(found.tradeoff)
    show(found, Console(stderr=study.json))
    bars.note(f"{job.folder}: {', '.join(files)}; kept for --tolerance: {kept}")
    if study.json:
        print_json(found.record(), folder=str(job.folder))


def show(found: MixedTradeoff, console: Console) -> None:
    """Print two rows for each name: what it means today, and what it should; then why, and lines of Python."""
    from rich.box import SIMPLE

    from ..terminal import Console, table

    console = Console(file=console.file, width=console.width, highlight=False)
    trade = found.tradeoff
    console.print(
        f"{trade.env}: {len(trade.variants)} variants at {trade.points} points against {trade.reference}, "
        f"{len(found.dismissed)} given up before, {len(trade.refused)} refused"
    )
    look: dict[str, Any] = {"box": SIMPLE, "padding": (0, 1), "collapse_padding": True}
    rows = table("", "variant", "rank", "cosine", "95 % of points", "of allowed", "ms", **look)
    for one in found.choices:
        rows.add_row(f"{one.claim.name} today", *_cells(found, one.claim.name, one.today_shortfall, one.today_seconds))
        rows.add_row("chosen", *_cells(found, one.variant, one.shortfall, one.seconds))
    console.print(rows)
    for line in _remarks(found):
        console.print(line, soft_wrap=True, markup=False)


def _remarks(found: MixedTradeoff) -> list[str]:
    """Say how the variants were chosen, what was not found, and the lines of Python."""
    said = [_said(found, one) for one in found.choices]
    for one in found.with_options:
        options = found.variant(str(one.variant)).options if one.variant else {}
        own = found.tradeoff.identity["options"]
        others = ", ".join(f"{name}={value!r}" for name, value in options.items() if value != own[name])
        said.append(f"with {others} {one.claim.name} would be {one.variant}, {1e3 * (one.seconds or 0):.3g} ms")
    if found.chaotic:
        said.append("the motion is chaotic: gradients are no criterion")
    end = "no neighbour of the front is left" if found.complete else f"the budget of {found.budget:g} s is spent"
    return [*said, f"the search ended after {found.spent:.3g} s: {end}", *found.lines]


def _said(found: MixedTradeoff, one: Choice) -> str:
    claim, device = one.claim, found.device[one.claim.name]
    wanted = f"rank {claim.rank:g}, " + ("" if found.chaotic else f"cosine {claim.cosine:g}, ")
    what = f"{claim.name} ({wanted}95 % error {claim.error:.0%}; ms on {device})"
    within = f"{found.at_most:g} times today's cost"
    if one.variant is None:
        return f"{what}: no variant within {within} answers at every point"
    if one.kept:
        return f"{what}: the cheapest that keeps it; {one.candidates} variants are within {within}"
    return f"{what}: none of {one.candidates} within {within} keeps it, so the nearest; it lacks most in {one.lacking}"


def _cells(found: MixedTradeoff, name: str | None, shortfall: float | None, seconds: float | None) -> list[str]:
    if name is None or seconds is None:
        return ["none", *[""] * 5]
    measured = found.variant(name).comparison
    return [
        name,
        _interval(measured.spearman),
        _interval(measured.gradient.cosine),
        share(measured.loss_error.p95_relative),
        "not finite" if shortfall is None else f"{shortfall:.2g}",
        f"{1e3 * seconds:.3g}",
    ]


def _interval(found: Bootstrap) -> str:
    if found.value is None or found.low is None or found.high is None:
        return number(found)
    return f"{number(found)} ({found.low:z.3f}-{found.high:z.3f})"
