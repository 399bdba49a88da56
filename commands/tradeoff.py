"""`landscape tradeoff`: accuracy against speed, by one of several ladders."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from ..jobs.scene import SceneSpec
from .arguments import ForceStudy, Json, OutOfStudy, Print, Seed, takes_scene
from .ladders import convergence, fidelity
from .ladders.study import Study

LADDERS: dict[str, Callable[[Study], None]] = {
    "fidelity": fidelity.run,
    "convergence": convergence.run,
}


@takes_scene("tolerance", "deterministic")
def tradeoff(
    scene: SceneSpec,
    ladder: Annotated[
        str,
        typer.Option(
            help="What is measured: fidelity, how far off cheaper and dearer variants are; convergence, whether the "
            "reference is one."
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
    out: OutOfStudy = None,
    print_: Print = None,
    json_: Json = False,
    force: ForceStudy = False,
) -> None:
    """Measure accuracy against speed: the same points in several variants of a scene, each against the reference.

    With --ladder fidelity the variants are fidelities and what is changed of them; the folder then holds tradeoff.json
    and tradeoff.png, of which the former is also kept for --tolerance. Stop it at any moment: the same command goes on
    with the next variant.

    With --ladder convergence every knob of the reference is refined, to say by which order losses converge, what is
    left to win, and whether neighbours part so fast that nothing converges point by point; 16 points are enough.

    Example: landscape tradeoff bounce --variants dt,precision
    """
    from ..jobs.variants import refuse_ladder
    from .terminal import command_line

    settings = [part for text in variants or [] for part in text.split(",") if part]
    refuse_ladder(ladder, LADDERS, settings)
    folder = Path(out) if out else None
    LADDERS[ladder](Study(scene, points, seed, settings, folder, print_ or [], json_, force, command_line()))
