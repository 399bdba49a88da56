"""A report card, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .terminal import Console, table

if TYPE_CHECKING:
    from ..landscapes.measures.card import Card


def show(found: Card, console: Console) -> None:
    """Print a row for each engine in each scene: verdict, share of points wrong, cause, median error."""
    from ..landscapes.measures.card import describe_share

    shown = table("scene", "engine", "verdict", "points wrong", "cause", "error against closed form")
    for one in found.grades:
        off = describe_share(one.closed_form.median) if one.closed_form is not None else ""
        shown.add_row(one.scene, one.engine, one.verdict, one.wrong, one.cause or one.finding, off)
    console.print(shown)
