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
    points: Annotated[
        int, typer.Option(min=4, help="Number of corners of the box and Sobol points to simulate at each setting.")
    ] = 16,
    seed: Seed = 0,
    knobs: Annotated[
        list[str] | None,
        typer.Option(
            help="Settings to vary, a,b or repeated: dt, resolution, box, horizon, or an option of the "
            "environment that is a positive number. The default is the first four and the contact "
            "stiffness."
        ),
    ] = None,
    pairs: Annotated[
        list[str] | None,
        typer.Option(
            help="Pairs of settings to map, as dt:ke, or none. It may be repeated; the default is dt with "
            "each other setting."
        ),
    ] = None,
    precisions: Annotated[
        list[str] | None,
        typer.Option(
            help="Precision to test: float32, float64 or both. The default is both if the environment has them."
        ),
    ] = None,
    grid: Annotated[int, typer.Option(min=2, max=64, help="Number of values of each setting on a map.")] = 8,
    width: Annotated[float, typer.Option(help="Relative width at which the bisection of a limit stops.")] = 0.05,
    accuracy: Annotated[
        float,
        typer.Option(
            help="Loss error that counts as accurate, at the 95th percentile and as a fraction of the spread of losses."
        ),
    ] = 0.1,
    against: Annotated[
        str | None,
        typer.Option(help="Fidelity that finite losses are compared with. The default is the last, the reference."),
    ] = None,
    out: OutOfStudy = None,
    print_: Print = None,
    json_: Json = False,
    force: ForceStudy = False,
) -> None:
    """Find how far time step, grid, stiffness, controls and horizon can be turned before a simulation fails.

    Each setting is scanned and its first failure bisected; pairs of settings are mapped. Finite losses are compared
    with the reference, because a simulation can be stable and wrong. The default fidelity is standard. The folder then
    holds extremes.json and extremes.png; `landscape envs NAME` shows what was found about the time step. Stop at any
    time: the same command goes on with the next setting.

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
