"""A comparison of two slices, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .terminal import SIMPLE, Console, table

if TYPE_CHECKING:
    from ..landscapes.measures.slice_comparison import SliceComparison

LISTED = 12  # settings that differ, in the terminal


def show(found: SliceComparison, console: Console) -> None:
    """Print a row for each number, the largest difference, and the settings that differ."""
    console.print(f"A: {found.a}\nB: {found.b}")
    rows = table("measure", "value, 95 % interval", box=SIMPLE, padding=(0, 1))
    for name, one in found.table().iterrows():
        rows.add_row(str(name), _format(one))
    console.print(rows)
    for line in lines(found):
        console.print(line)


def _format(row: Any) -> str:
    """Return a number with its interval and its unit, a share in percent."""
    if row.value != row.value:
        return ""
    is_share = row.unit.startswith("of ")
    numbers = [(100 if is_share else 1) * value for value in (row.value, row.low, row.high)]
    value, low, high = (format(number, ".3g" if row.unit else ".4g") for number in numbers)
    ends = f" ({low} to {high})" if low != "nan" else ""
    return f"{value}{ends} {'% ' if is_share else ''}{row.unit}".rstrip()


def lines(found: SliceComparison) -> list[str]:
    """Describe the largest difference, points with different statuses, and the settings that differ."""
    from ..jobs.compare import RECORD

    said, unit = list[str](), f" {found.loss_unit}".rstrip()
    if apart := found.parting:
        place = ", ".join(f"{label} {value:.4g}" for label, value in apart.place.items())
        said.append(f"largest difference at {place}: A {apart.a:.4g}{unit}, B - A {apart.b - apart.a:.4g}{unit}")
    said += [f"{one.points} points are {one.a} in A and {one.b} in B" for one in found.statuses]
    differing = found.settings()
    said += differing[:LISTED] or ["no setting differs"]
    return said + ([f"and {len(differing) - LISTED} more, in {RECORD}"] if len(differing) > LISTED else [])
