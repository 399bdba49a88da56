"""The ladder `model`: what each part of a scene's model is for, printed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from .study import Study, number, percent, say_missing, share

if TYPE_CHECKING:
    from ...landscapes.measures.fidelity import Bootstrap
    from ...landscapes.measures.model import MeasuredPart, ModelStudy
    from ..terminal import Console


def run(study: Study) -> None:
    """Measure what changing each part of a scene's model does against the full one, and print it."""
    from ...jobs.model import PICTURE, RECORD, ModelJob
    from ..terminal import Bars, Console, print_json

    how: dict[str, Any] = {"points": study.points, "seed": study.seed, "out": study.out, "prints": study.prints}
    bars, job = Bars(), ModelJob.open(study.scene, **how, force=study.force, command=study.command)
    found = job.run(bars)
    files = [PICTURE, *job.print(found), RECORD]
    show(found, Console(stderr=study.json))
    bars.note(f"{job.folder}: {', '.join(files)}")
    if study.json:
        print_json(found.record(), folder=str(job.folder))


def show(found: ModelStudy, console: Console) -> None:
    """Print a study: the parts that the model has, then those that are missing, and the verdict on each."""
    from ..terminal import Console

    console = Console(file=console.file, width=console.width, highlight=False)
    console.print(_subject(found))
    console.print(f"noise, the full model again: {_noise(found)}")
    if found.present:
        _print_parts(console, found.present, "parts of the model, and what changing each does")
    if found.missing:
        _print_parts(console, found.missing, "parts that are missing, and what putting each in does")
    for part in (*found.present, *found.missing):
        console.print(f"{part.name}, {part.change}: {part.verdict}")
    if said := say_missing((one.name, one.comparison) for one in (*found.present, *found.missing)):
        console.print(said)
    console.print(
        "median, 95 %: how far losses move, as a share of the spread, at half and at 95 % of points (95 % interval); "
        "moved: points whose loss moves beyond the noise; rank: Spearman's correlation of losses; cosine, slope: of "
        "gradients, median cosine and relative error; time: of an episode with gradient, against the full model's, in "
        "turn with it (95 % interval)"
    )
    for refused in found.refused:
        console.print(f"refused: {refused.name}: {refused.why}")


def _print_parts(console: Console, parts: Sequence[MeasuredPart], title: str) -> None:
    from rich.box import SIMPLE

    from ..terminal import table

    look: dict[str, Any] = {"box": SIMPLE, "padding": (0, 1), "collapse_padding": True, "title": title}
    failed = any(part.comparison.diverged for part in parts)
    headings = ("part", "median", "95 %", "moved", "rank", "cosine", "slope", *(["failed"] if failed else []), "time")
    rows = table(*headings, **look)
    for part in parts:
        rows.add_row(part.name, *_cells(part, failed=failed))
    console.print(rows)


def _subject(found: ModelStudy) -> str:
    scale = f"spread of the loss (5th to 95th percentile) {found.spread or 0:.4g} {found.loss_unit}".rstrip()
    failed = f"; {found.failed} points left out, the full model fails there" if found.failed else ""
    about = f"{found.env}: {found.points} points against the full model at {found.fidelity}"
    if found.parts:  # with which it was timed
        about += f", {1e3 * found.seconds.with_gradient:.3g} ms an episode with gradient"
    return f"{about}; {scale if found.spread else 'no spread'}{failed}"


def _noise(found: ModelStudy) -> str:
    own = found.noise.comparison
    error = own.loss_error.p95_relative.value
    moves = "more than a number says at" if own.loss_error.p95.value is None else f"{percent(error or 0.0)}% at most at"
    rank, cosine = number(own.spearman) or "none", number(own.gradient.cosine) or "none"
    return f"losses move by {moves} 95 % of points, rank {rank}, cosine {cosine}"


def _cells(part: MeasuredPart, *, failed: bool) -> list[str]:
    found = part.comparison
    median = found.loss_error.median_relative.value
    return [
        "" if median is None else f"{percent(median)}%",
        share(found.loss_error.p95_relative),
        "" if part.moved is None else f"{part.moved:.0%}",
        number(found.spearman),
        number(found.gradient.cosine),
        number(found.gradient.relative_error),
        *(["" if found.diverged is None else f"{found.diverged:.0%}"] if failed else []),
        _change(part.cost),
    ]


def _change(cost: Bootstrap) -> str:
    """Return a ratio of times as what it adds or takes away, with its interval."""
    if cost.value is None or cost.low is None or cost.high is None:
        return ""
    value, low, high = (100 * (ratio - 1) for ratio in (cost.value, cost.low, cost.high))
    return f"{value:+z.0f}% ({low:+z.0f}:{high:+z.0f})"
