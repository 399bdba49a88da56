"""Let `--dims` take one word or two, which no option of the command line's library does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from typer.core import TyperCommand
from typer.exceptions import TyperException

DIMS = "--dims"


class TakesDims(TyperCommand):
    """A verb whose `--dims A B` and `--dims A` are both understood, wherever its argument stands."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the second word as a dimension, and as the verb's argument where that would be missing else."""
        two, one = repeat_option(args, 2), repeat_option(args, 1)
        try:
            return super().parse_args(ctx, two)
        except TyperException:
            if one == two:
                raise
            try:
                return super().parse_args(ctx, one)
            except TyperException:
                pass
            raise


def repeat_option(args: Sequence[str], most: int) -> list[str]:
    """Return a command's words with an option of its own for each of the first words after `--dims`."""
    found, left = list[str](), list(args)
    while left:
        found.append(left.pop(0))
        if found[-1] == DIMS:
            words = list[str]()
            while left and len(words) < most and not left[0].startswith("-"):
                words.append(left.pop(0))
            found += [word for dim in words for word in (DIMS, dim)][1:]
    return found
