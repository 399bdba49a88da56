"""The ladder `convergence`: whether a scene's reference is one, printed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .study import Study, number, percent, share

if TYPE_CHECKING:
    from ...landscapes.measures.convergence_record import Convergence, Move
    from ...landscapes.measures.distributions import Distributions
    from ..terminal import Console


def run(study: Study) -> None:
    """Refine what there is to refine of a scene's reference, follow its neighbours, and print what that shows.

    Raises ValueError where the scene is to be at a fidelity.
    """
    from ...jobs.convergence import PICTURE, RECORD, ConvergenceJob
    from ...jobs.tolerance import keep_convergence
    from ..terminal import Bars, Console, print_json

    if study.scene.fidelity is not None:
        raise ValueError(
            f"--ladder convergence refines the last fidelity; got --fidelity {study.scene.fidelity}, leave it out"
        )
    how: dict[str, Any] = {"points": study.points, "seed": study.seed, "settings": study.variants}
    how |= {"out": study.out, "prints": study.prints, "force": study.force, "command": study.command}
    bars, job = Bars(), ConvergenceJob.open(study.scene, **how)
    found = job.run(bars)
    files, kept = [PICTURE, *job.print(found), RECORD], keep_convergence(found)
    show(found, Console(stderr=study.json))
    bars.note(f"{job.folder}: {', '.join(files)}; kept for `landscape tradeoff {found.env}`: {kept}")
    if study.json:
        print_json(found.record(), folder=str(job.folder))


def show(found: Convergence, console: Console) -> None:
    """Print a study of convergence: a row for each refinement, then the orders, the rule, and how neighbours part."""
    from rich.box import SIMPLE

    from ..terminal import Console, table

    console = Console(file=console.file, width=console.width, highlight=False)
    scale = f"spread {found.spread:.4g} {found.loss_unit}".rstrip() if found.spread else "no spread"
    console.print(f"{found.env}: {found.points} points about {found.reference}; {scale}")
    look: dict[str, Any] = {"box": SIMPLE, "padding": (0, 1), "collapse_padding": True}
    rows = table("knob", "from", "to", "median", "95 % of points", "cosine", "slope", "points", **look)
    for knob in found.knobs:
        for place, move in enumerate(knob.moves):
            rows.add_row(knob.knob if place == 0 else "", *_cells(move, found.reference))
    console.print(rows)
    console.print(
        "median, 95 %: how far losses move, as a share of the spread (95 % interval); cosine, slope: of gradients, "
        "median cosine and relative error"
    )
    for said in found.sentences():
        console.print(said)
    if found.distributions:
        _show_distributions(found.distributions, console)
    for one in found.refused:
        console.print(f"refused: {one.name}: {one.why}")


def _show_distributions(found: Distributions, console: Console) -> None:
    from rich.box import SIMPLE

    from ...landscapes.measures.divergence import interval
    from ..terminal import table

    rows = table("losses over neighbourhoods", "Kolmogorov", "Wasserstein / spread", "told apart by", box=SIMPLE)
    noise = found.noise
    rows.add_row("noise: the reference twice", interval(noise.kolmogorov), interval(noise.wasserstein), "")
    for one in found.compared:
        cells = (interval(side) for side in (one.distance.kolmogorov, one.distance.wasserstein))
        rows.add_row(one.name, *cells, ", ".join(one.told) or "neither")
    console.print(rows)


def _cells(move: Move, reference: str) -> list[str]:
    names = [name.removeprefix(f"{reference}-") for name in (move.coarse, move.fine)]
    median = "" if move.median.value is None else f"{percent(move.median.value)}%"
    slopes = (number(move.cosine), number(move.relative_error))
    return [*names, median, share(move.p95), *slopes, str(move.compared)]
