"""`landscape pairs`: which pairs of parameters to look at."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..jobs.scene import SceneSpec
from .arguments import ForceStudy, Json, OutOfStudy, Seed, takes_scene

if TYPE_CHECKING:
    from ..jobs.pairs import PairRanking
    from .terminal import Console

COLUMNS = ("score", "sensitivity", "interaction", "ruggedness", "disagreement")
LEADERS = {"interaction": "strongest interaction", "ruggedness": "most rugged", "disagreement": "most misleading"}


@takes_scene("tolerance", "deterministic")
def pairs(
    scene: SceneSpec,
    samples: Annotated[
        int | None,
        typer.Option(
            min=2,
            help="Number of base points, of 1 + 5 x dim + 28 episodes each (fewer below 8 parameters). The"
            " default is 16, and down to 4 with many parameters.",
        ),
    ] = None,
    seed: Seed = 0,
    top: Annotated[int, typer.Option(min=1, help="Number of pairs to show.")] = 10,
    out: OutOfStudy = None,
    json_: Json = False,
    force: ForceStudy = False,
) -> None:
    """Rank pairs of parameters by sensitivity, ruggedness and misleading gradients, to choose which to slice.

    The folder then holds pairs.json (all pairs) and the evaluated episodes. Stop at any time: the same command goes on
    from there.

    Example: landscape pairs fluid
    """
    from ..jobs.pairs import PairsJob
    from .terminal import Bars, Console, command_line, print_json

    folder = Path(out) if out else None
    job = PairsJob.open(scene, samples=samples, seed=seed, out=folder, force=force, command=command_line())
    ranking = job.run(Bars())
    if json_:
        record = ranking.record()
        print_json(record | {"pairs": record["pairs"][:top]}, folder=str(job.folder))
    show(ranking, Console(stderr=json_), top)


def show(ranking: PairRanking, console: Console, top: int) -> None:
    """Print the highest pairs, who leads in each measure, and the command that slices the first."""
    from rich.box import SIMPLE

    from .terminal import table

    found = table("no.", "pair", *COLUMNS, box=SIMPLE)
    found.columns[0].no_wrap = True
    for pair in ranking.pairs[:top]:
        values = [getattr(pair, name) for name in COLUMNS]
        cells = ["" if value is None else f"{value:.3f}" for value in values]
        found.add_row(" ".join(map(str, pair.dims)), ranking.name(pair), *cells)
    failed = f", {ranking.failed} failed" if ranking.failed else ""
    said = f"{ranking.env} · {ranking.fidelity}: {ranking.episodes} episodes{failed}; {len(ranking.pairs)} pairs"
    console.print(said, highlight=False)
    console.print(found)
    console.print(
        "sensitivity: share of the loss's variance that a slice shows on average; interaction: what both do only "
        "together; ruggedness: ups and downs along a tenth of the box, in standard deviations; disagreement of "
        "gradients with slopes over a twentieth of it: 0 none, 1 zero or opposite; "
        "score: sensitivity x (1 + the others).",
        highlight=False,
    )
    for line in _leaders(ranking):
        console.print(line)
    console.print(_command(ranking))


def _leaders(ranking: PairRanking) -> list[str]:
    """Say which pair is the first in each measure."""
    lines = []
    for measure, title in LEADERS.items():
        best = max(ranking.pairs, key=lambda pair: -1.0 if (value := getattr(pair, measure)) is None else value)
        if getattr(best, measure) is not None:
            lines.append(f"{title}: {ranking.name(best)} ({' '.join(map(str, best.dims))})")
    return lines


def _command(ranking: PairRanking) -> str:
    """Return the command that slices the first pair."""
    dims = " ".join(map(str, ranking.pairs[0].dims))
    options = "".join(f" --set {name}={value}" for name, value in ranking.options.items())
    return f"landscape slice {ranking.env} --dims {dims} --fidelity {ranking.fidelity}{options}"
