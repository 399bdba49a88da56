"""`landscape tradeoff`: accuracy against speed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..jobs.scene import SceneSpec
from .arguments import ForceStudy, Json, OutOfStudy, Print, Seed, takes_scene

if TYPE_CHECKING:
    from ..landscapes.measures.fidelity import Bootstrap
    from ..landscapes.measures.tradeoff import MeasuredVariant, Tradeoff
    from .terminal import Console


@takes_scene("fidelity", "tolerance", "deterministic")
def tradeoff(
    scene: SceneSpec,
    points: Annotated[int, typer.Option(min=2, help="Sobol points at which every variant is measured.")] = 64,
    seed: Seed = 0,
    variants: Annotated[
        list[str] | None,
        typer.Option(
            help="What to change beside the named fidelities, a,b or repeated: dt, resolution, particles, precision, "
            "stiffness, engine, device; by default all that the scene has."
        ),
    ] = None,
    ladder: Annotated[list[str] | None, typer.Option(hidden=True, help="What --variants was called.")] = None,
    out: OutOfStudy = None,
    print_: Print = None,
    json_: Json = False,
    force: ForceStudy = False,
) -> None:
    """Measure accuracy against speed: the same points in several variants of a scene, each against the reference.

    The folder then holds tradeoff.json and tradeoff.png; the former is also kept for --tolerance. Stop it at any
    moment: the same command goes on with the next variant.

    Example: landscape tradeoff bounce --variants dt,precision
    """
    from ..jobs.tolerance import keep
    from ..jobs.tradeoff import PICTURE, RECORD, TradeoffJob
    from .terminal import Bars, Console, command_line, print_json

    settings = [part for text in [*(variants or []), *(ladder or [])] for part in text.split(",") if part]
    how: dict[str, Any] = {"points": points, "seed": seed, "settings": settings, "force": force}
    how |= {"out": Path(out) if out else None, "prints": print_ or [], "command": command_line()}
    bars, job = Bars(), TradeoffJob.open(scene, **how)
    found = job.run(bars)
    files, kept = [PICTURE, *job.print(found), RECORD], keep(found)
    show(found, Console(stderr=json_))
    bars.note(f"{job.folder}: {', '.join(files)}; kept for --tolerance: {kept}")
    if json_:
        print_json(found.record(), folder=str(job.folder))


def show(found: Tradeoff, console: Console) -> None:
    """Print a trade-off: a row for each variant, quickest first, with those that no other beats marked."""
    from rich.box import SIMPLE

    from .terminal import Console, table

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
    from ..landscapes.capacity import size

    found = variant.comparison
    costs = [f"{1e3 * seconds:.3g}" for seconds in (found.seconds.forward, found.seconds.with_gradient)]
    costs.append("" if variant.memory is None else size(variant.memory))
    if reference:
        return ["reference", *[""] * 5, *costs]
    median = found.loss_error.median_relative.value
    return [
        "" if median is None else f"{_percent(median)}%",
        _share(found.loss_error.p95_relative),
        _number(found.spearman),
        _number(found.gradient.cosine),
        _number(found.gradient.relative_error),
        "" if found.diverged is None else f"{found.diverged:.0%}",
        *costs,
    ]


def _share(found: Bootstrap) -> str:
    if found.value is None:
        return "not finite"
    return f"{_percent(found.value)}% ({_percent(found.low)}-{_percent(found.high)})"


def _percent(value: float | None) -> str:
    return "?" if value is None else f"{100 * value:.2g}"


def _number(found: Bootstrap) -> str:
    return "" if found.value is None else f"{found.value:z.3f}"
