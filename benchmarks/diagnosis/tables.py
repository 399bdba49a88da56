"""How results of the examination are counted and printed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Share:
    """How many of some cases came out right."""

    right: int
    of: int

    @classmethod
    def among(cls, answers: Iterable[bool | None]) -> Share:
        """Count the answers that are there."""
        known = [one for one in answers if one is not None]
        return cls(sum(known), len(known))

    def reaches(self, goal: float) -> bool:
        """Whether the share is as large as a goal; of nothing it is."""
        return self.right >= goal * self.of

    def __str__(self) -> str:
        return f"{self.right}/{self.of}" if self.of else "-"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as Markdown, padded for a terminal."""
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    lines = [[cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in [head, *rows]]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
