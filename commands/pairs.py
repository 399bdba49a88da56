"""A ranking of pairs of parameters, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from ..api.options import at_least
from .terminal import SIMPLE, Console, table

if TYPE_CHECKING:
    from ..jobs.pairs import PairRanking

COLUMNS = ("score", "sensitivity", "interaction", "ruggedness", "disagreement")
LEADERS = {"interaction": "strongest interaction", "ruggedness": "most rugged", "disagreement": "most misleading"}


def show(ranking: PairRanking, console: Console, *, top: Annotated[int, at_least(1)] = 10) -> None:
    """Print the highest pairs, the leading pair in each measure, and the command that slices the first.

    Parameters
    ----------
    top
        Number of pairs to show.
    """
    found = table("no.", "pair", *COLUMNS, box=SIMPLE)
    found.columns[0].no_wrap = True
    for pair in ranking.pairs[:top]:
        values = [getattr(pair, name) for name in COLUMNS]
        cells = ["" if value is None else f"{value:.3f}" for value in values]
        found.add_row(" ".join(map(str, pair.dims)), ranking.name(pair), *cells)
    failed = f", {ranking.failed} failed" if ranking.failed else ""
    said = f"{ranking.env} · {ranking.fidelity}: {ranking.episodes} episodes{failed}; {len(ranking.pairs)} pairs"
    console.print(said)
    console.print(found)
    console.print(
        "sensitivity: share of the loss's variance that a slice shows on average; interaction: share that needs both "
        "parameters together; ruggedness: ups and downs along a tenth of the box, in standard deviations; "
        "disagreement: of gradients with slopes over a twentieth of the box, 0 none, 1 zero or opposite; "
        "score: sensitivity x (1 + the others).",
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
