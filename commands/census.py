"""`landscape census`: what many slices of a scene are like, for what one slice cannot say."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..jobs.scene import SceneSpec
from .arguments import ForceStudy, Json, OutOfStudy, Print, Scheduler, Seed, takes_scene

if TYPE_CHECKING:
    from ..landscapes.measures.census_record import Census
    from .terminal import Console


@takes_scene("deterministic")
def census(
    scene: SceneSpec,
    slices: Annotated[int, typer.Option(min=1, help="Number of slices.")] = 64,
    resolution: Annotated[int, typer.Option(min=6, help="Number of points along each axis of a slice.")] = 24,
    gradients: Annotated[
        int,
        typer.Option(
            min=1,
            help="Compute gradients only at every N-th sample per axis. 2 halves the time if a gradient "
            "costs as much as three losses.",
        ),
    ] = 1,
    along: Annotated[
        str,
        typer.Option(
            help="How slices are oriented: pairs of parameters, or random directions, both over the whole box."
        ),
    ] = "pairs",
    also: Annotated[
        str | None,
        typer.Option(help="Repeat one slice per base point at this fidelity, to see its effect."),
    ] = None,
    seed: Seed = 0,
    out: OutOfStudy = None,
    print_: Print = None,
    scheduler: Scheduler = None,
    json_: Json = False,
    force: ForceStudy = False,
) -> None:
    """Measure many random slices of an environment, and report what they have in common.

    A census measures each slice as `landscape report` does. It says to which fraction of the slices each word applies,
    how each measure is distributed, and how much of its variance comes from the point, the orientation, the resolution
    and the fidelity. The folder then holds census.json, census.npz (the losses) and census.png. Stop at any time: the
    same command goes on with the next slice.

    Example: landscape census bounce --slices 16
    """
    from dataclasses import replace

    from ..jobs.census import LOSSES, PICTURE, RECORD, CensusJob
    from ..jobs.workers import workers
    from .terminal import Bars, Console, command_line, print_json

    bars = Bars()
    how: dict[str, Any] = {"slices": slices, "resolution": resolution, "gradients": gradients, "along": along}
    how |= {"also": also, "seed": seed, "out": Path(out) if out else None, "force": force, "prints": print_ or []}
    job = CensusJob.open(scene.resolve(bars), **how, command=command_line())
    with workers(scheduler, job.env.device) as executor:
        found = replace(job, executor=executor).run(bars)
    show(found, Console(stderr=json_))
    bars.note(f"{job.folder}: {PICTURE}, {RECORD}, {LOSSES}")
    if json_:
        print_json(found.record(), folder=str(job.folder))


def show(found: Census, console: Console) -> None:
    """Print the words by how often they fit, and a row for each measure."""
    from rich.box import SIMPLE

    from .terminal import table

    many = f"{len(found.slices)} slices, {found.episodes} episodes"
    console.print(f"{found.env} · {found.fidelity}: {many}", highlight=False)
    words = table("word", "slices that it fits", box=SIMPLE)
    for word, share in sorted(found.words.items(), key=lambda one: -one[1].value):
        if share.value > 0:
            words.add_row(word, f"{share.value:.0%} ({share.low:.0%} to {share.high:.0%})")
    console.print(words)
    other = [found.other] if found.other else []
    rows = table("measure", "5 %", "median", "95 %", "point", "cut", "both", "halved", *other, box=SIMPLE, padding=0)
    rows.columns[0].no_wrap = True
    for name, spread in found.spreads.items():
        parts, (least, _, middle, _, most) = found.parts[name], spread.quantiles
        shares = [parts.base, parts.cut, parts.both, parts.resolution, *([parts.fidelity] if other else [])]
        rows.add_row(name, *map(_number, (least, middle, most)), *map(_share, shares))
    console.print(rows)
    at = f", {found.other}: at that fidelity" if found.other else ""
    console.print(
        "point, cut, both: shares of a measure's variance over the slices that go with the base point, with the cut, "
        f"with what they do together. halved: the variance that half the resolution adds{at}, as a share of the same.",
        highlight=False,
    )


def _number(value: float) -> str:
    return "" if value != value else f"{value:.3g}"


def _share(value: float) -> str:
    return "" if value != value else f"{value:.0%}"
