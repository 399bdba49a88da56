"""The ladder `convergence`: whether a scene's reference is one, printed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .study import Study, number, percent, share

if TYPE_CHECKING:
    from ...landscapes.measures.convergence_record import Convergence, KnobConvergence, Move
    from ...landscapes.measures.distributions import Distributions
    from ...landscapes.measures.divergence import Divergence
    from ...landscapes.measures.fidelity import Bootstrap
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
    for knob in found.knobs:
        console.print(say_order(knob))
    console.print(found.rule.say())
    show_remainders(found, console)
    if found.divergence:
        console.print(say_divergence(found.divergence))
    if found.distributions:
        _show_distributions(found.distributions, console)
    for one in found.refused:
        console.print(f"refused: {one.name}: {one.why}")


def show_remainders(found: Convergence, console: Console) -> None:
    """Print how far named fidelities are from Richardson's limit, or which knob has none."""
    if not found.remainders:
        console.print(f"no limit to extrapolate to: {', '.join(_unlimited(found))}")
    for one in found.remainders:
        said = f"{one.name}: {share(one.median)} (median), {share(one.p95)} (95 % of points) from Richardson's limit"
        console.print(said)


def say_order(knob: KnobConvergence) -> str:
    """Say by which order a knob converges, or that it does not."""
    designed = f", designed {knob.designed:g}" if knob.designed is not None else ""
    floor = f"; it does not fall below {percent(knob.floor)}%" if knob.floor else ""
    if knob.order.value is None:
        return f"{knob.knob}: {knob.verdict}{designed}{floor}"
    rule = {True: "within", False: "beyond", None: "not comparable with"}[knob.met]
    ends = f"{number(knob.order)} ({_end(knob.order.low)} to {_end(knob.order.high)})"
    shapes = (
        f"{knob.shapes.monotone} points monotone, {knob.shapes.oscillating} oscillating, {knob.shapes.growing} growing"
    )
    return f"{knob.knob}: {knob.verdict}, order {ends}{designed}; {shapes}{floor}; {rule} a tenth of standard's error"


def say_divergence(found: Divergence) -> str:
    """Say how neighbours part."""
    ends = _interval(found.rate)
    saturated = "no perturbation up to 1e-3 moves losses by a tenth of their spread"
    if found.saturates_at is not None:
        saturated = f"a perturbation of {found.saturates_at:g} of the box moves losses by a tenth of their spread"
    return f"neighbours part at {ends} 1/s; {found.chaotic} of {found.points} points are chaotic; {saturated}"


def _show_distributions(found: Distributions, console: Console) -> None:
    from rich.box import SIMPLE

    from ..terminal import table

    rows = table("losses over neighbourhoods", "Kolmogorov", "Wasserstein / spread", "told apart by", box=SIMPLE)
    noise = found.noise
    rows.add_row("noise: the reference twice", _interval(noise.kolmogorov), _interval(noise.wasserstein), "")
    for one in found.compared:
        cells = (_interval(side) for side in (one.distance.kolmogorov, one.distance.wasserstein))
        rows.add_row(one.name, *cells, ", ".join(one.told) or "neither")
    console.print(rows)


def _cells(move: Move, reference: str) -> list[str]:
    names = [name.removeprefix(f"{reference}-") for name in (move.coarse, move.fine)]
    median = "" if move.median.value is None else f"{percent(move.median.value)}%"
    slopes = (number(move.cosine), number(move.relative_error))
    return [*names, median, share(move.p95), *slopes, str(move.compared)]


def _unlimited(found: Convergence) -> list[str]:
    return [f"{one.knob} {one.verdict}" for one in found.knobs if one.verdict not in ("converges", "unmoved")]


def _interval(found: Bootstrap) -> str:
    return f"{_end(found.value)} ({_end(found.low)} to {_end(found.high)})"


def _end(value: float | None) -> str:
    return "?" if value is None else f"{value:z.3g}"
