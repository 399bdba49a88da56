"""A report card, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..landscapes.measures.card import describe_error
from .terminal import Console, table

if TYPE_CHECKING:
    from ..landscapes.measures.card import Card


def show(found: Card, console: Console) -> None:
    """Print a row for each engine in each scene: verdict, share of points wrong, cause, finding, closed form."""
    shown = table("scene", "engine", "verdict", "points wrong", "finding", "against the closed form")
    for one in found.grades:
        said = f"{one.cause}: {one.finding}" if one.cause else one.finding
        error = describe_error(one.closed_form) if one.closed_form is not None else ""
        shown.add_row(one.scene, one.engine, one.verdict, one.wrong, said, error)
    console.print(shown)
