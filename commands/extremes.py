"""`landscape extremes`: how far a scene's knobs can be turned, and what happens beyond."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..jobs.scene import SceneSpec
from .arguments import ForceStudy, Json, OutOfStudy, Print, Seed, read_names, takes_scene

if TYPE_CHECKING:
    from ..landscapes.measures.extremes import Extremes, Limit
    from .terminal import Console


@takes_scene("tolerance", "deterministic")
def extremes(
    scene: SceneSpec,
    points: Annotated[int, typer.Option(min=4, help="Corners of the box and Sobol points that decide.")] = 16,
    seed: Seed = 0,
    knobs: Annotated[
        list[str] | None,
        typer.Option(
            help="What to turn, a,b or repeated: dt, resolution, box, horizon, or an option of the scene that is a "
            "number above 0; by default the first four and what says how stiff the scene is."
        ),
    ] = None,
    pairs: Annotated[
        list[str] | None,
        typer.Option(help="Pairs of knobs to map, dt:ke or repeated, or none; by default dt against the others."),
    ] = None,
    precisions: Annotated[
        list[str] | None, typer.Option(help="float32, float64 or both; by default both where the scene has them.")
    ] = None,
    grid: Annotated[int, typer.Option(min=2, max=64, help="Values of each knob on a map.")] = 8,
    width: Annotated[float, typer.Option(help="Relative width to which limits are bisected.")] = 0.05,
    accuracy: Annotated[
        float, typer.Option(help="Loss error in 95 % of the points that is accurate, as a share of the spread.")
    ] = 0.1,
    against: Annotated[
        str | None, typer.Option(help="The fidelity that judges finite losses; by default the last, the reference.")
    ] = None,
    out: OutOfStudy = None,
    print_: Print = None,
    json_: Json = False,
    force: ForceStudy = False,
) -> None:
    """Find how far a scene's knobs can be turned before it fails: step, grid, stiffness, controls, length.

    Each knob is scanned, then its first failure is bisected; pairs of knobs are mapped. Finite losses are held against
    the reference: a fluid that explodes politely is still wrong. The fidelity is standard unless another is given. The
    folder then holds extremes.json and extremes.png; `landscape envs NAME` says what was found of the step. Stop it at
    any moment: the same command goes on with the next setting.

    Example: landscape extremes bounce --knobs dt,ke
    """
    from ..jobs.extremes import PICTURE, RECORD, ExtremesJob
    from ..jobs.margins import keep
    from .terminal import Bars, Console, command_line, print_json

    how: dict[str, Any] = {"points": points, "seed": seed, "grid": grid, "width": width, "accuracy": accuracy}
    how |= {
        "knobs": read_names(knobs),
        "pairs": None if pairs is None else read_names(pairs),
        "precisions": read_names(precisions),
    }
    how |= {"reference": against, "out": Path(out) if out else None, "force": force, "prints": print_ or []}
    bars, job = Bars(), ExtremesJob.open(scene, **how, command=command_line())
    found = job.run(bars)
    files, kept = [PICTURE, *job.print(found), RECORD], keep(found)
    show(found, Console(stderr=json_))
    bars.note(
        f"{job.folder}: {', '.join(files)}" + (f"; kept for `landscape envs {found.env}`: {kept}" if kept else "")
    )
    if json_:
        print_json(found.record(), folder=str(job.folder))


def show(found: Extremes, console: Console) -> None:
    """Print the limits: a row for each end of each knob, a column for each precision."""
    from rich.box import SIMPLE

    from .terminal import Console, table

    console = Console(file=console.file, width=console.width, highlight=False)
    about = f"{found.env}: {found.fidelity} on {found.identity['device']}, {found.points} points"
    console.print(f"{about}, judged by {found.reference} (accurate: {found.accuracy:.0%} of the spread)")
    rows = table("knob", "it has", *found.precisions, box=SIMPLE, padding=(0, 1), collapse_padding=True)
    for first in (limit for limit in found.limits if limit.precision == found.precisions[0]):
        same = [limit for limit in found.limits if (limit.knob, limit.end) == (first.knob, first.end)]
        base = f"{first.base:.4g} {first.unit}".rstrip()
        rows.add_row(f"{first.knob}, {first.end}", base, *map(describe, same))
    console.print(rows)
    for why in dict.fromkeys(refused.why for refused in found.refused):
        names = [refused.name for refused in found.refused if refused.why == why]
        console.print(f"refused: {'; '.join(names)}: {why}")


def describe(limit: Limit) -> str:
    """Say where a limit lies, what happens beyond it, how wrong losses get before, and up to where they are right."""
    from ..landscapes.measures.extremes import last_error

    if limit.stable is None:
        said = [f"none is stable: {limit.rungs[0].outcome}"]
    elif limit.failed is None:
        said = [f"stable up to {limit.stable:.4g} ({limit.stable / limit.base:.3g}x), the last tried"]
    else:
        said = [f"{limit.stable:.4g} ({limit.stable / limit.base:.3g}x), then {limit.beyond}"]
    said += [f"stable again {low:.4g} to {high:.4g}" for low, high in limit.islands]
    if limit.dearer:
        said.append(f"{limit.dearer} values too dear")
    if (error := last_error(limit.rungs)) is not None:
        said.append(f"{_accuracy(limit)}, at last {100 * error:.2g} % off")
    return "; ".join(said)


def _accuracy(limit: Limit) -> str:
    if limit.accurate is None:
        return "not accurate"
    return f"accurate to {limit.accurate:.4g}" + (f", not at {limit.wrong:.4g}" if limit.wrong is not None else "")
