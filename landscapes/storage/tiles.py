"""The order a slice is filled in: coarse to fine, tile by tile."""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush
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
    orders = {width: _offsets(width) for width in {high - low for low, high in pairwise(edges)}}
    cells = [[low + offset for offset in orders[high - low]] for low, high in pairwise(edges)]
    return [cell[turn] for turn in range(len(max(cells, key=len))) for cell in cells if turn < len(cell)]


def _offsets(size: int) -> list[int]:
    """Order the places of a cell: its middle, then always the first of those farthest from all before, cyclically.

    Between two that are taken the farthest is halfway, so that gaps wait in a heap, the widest first.
    """
    taken = [size // 2]
    gaps = [_halfway(taken[0], size, size)]
    while len(taken) < size:
        _, at, start, width = heappop(gaps)
        taken.append(at)
        before = (at - start) % size
        for low, between in ((start, before), (at, width - before)):
            if between > 1:
                heappush(gaps, _halfway(low, between, size))
    return taken


def _halfway(start: int, width: int, size: int) -> tuple[int, int, int, int]:
    """Return a gap between taken places of a cycle as the heap sorts it: how far its middle is, and where that is."""
    middles = ((start + width // 2) % size, (start + width - width // 2) % size)  # of an odd gap there are two
    return -(width // 2), min(middles), start, width
