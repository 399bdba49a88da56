"""`landscape card`: the report card of gradients, engines side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .arguments import Device, ForceStudy, Json, OutOfStudy, Print

if TYPE_CHECKING:
    from ..landscapes.measures.card import Card
    from .terminal import Console


def card(
    scenes: Annotated[
        list[str] | None,
        typer.Option(
            "--scene", help="A scene of the card, such as flight. It may be repeated; the default is all scenes."
        ),
    ] = None,
    resolution: Annotated[int, typer.Option(min=3, help="Number of points along each axis of the small slices.")] = 17,
    device: Device = "auto",
    out: OutOfStudy = None,
    print_: Print = None,
    json_: Json = False,
    force: ForceStudy = False,
) -> None:
    """Check the gradients of several engines in the same scenes, and show their landscapes side by side.

    Every installed engine, ours included, goes through `landscape check` and is sampled on one small plane. The folder
    then holds card.json (findings, versions and commands) and card.png. All of it is measured, so another release of
    an engine is measured again. Stop at any time: the same command goes on with the next engine. The exit code is
    always 0.

    Example: landscape card --scene "flight"
    """
    from ..jobs.card import PICTURE, RECORD, CardJob
    from .terminal import Bars, Console, command_line, print_json

    bars = Bars()
    job = CardJob.open(
        scenes or (),
        resolution=resolution,
        device=device,
        out=Path(out) if out else None,
        force=force,
        prints=print_ or [],
        command=command_line(),
    )
    found = job.run(bars)
    _show(found, Console(stderr=json_))
    bars.note(f"{job.folder}: {', '.join([PICTURE, *job.print(found), RECORD])}")
    if json_:
        print_json(found.record(), folder=str(job.folder))


def _show(found: Card, console: Console) -> None:
    from .terminal import table

    shown = table("scene", "engine", "", "finding")
    for one in found.grades:
        count = "" if one.outcome == "not installed" else f" {sum(one.counts.values()) - one.counts.get('skip', 0)}"
        shown.add_row(one.scene, one.engine, one.outcome + count, one.finding)
    console.print(shown)
