"""The content of the gallery, on the terminal."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from .terminal import Console, table

if TYPE_CHECKING:
    from ..gallery.compute import Computed
    from ..gallery.parts import FigureList
    from ..jobs.slices import SliceTable

MAX_ROWS = 100  # of slices, on a terminal


def show_computed(found: Computed, console: Console) -> int:
    """Print nothing more; the exit code is 1 where a figure failed."""
    return 1 if found.failed else 0


def show_figures(found: FigureList, console: Console) -> None:
    """Print a row for each figure, and how many are missing or out of date."""
    listed = table("figure", "paper", "environment", "dims", "through", "data", title=f"figures in {found.folder}")
    for figure, state in found.figures:
        dims, number = " ".join(map(str, figure.dims)), str(figure.caption.number or "ours")
        listed.add_row(figure.id, number, figure.env, dims, figure.through, str(state))
    console.print(listed)
    missing = sum(not state.finished for _, state in found.figures)
    console.print(
        f"{len(found.figures) - missing} sampled, {missing} missing; `landscape gallery compute` samples the missing "
        "ones",
        soft_wrap=True,
    )
    if older := sum(bool(state.changed) for _, state in found.figures):
        console.print(
            f"{older} out of date: the settings of their fidelity have changed since; "
            f"to sample one again, delete its folder in {found.folder}",
            soft_wrap=True,
        )


def show_slices(found: SliceTable, console: Console) -> None:
    """Print a row for each slice, and how many folders of slices have no summary."""
    listed = table("slice", "of", "along", "samples", "losses", "failed")
    for _, row in found.rows.head(MAX_ROWS).iterrows():
        losses = "none" if row.isna()["lowest"] else f"{row['lowest']:.4g} to {row['highest']:.4g}"
        about = (str(row[name] or "") for name in ("env", "dims", "resolution"))
        listed.add_row(os.path.relpath(row["folder"], found.folder), *about, losses, str(row["failed"]))
    console.print(listed)
    more = f", the first {MAX_ROWS} are shown; --json prints all" if len(found.rows) > MAX_ROWS else ""
    count = len(found.rows)
    console.print(f"{count} slice{'s' * (count != 1)} in {found.folder}{more}", soft_wrap=True)
    for count, what in ((found.damaged, "with a damaged summary"), (found.bare, "unfinished, without a summary")):
        if count:
            console.print(f"{count} more {what}: run the commands that made them again to continue", soft_wrap=True)
