"""A study of remedies, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .terminal import Console, table

if TYPE_CHECKING:
    from ..studies.remedies import RemedyStudy


def show(found: RemedyStudy, console: Console) -> None:
    """Print a row for each remedy, then the conclusion."""
    from rich.box import SIMPLE

    unit = f" [{found.loss_unit}]" if found.loss_unit else ""
    rows = table("remedy", f"loss reached{unit} (95 %)", "better", "p", "falls", "moved", box=SIMPLE)
    for column in rows.columns[:1] + rows.columns[2:]:
        column.no_wrap = True
    for row in found.rows:
        one = row.reached
        better = "" if row is found.plain or row.better.value != row.better.value else f"{row.better.value:.0%}"
        rows.add_row(
            row.remedy, f"{one.value:.3g} ({one.low:.3g} to {one.high:.3g})", better,
            "" if row is found.plain else _p(row.p), f"{row.falls[1].value:.0%}", f"{row.moved:.1%}",
        )  # fmt: skip
    console.print(rows)
    console.print(
        f"{found.starts} descents by L-BFGS-B from the same starts, each at the cost of {found.budget} episodes with "
        f"gradient. One of these costs {found.gradient_cost:.2g} episodes without. All losses are evaluated without a "
        "remedy.\n"
        "better: share of starts where the descent reaches a lower loss than without a remedy. p is corrected for the "
        "number of remedies. falls: share of starts where a step of 1 % of the box along the gradient lowers the loss. "
        "moved: distance that the lowest point moves, as a share of the box."
    )
    console.print(found.sentence)


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.2f}"
