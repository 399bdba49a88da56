"""What the gallery holds, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .terminal import Console, table

if TYPE_CHECKING:
    from ..gallery.compute import Computed
    from ..gallery.parts import FigureList


def show_computed(found: Computed, console: Console) -> int:
    """Print nothing more; the exit code is 1 where a figure failed."""
    return 1 if found.failed else 0


def show_figures(found: FigureList, console: Console) -> None:
    """Print a row for each figure, and how many are missing or older."""
    listed = table("figure", "paper", "environment", "dims", "through", "data", title=f"figures in {found.folder}")
    for figure, state in found.figures:
        dims, number = " ".join(map(str, figure.dims)), str(figure.caption.number or "ours")
        listed.add_row(figure.id, number, figure.env, dims, figure.through, str(state))
    console.print(listed)
    missing = sum(not state.finished for _, state in found.figures)
    console.print(
        f"{len(found.figures) - missing} there, {missing} missing; `landscape gallery compute` samples what is missing",
        soft_wrap=True,
    )
    if older := sum(bool(state.changed) for _, state in found.figures):
        console.print(
            f"{older} are older: they were sampled with other settings than their fidelity has now; "
            f"to sample one again, delete its folder in {found.folder}",
            soft_wrap=True,
        )
