"""The geometry of a slice as a surface: its cells, its frame, and the azimuth that shows its valley."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ...identity import plane_of
from ...lattice import own_cells
from ...plane import Plane
from ...space import LOG10
from .. import style
from ..figures import contour
from ..style import decades, write_power

Grid = NDArray[np.float64]

SIDE, HEIGHT = 2.0, 0.9  # of the surface: the slice's window, and the scale of the losses
FOCUS = 0.26  # how high the eye looks
AWAY, UP = 4.83, 2.74  # of the eye from the middle of the surface, over the ground and up
AZIMUTHS = (236.0, 304.0, 124.0, 56.0, 214.0, 326.0, 146.0, 34.0)  # of the eye [degrees]; no edge is seen end on
TOP = ((0, 0), (1, 0), (1, 1), (0, 1))  # corners of a cell to the right and back, counterclockwise from above
# from the way a wall looks to its two edges, counterclockwise from there
WALLS = {(1, 0): ((1, 0), (1, 1)), (-1, 0): ((0, 1), (0, 0)), (0, 1): ((1, 1), (0, 1)), (0, -1): ((0, 0), (1, 0))}
TRIANGLES = ((0, 1, 2), (0, 2, 3))  # of a cell's corners
FOOT = 0.08  # share of the upright axis that has no ticks
VALLEY_SHARE = 0.1  # share of the samples that are the valley
SIGHT_STEPS = 160  # of a line of sight across the surface


@dataclass(frozen=True, eq=False)
class Relief:
    """The mapping from plane coordinates and losses to positions: a centred window with sides of length SIDE.

    The eye looks from `azimuth` [degrees].
    """

    plane: Plane
    scale: style.Scale
    azimuth: float = AZIMUTHS[0]

    @classmethod
    def of(cls, dataset: xr.Dataset, scale: style.Scale) -> Relief:
        """Return the relief of a slice, seen from the side that shows most of its valley."""
        flat = cls(plane_of(dataset), scale)
        return replace(flat, azimuth=azimuth(flat, dataset))

    def at(self, u: Grid, v: Grid, loss: Grid) -> Grid:
        """Return positions, shape (..., 3)."""
        low, high = (side.numpy() for side in self.plane.cell_bounds())
        flat = SIDE * ((np.stack([u, v], axis=-1) - low) / (high - low) - 0.5)
        return np.concatenate([flat, self.height(loss)[..., None]], axis=-1)

    def height(self, loss: Grid) -> Grid:
        """Return the height of a loss, clipped at both ends of the scale; NaN without a loss."""
        return HEIGHT * self.shade(loss)

    def shade(self, loss: Grid) -> Grid:
        """Return the position of a loss on the scale, 0 to 1; NaN without a loss."""
        least = self.scale.ends[0] if self.scale.logarithmic else -np.inf
        with np.errstate(invalid="ignore"):
            return np.clip(np.asarray(self.scale.norm(np.maximum(loss, least)), dtype=np.float64), 0.0, 1.0)

    def ticks(self, axis: int) -> tuple[Grid, Grid]:
        """Return round coordinates along u, v or the loss, and their positions on the axis, 0 to 1.

        The axis of the loss has no tick at its foot, where another axis begins.
        """
        if axis < 2:
            low, high = (float(side[axis]) for side in self.plane.cell_bounds())
            ticks = np.asarray((decades if self._has_decades(axis) else style.round_values)(low, high))
            return ticks, (ticks - low) / (high - low)
        ticks = np.asarray(self.scale.ticks())
        share = self.shade(ticks)
        return ticks[share > FOOT], share[share > FOOT]

    def write(self, axis: int, tick: float) -> str:
        """Write a tick along u, v or the loss."""
        if self._has_decades(axis):
            return write_power(tick)
        return style.power(tick) if axis == 2 and self.scale.logarithmic else style.number(tick)

    def _has_decades(self, axis: int) -> bool:
        return axis < 2 and self.plane.scales[axis] == LOG10

    def place(self, turn: float, away: float, up: float) -> tuple[float, float, float]:
        """Return a position at a distance from the middle and an angle from the eye [degrees]."""
        angle = np.radians(self.azimuth + turn)
        return (float(away * np.cos(angle)), float(away * np.sin(angle)), FOCUS + up)

    @property
    def front(self) -> tuple[float, float]:
        """The side of the surface with the front edges, -1 or 1 along u and v."""
        x, y, _ = self.place(0.0, 1.0, 0.0)
        return float(np.sign(x)), float(np.sign(y))

    def beside(self, axis: int, share: float, away: float) -> tuple[float, float, float]:
        """Return a position next to an axis: u and v along the front edges, the loss up the right edge."""
        (right, back), half, along = self.front, SIDE / 2, SIDE * (share - 0.5)
        if axis == 0:
            return (along, back * (half + away), 0.0)
        if axis == 1:
            return (right * (half + away), along, 0.0)
        x, y, _ = self.place(90.0, 1.0, 0.0)  # to the right of who looks
        corner = (-right * half, back * half) if x * right < y * back else (right * half, -back * half)
        return (corner[0] + x * away, corner[1] + y * away, HEIGHT * share)

    def frame(self) -> list[Grid]:
        """Return the edges of the ground and of the two walls behind, as lines of shape (point, 3)."""
        a, top, (right, back) = SIDE / 2, HEIGHT, self.front
        x, y = -right * a, -back * a  # where the walls are
        floor = [(-a, -a, 0), (a, -a, 0), (a, a, 0), (-a, a, 0), (-a, -a, 0)]
        walls = [(-x, y, 0), (-x, y, top), (x, y, top), (x, y, 0)], [(x, y, top), (x, -y, top), (x, -y, 0)]
        return [np.array(line, dtype=np.float64) for line in (floor, *walls)]


@dataclass(frozen=True)
class Cells:
    """The cells of a slice as quadrilaterals: corners and outward normals, shape (face, 4, 3) and (face, 3).

    `sample` is the index in the flattened slice of the sample that gives each face its colour.
    """

    corners: Grid
    normals: Grid
    sample: NDArray[np.intp]

    @property
    def triangles(self) -> NDArray[np.intp]:
        """Return two triangles for each cell, as indices of the consecutive corners."""
        first = 4 * np.arange(len(self.corners))[:, None]
        return np.concatenate([first + np.array(corners) for corners in TRIANGLES])


def cells(relief: Relief, dataset: xr.Dataset) -> Cells:
    """Return a flat top for every sample over its cell of the map, and upright walls down to its neighbours.

    Nothing is interpolated: a wall has the colour of the higher of its two samples. A failed sample has no top. The
    walls around it, and those at the border of the slice, go down to the ground.
    """
    height = relief.height(own_cells(dataset)["loss"].transpose("v", "u").to_numpy())
    rows, columns = np.nonzero(np.isfinite(height))
    high = height[rows, columns]
    u, v = (SIDE * ((at - at[0]) / (at[-1] - at[0]) - 0.5) for at in contour.cell_edges(dataset))
    ground = np.pad(np.nan_to_num(height, nan=0.0), 1)  # also where there is nothing

    def at(corner: tuple[int, int], z: Grid) -> Grid:
        return np.stack([u[columns + corner[0]], v[rows + corner[1]], z], axis=-1)

    corners = [np.stack([at(corner, high) for corner in TOP], axis=1)]
    normals = [np.tile([0.0, 0.0, 1.0], (len(rows), 1))]
    sample = [rows * height.shape[1] + columns]
    for (right, back), (first, second) in WALLS.items():
        low = ground[rows + 1 + back, columns + 1 + right]
        wall = np.stack([at(first, low), at(second, low), at(second, high), at(first, high)], axis=1)
        corners.append(wall[low < high])
        normals.append(np.tile([float(right), float(back), 0.0], (int((low < high).sum()), 1)))
        sample.append(sample[0][low < high])
    return Cells(np.concatenate(corners), np.concatenate(normals), np.concatenate(sample))


def azimuth(relief: Relief, dataset: xr.Dataset) -> float:
    """Return the azimuth [degrees] from which most of the valley is visible."""
    height = relief.height(own_cells(dataset)["loss"].transpose("v", "u").to_numpy())
    if not np.isfinite(height).any():
        return AZIMUTHS[0]
    rows, columns = np.nonzero(height <= np.nanquantile(height, VALLEY_SHARE))
    seen = [_visible_share(np.nan_to_num(height, nan=0.0), rows, columns, np.radians(angle)) for angle in AZIMUTHS]
    return AZIMUTHS[int(np.argmax(np.round(seen, 6)))]  # the first of equals


def _visible_share(height: Grid, rows: NDArray[np.intp], columns: NDArray[np.intp], angle: float) -> float:
    """Return the share of cells that the eye sees: nothing on the way is higher than the line of sight."""
    way = np.linspace(0.0, 1.5 * SIDE, SIGHT_STEPS)[1:, None]
    size = np.array(height.shape)
    at = np.stack([rows, columns]) + 0.5
    steps = np.array([np.sin(angle), np.cos(angle)]) / SIDE * size
    row, column = (np.floor(at[axis] + way * steps[axis]).astype(int) for axis in (0, 1))
    inside = (row >= 0) & (row < size[0]) & (column >= 0) & (column < size[1])
    passed = np.where(inside, height[np.clip(row, 0, size[0] - 1), np.clip(column, 0, size[1] - 1)], 0.0)
    return float((passed <= height[rows, columns] + way * UP / AWAY + 1e-9).all(axis=0).mean())
