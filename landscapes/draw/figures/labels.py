"""Labels of points, each placed where it covers nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from .. import style
from .typesetting import text_width

Grid = NDArray[np.float64]

SIDES = (  # right, up: where a name may stand, in the order tried; from the second gap on all of them
    *((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, -1), (-1, 1)),
    *((0.5, 1), (1, 0.5), (1, -0.5), (0.5, -1), (-0.5, -1), (-1, -0.5), (-1, 0.5), (-0.5, 1)),
)
NEAR_SIDES = 8  # of the sides
NOTHING: Grid = np.zeros((0, 2))
ROOM = 1.15  # of a line, in the size of its type


@dataclass(frozen=True)
class Name:
    """A text, and the place in a panel that it names [data]."""

    text: str
    at: tuple[float, float]


def place(
    ax: Axes,
    names: Sequence[Name],
    clear: Grid,
    *,
    rather: Grid = NOTHING,
    size: float,
    gaps: Sequence[float],
    gid: str = "name",
) -> list[int]:
    """Write names beside their places, the first of them first, and return the numbers of those with no room.

    A name stands in the panel, `gaps` [pt] away from its place, the first that will do, and covers neither another name
    nor any of the points to keep `clear` of, shape (point, 2) [data], nor, if that can be, those to keep clear of
    `rather`. It is nearer to its place than to another's; from the second gap on a line leads there instead. The panel
    must have its final place on the page.
    """
    dot = ax.figure.dpi / 72
    origins = ax.transData.transform(np.array([name.at for name in names]).reshape(-1, 2))
    points = [ax.transData.transform(some.reshape(-1, 2)) for some in (np.concatenate([clear, rather]), clear)]
    crowd = _Crowd.of(ax, origins, margin=dot)
    left = []
    for number, name in enumerate(names):
        half = np.array([text_width(name.text, size) * 72, ROOM * size]) * dot / 2
        for avoided, (far, gap), side in product(points, enumerate(gaps), SIDES):
            shift = np.array(side) * (half + gap * dot)
            if not far and side not in SIDES[:NEAR_SIDES]:
                continue
            if crowd.takes(number, origins[number] + shift, half, avoided, led=far > 0):
                _write(ax, name, shift / dot, size, led=far > 0, gid=gid)
                break
        else:
            left.append(number)
    return left


def _write(ax: Axes, name: Name, shift: Grid, size: float, *, led: bool, gid: str) -> None:
    text = ax.annotate(
        name.text, name.at, (float(shift[0]), float(shift[1])), textcoords="offset points", ha="center", va="center",
        size=size, arrowprops=style.LEADER if led else None, parse_math=False, gid=gid, **style.NAME_TEXT,
    )  # fmt: skip
    text.set_in_layout(False)  # it has found its room


@dataclass(eq=False)
class _Crowd:
    """What is taken of a panel [pixel]: its frame, places that are named, boxes of names, lines to them."""

    frame: Grid  # two corners
    origins: Grid
    boxes: Grid  # middle and half the sides of each, shape (box, 4)
    lines: Grid  # points along them

    @classmethod
    def of(cls, ax: Axes, origins: Grid, *, margin: float) -> _Crowd:
        box = ax.get_window_extent()
        frame = np.array([[box.x0 + margin, box.y0 + margin], [box.x1 - margin, box.y1 - margin]])
        return cls(frame, origins, np.zeros((0, 4)), NOTHING)

    def takes(self, number: int, middle: Grid, half: Grid, points: Grid, *, led: bool) -> bool:
        """Take a box for a place, and the line that leads there, if neither points nor anything else is in its way."""
        if (middle - half < self.frame[0]).any() or (middle + half > self.frame[1]).any():
            return False
        apart = np.abs(self.boxes[:, :2] - middle) - self.boxes[:, 2:] - half
        covered = np.abs(np.concatenate([points, self.origins, self.lines]) - middle) < half
        if (apart < 0).all(axis=1).any() or covered.all(axis=1).any():
            return False
        away = np.linalg.norm(np.maximum(np.abs(self.origins - middle) - half, 0), axis=1)
        others = np.delete(np.arange(len(away)), number)
        if not led and (away[others] <= away[number]).any():
            return False
        path = self._path(self.origins[number], middle, half) if led else self.lines[:0]
        crossed = np.abs(path[:, None] - self.boxes[None, :, :2]) < self.boxes[None, :, 2:]
        near = np.linalg.norm(self.origins[others] - self.origins[number], axis=1) < 2 * half[1]
        passed = self.origins[others[~near]]  # those that its own place all but covers it cannot pass
        reach = np.linalg.norm(path[:, None] - passed, axis=-1)
        if crossed.all(axis=-1).any() or (reach < half[1]).any():
            return False
        self.boxes = np.concatenate([self.boxes, np.concatenate([middle, half])[None]])
        self.lines = np.concatenate([self.lines, path])
        return True

    @staticmethod
    def _path(origin: Grid, middle: Grid, half: Grid) -> Grid:
        """Return points from a place to a box, without those in it."""
        path = origin + np.linspace(0.05, 1.0, 48)[:, None] * (middle - origin)
        found: Grid = path[(np.abs(path - middle) >= half).any(axis=1)]
        return found
