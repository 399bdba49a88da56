"""`landscape tradeoff`: accuracy against speed, by one of several ladders."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from ..jobs.scene import SceneSpec
from .arguments import ForceStudy, Json, OutOfStudy, Print, Seed, read_names, takes_scene
from .ladders import convergence, fidelity, mixed, model
from .ladders.study import Study

LADDERS: dict[str, Callable[[Study], None]] = {
    "fidelity": fidelity.run,
    "model": model.run,
    "convergence": convergence.run,
    "mixed": mixed.run,
}


@takes_scene("tolerance", "deterministic")
def tradeoff(
    scene: SceneSpec,
    ladder: Annotated[
        str,
        typer.Option(
            help="What is measured: fidelity, how far off cheaper and dearer variants are; model, what each part of "
            "the scene's model is for; convergence, whether the reference is one; mixed, which draft and standard "
            "should be, by a search with all settings changed together."
        ),
    ] = "fidelity",
    points: Annotated[int, typer.Option(min=2, help="Sobol points at which everything is measured.")] = 64,
    seed: Seed = 0,
    variants: Annotated[
        list[str] | None,
        typer.Option(
            help="With --ladder fidelity: what to change beside the named fidelities, a,b or repeated: dt, resolution, "
            "particles, precision, stiffness, engine, device; with convergence what to refine: dt, resolution, "
            "particles, joint, precision; by default all that the scene has."
        ),
    ] = None,
    at_most: Annotated[
        float | None,
        typer.Option(help="With --ladder mixed: how many times today's cost a variant may cost; by default 4."),
    ] = None,
    budget: Annotated[
        float | None,
        typer.Option(help="With --ladder mixed: seconds that the search may measure; by default 600."),
    ] = None,
    chaotic: Annotated[
        bool,
        typer.Option("--chaotic", help="With --ladder mixed: the motion is chaotic, so gradients are no criterion."),
    ] = False,
    out: OutOfStudy = None,
    print_: Print = None,
    json_: Json = False,
    force: ForceStudy = False,
) -> None:
    """Measure accuracy against speed: the same points in several variants of a scene, each against the reference.

    Each ladder leaves a record and a picture of its name in the folder:

    fidelity (tradeoff.json, tradeoff.png): the variants are fidelities and what is changed of them; the record is also
    kept for --tolerance.

    model: each variant changes one part of the scene's model, leaves it out or puts it in; the reference is the full
    model at --fidelity.

    convergence: every knob of the reference is refined, to say by which order losses converge, what is left to win, and
    whether neighbours part so fast that nothing converges point by point; 16 points are enough.

    mixed: the variants are those that a search of the front needs; it says what draft and standard should be.

    Stop it at any moment: the same command goes on with the next variant.

    Example: landscape tradeoff bounce --variants dt,precision
    """
    from ..jobs.variants import refuse_ladder
    from .terminal import command_line

    settings = read_names(variants)
    refuse_ladder(ladder, LADDERS, settings)
    given = {"at_most": at_most, "budget": budget, "chaotic": chaotic or None}
    limits = {name: value for name, value in given.items() if value is not None}
    if limits and ladder != "mixed":
        raise ValueError(f"--at-most, --budget and --chaotic go with --ladder mixed; got --ladder {ladder}")
    folder = Path(out) if out else None
    LADDERS[ladder](Study(scene, points, seed, settings, folder, print_ or [], json_, force, command_line(), limits))
