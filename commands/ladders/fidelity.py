"""The ladder `fidelity`: accuracy against speed of a scene's variants, printed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .study import Study, number, percent, say_missing, share

if TYPE_CHECKING:
    from ...landscapes.measures.tradeoff import MeasuredVariant, Tradeoff
    from ..terminal import Console


def run(study: Study) -> None:
    """Measure the variants of a scene against its reference, which is its last fidelity, and print them.

    Raises ValueError where the scene is to be at a fidelity.
    """
    from ...jobs.tolerance import find_convergence, keep
    from ...jobs.tradeoff import PICTURE, RECORD, TradeoffJob
    from ..terminal import Bars, Console, print_json

    if study.scene.fidelity is not None:
        raise ValueError(
            f"--ladder fidelity measures every fidelity against the last; got --fidelity {study.scene.fidelity}, "
            "leave it out"
        )
    how: dict[str, Any] = {"points": study.points, "seed": study.seed, "settings": study.variants}
    how |= {"out": study.out, "prints": study.prints, "force": study.force, "command": study.command}
    bars, job = Bars(), TradeoffJob.open(study.scene, **how)
    found = job.run(bars)
    files, kept = [PICTURE, *job.print(found), RECORD], keep(found)
    console = Console(stderr=study.json)
    show(found, console)
    if converged := find_convergence(found):
        for said in (converged.rule.say(), *converged.say_remainders()):
            console.print(said)
    bars.note(f"{job.folder}: {', '.join(files)}; kept for --tolerance: {kept}")
    if study.json:
        print_json(found.record(), folder=str(job.folder))


def show(found: Tradeoff, console: Console) -> None:
    """Print a trade-off: a row for each variant, quickest first, with those that no other beats marked."""
    from rich.box import SIMPLE

    from ..terminal import Console, table

    console = Console(file=console.file, width=console.width, highlight=False)
    console.print(_subject(found))
    accuracy = ("variant", "median", "95 % of points", "rank", "cosine", "slope", "failed")
    look: dict[str, Any] = {"box": SIMPLE, "padding": (0, 1), "collapse_padding": True}
    rows, best = table(*accuracy, "ms", "with grad", "memory", **look), set(found.front)
    for variant in sorted(found.variants, key=lambda one: one.seconds):
        mark = " *" if variant.name in best else ""
        rows.add_row(variant.name + mark, *_cells(variant, reference=variant.name == found.reference))
    console.print(rows)
    console.print(
        "median, 95 %: loss error as a share of the spread (95 % interval); rank: Spearman's correlation of losses; "
        "cosine, slope: of gradients, median cosine and relative error; ms an episode; * none is quicker and nearer"
    )
    if said := say_missing((one.name, one.comparison) for one in found.variants):
        console.print(said)
    for fit in found.orders:
        console.print(f"error ~ dt^{fit.order:z.2f} ± {fit.standard_error:.2f}: {', '.join(fit.variants)}")
    for why in dict.fromkeys(refused.why for refused in found.refused):
        names = [refused.name for refused in found.refused if refused.why == why]
        console.print(f"refused: {', '.join(names)}: {why}")


def _subject(found: Tradeoff) -> str:
    said = f"{found.points} points against {found.reference}"
    scale = f"spread of the loss (5th to 95th percentile) {found.spread or 0:.4g} {found.loss_unit}".rstrip()
    failed = f"; {found.reference_failed} points left out, the reference fails there"
    about = f"{found.env}: {said}; {scale if found.spread else 'no spread'}"
    return about + (failed if found.reference_failed else "")


def _cells(variant: MeasuredVariant, *, reference: bool) -> list[str]:
    from ...landscapes.capacity import size

    found = variant.comparison
    costs = [f"{1e3 * seconds:.3g}" for seconds in (found.seconds.forward, found.seconds.with_gradient)]
    costs.append("" if variant.memory is None else size(variant.memory))
    if reference:
        return ["reference", *[""] * 5, *costs]
    median = found.loss_error.median_relative.value
    return [
        "" if median is None else f"{percent(median)}%",
        share(found.loss_error.p95_relative),
        number(found.spearman),
        number(found.gradient.cosine),
        number(found.gradient.relative_error),
        "" if found.diverged is None else f"{found.diverged:.0%}",
        *costs,
    ]
