"""`landscape compare`: hold two slices of one plane against each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..jobs.scene import SceneSpec
from .arguments import Json, Print, refuse_words, takes_scene

if TYPE_CHECKING:
    from ..landscapes.measures.slice_comparison_record import SliceComparison
    from ..landscapes.objective import Objective
    from ..landscapes.slice import Slice
    from .terminal import Bars, Console

LISTED = 12  # settings that differ, in the terminal


@takes_scene("env", env="")
def compare(
    scene: SceneSpec,
    slice_: Annotated[str, typer.Argument(metavar="SLICE", help="Folder of slice A.")],
    other: Annotated[
        str,
        typer.Argument(
            metavar="SLICE|ENV",
            help="Folder of slice B on the same plane, or an environment to sample on that plane with the "
            "options below.",
        ),
    ],
    out: Annotated[
        str | None, typer.Option(help="Folder for the results. The default is named after both slices, under out/.")
    ] = None,
    print_: Print = None,
    json_: Json = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace a comparison that exists already, and sample B again.")
    ] = False,
) -> None:
    """Compare two slices of the same plane: losses, their order, gradients and the largest differences.

    They may differ in fidelity, engine, options, version or environment, if the environments have the same parameters
    and the same unit of the loss. The folder then holds compare.json and compare.png, and slice B if it was sampled
    here. Stop at any time: the same command goes on from there.

    Example: landscape compare out/my-slice bounce --fidelity standard
    """
    from ..landscapes.storage.paths import refuse_missing
    from .terminal import Bars, Console, command_line, print_json

    if not Path(other).exists():
        refuse_words(replace(scene, name=other))
    refuse_missing(slice_, "slice")
    from ..api.slice import open_slice
    from ..jobs.compare import PICTURE, RECORD, CompareJob

    bars = Bars()
    second = _second(other, scene, bars)  # which may be refused at once
    first = open_slice(slice_)
    how: dict[str, Any] = {"out": Path(out) if out else None, "force": force, "prints": print_ or []}
    job = CompareJob.of(first, second, command=command_line(), **how)
    found = job.run(bars)
    files = [PICTURE, *job.print(found), RECORD]
    show(found, Console(stderr=json_))
    bars.note(f"{job.folder}: {', '.join(files)}")
    if json_:
        print_json(found.record(), folder=str(job.folder), files=files)


def _second(other: str, scene: SceneSpec, bars: Bars) -> Slice | Objective:
    """Return a slice that is there, and else the environment to sample.

    Raises ValueError for options of a scene beside a slice.
    """
    from ..api.slice import open_slice

    if not Path(other).exists():
        return replace(scene, name=other).make(bars)
    if scene != SceneSpec(""):
        raise ValueError(
            f"options of a scene are for an environment to sample; {other} is there already: leave them out"
        )
    return open_slice(other)


def show(found: SliceComparison, console: Console) -> None:
    """Print a row for each number, where losses part, and the settings that differ."""
    from rich.box import SIMPLE

    from .terminal import table

    console.print(f"A: {found.a}\nB: {found.b}", highlight=False)
    rows = table("measure", "value, 95 % interval", box=SIMPLE, padding=(0, 1))
    for name, one in found.table().iterrows():
        rows.add_row(str(name), _say(one))
    console.print(rows)
    for line in lines(found):
        console.print(line, highlight=False)


def _say(row: Any) -> str:
    """Return a number with its interval and its unit, a share in percent."""
    if row.value != row.value:
        return ""
    is_share = row.unit.startswith("of ")
    numbers = [(100 if is_share else 1) * value for value in (row.value, row.low, row.high)]
    value, low, high = (format(number, ".3g" if row.unit else ".4g") for number in numbers)
    ends = f" ({low} to {high})" if low != "nan" else ""
    return f"{value}{ends} {'% ' if is_share else ''}{row.unit}".rstrip()


def lines(found: SliceComparison) -> list[str]:
    """Say where losses part, how points ended differently, and which settings differ."""
    from ..jobs.compare import RECORD

    said, unit = list[str](), f" {found.loss_unit}".rstrip()
    if apart := found.parting:
        place = ", ".join(f"{label} {value:.4g}" for label, value in apart.place.items())
        said.append(f"farthest apart at {place}: A {apart.a:.4g}{unit}, B - A {apart.b - apart.a:.4g}{unit}")
    said += [f"{one.points} points are {one.a} in A and {one.b} in B" for one in found.statuses]
    differing = found.settings()
    said += differing[:LISTED] or ["no setting differs"]
    return said + ([f"and {len(differing) - LISTED} more, in {RECORD}"] if len(differing) > LISTED else [])
