"""A report card, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .terminal import Console, table

if TYPE_CHECKING:
    from ..landscapes.measures.card import Card


def show(found: Card, console: Console) -> None:
    """Print a row for each engine in each scene: its outcome and its first finding."""
    shown = table("scene", "engine", "", "finding")
    for one in found.grades:
        count = "" if one.outcome == "not installed" else f" {sum(one.counts.values()) - one.counts.get('skip', 0)}"
        shown.add_row(one.scene, one.engine, one.outcome + count, one.finding)
    console.print(shown)
