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
            help="Study to run. fidelity: errors of cheaper and dearer variants. model: effect of each "
            "part of the model. convergence: is the reference converged? mixed: a search over all "
            "settings together for better draft and standard fidelities."
        ),
    ] = "fidelity",
    points: Annotated[int, typer.Option(min=2, help="Number of Sobol points at which every variant is measured.")] = 64,
    seed: Seed = 0,
    variants: Annotated[
        list[str] | None,
        typer.Option(
            help="Settings to change, a,b or repeated. fidelity takes dt, resolution, particles, "
            "precision, stiffness, engine and device; convergence takes dt, resolution, particles, "
            "joint and precision. The default is all that the environment has."
        ),
    ] = None,
    at_most: Annotated[
        float | None,
        typer.Option(
            help="With --ladder mixed: largest cost of a variant, as a multiple of the present one. The default is 4."
        ),
    ] = None,
    budget: Annotated[
        float | None,
        typer.Option(help="With --ladder mixed: time to spend on measurements [s]. The default is 600."),
    ] = None,
    chaotic: Annotated[
        bool,
        typer.Option("--chaotic", help="With --ladder mixed: ignore gradients, because the motion is chaotic."),
    ] = False,
    out: OutOfStudy = None,
    print_: Print = None,
    json_: Json = False,
    force: ForceStudy = False,
) -> None:
    """Measure accuracy against speed for several variants of an environment.

    All variants are evaluated at the same points and compared with a reference. Each study leaves a record and a
    picture of its name in the folder:

    fidelity (tradeoff.json, tradeoff.png): the variants are the fidelities and changes of their settings. The record
    is also kept for --tolerance.

    model: each variant changes, removes or adds one part of the model. The reference is the full model at --fidelity.

    convergence: each setting of the reference is refined. The study reports the order of convergence, the remaining
    error, and whether neighbouring points diverge too fast to converge. 16 points are enough.

    mixed: the variants are those that a search of the front needs. It says what draft and standard should be.

    Stop at any time: the same command goes on with the next variant.

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
