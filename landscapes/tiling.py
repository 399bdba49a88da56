"""The order a slice is filled in: coarse to fine, tile by tile."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise


@dataclass(frozen=True)
class Tile:
    """Number one tile of a slice, in array order: (row along v, column along u), or (column,) on a line."""

    index: tuple[int, ...]

    @property
    def level(self) -> int:
        """Which square of tiles this one helps to complete: 0 is the first, coarsest picture."""
        return max(self.index)


def tile_side(points: int) -> int:
    """Return how many of an axis' points make a tile: an eighth of them, at least 4 and at most 16."""
    return min(points, max(4, min(16, points // 8)))


def coarse_to_fine(points: int, side: int) -> list[int]:
    """Order an axis so that each `side` points in turn spread evenly over the whole of it.

    The axis is cut into `side` cells, equal to within one point. The first group takes the middle of each cell, the
    next ones the place in the cell that is farthest (cyclically) from those taken.
    """
    edges = [cell * points // side for cell in range(side + 1)]
    cells = [[low + offset for offset in _offsets(high - low)] for low, high in pairwise(edges)]
    return [cell[turn] for turn in range(len(max(cells, key=len))) for cell in cells if turn < len(cell)]


def _offsets(size: int) -> list[int]:
    taken = [size // 2]
    away = [min((at - taken[0]) % size, (taken[0] - at) % size) for at in range(size)]
    while len(taken) < size:
        taken.append(away.index(max(away)))
        away = [min(far, (at - taken[-1]) % size, (taken[-1] - at) % size) for at, far in enumerate(away)]
    return taken
