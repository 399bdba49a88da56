"""A census, on the terminal."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from .terminal import SIMPLE, Console, number, table

if TYPE_CHECKING:
    from ..landscapes.measures.census import Census
    from ..landscapes.statistics import Estimate


def show(found: Census, console: Console) -> None:
    """Print the words by how often they fit, and a row for each measure."""
    many = f"{len(found.slices)} slices, {found.episodes} episodes"
    console.print(f"{found.env} · {found.fidelity}: {many}")
    if found.floor:
        console.print(found.floor.sentence())
    words = table("word", "share of slices", box=SIMPLE)
    for word, share in sorted(found.words.items(), key=lambda one: -one[1].value):
        if share.value > 0:
            words.add_row(word, _format(share))
    console.print(words)
    if flat := len(found.slices) - found.solid:
        console.print(f"Flat slices ({flat}) are excluded from the shares of all other words.")
    other = [found.other] if found.other else []
    rows = table("measure", "5 %", "median", "95 %", "point", "cut", "both", "halved", *other, box=SIMPLE, padding=0)
    rows.columns[0].no_wrap = True
    for name, spread in found.spreads.items():
        parts, (least, _, middle, _, most) = found.parts[name], spread.quantiles
        shares = [parts.base, parts.cut, parts.both, parts.resolution, *([parts.fidelity] if other else [])]
        rows.add_row(name, *map(number, (least, middle, most)), *(number(share, ".0%") for share in shares))
    console.print(rows)
    at = f"; {found.other}: the same for that fidelity" if found.other else ""
    console.print(
        "point, cut, both: shares of a measure's variance over the slices that come from the base point, from the cut, "
        f"and from their interaction. halved: variance that half the resolution adds, as a share of that variance{at}.",
    )


def _format(share: Estimate) -> str:
    ends = f" ({share.low:.0%} to {share.high:.0%})" if math.isfinite(share.low) else " of all possible slices"
    return f"{share.value:.0%}{ends}"
