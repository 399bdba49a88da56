"""Advice on how to begin a search, on the terminal."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from .terminal import Console, Table, table

if TYPE_CHECKING:
    from ..jobs.advise import Advice
    from ..landscapes.measures.character import Character


def show(found: Advice, console: Console) -> None:
    """Print the measures, the expected rank of each method, the nearest cases and the advice."""
    console.soft_wrap = True
    console.print(_measures(found.character))
    console.print(_expected(found))
    console.print(_cases(found))
    for method, why in found.unable.items():
        console.print(f"{method} cannot run here: {why}")
    if found.best is not None:
        unit = f" {found.loss_unit}" if found.loss_unit else ""
        console.print(f"best of the {found.evaluations} points: loss {found.best.loss:.6g}{unit}")
    if math.isfinite(found.gradient_cost):
        console.print(f"an episode with gradient costs about {found.gradient_cost:.1f} times one without")
    console.print(f"fidelity: {found.fidelity_advice}")
    console.print(f"remedy: {found.remedy_advice}")
    console.print(f"method: {found.sentence}")


def _measures(character: Character) -> Table:
    shown = table("measure", "value", "meaning", title=f"{character.evaluations} points over all parameters")
    for row in character.rows():
        shown.add_row(*row)
    return shown


def _expected(found: Advice) -> Table:
    shown = table("method", "expected mean rank", title="prediction from the nearest cases")
    for method, rank in found.choice.expected.items():
        shown.add_row(method, f"{rank:.1f}")
    return shown


def _cases(found: Advice) -> Table:
    method = found.choice.method
    shown = table("nearest case", "family", "distance", "best methods", f"rank of {method}", title="evidence")
    for one in found.choice.nearest:
        shown.add_row(one.name, one.family, f"{one.distance:.2f}", ", ".join(one.best), f"{one.rank:.1f}")
    return shown
