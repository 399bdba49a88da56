"""A slice as a body in space: where its samples are, its flat cells, and the side from which its valley is seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..plane import Plane
from . import contour, style

Grid = NDArray[np.float64]

SIDE, HEIGHT = 2.0, 0.9  # of the surface: the slice's window, and the scale of the losses
FOCUS = 0.26  # how high the eye looks
AWAY, UP = 4.83, 2.74  # of the eye from the middle of the surface, over the ground and up
AZIMUTHS = (236.0, 304.0, 124.0, 56.0, 214.0, 326.0, 146.0, 34.0)  # of the eye [degrees]; no edge is seen end on
TRIANGLES = ((0, 1, 2), (0, 2, 3))  # of a cell's corners
FOOT = 0.08  # share of the upright axis that has no ticks
LOWEST = 0.1  # share of the samples that are the valley
STEPS = 160  # of a line of sight across the surface


@dataclass(frozen=True, eq=False)
class Relief:
    """Say where plane coordinates and losses are: the slice's window is centred, each of its sides SIDE long."""

    plane: Plane
    scale: style.Scale

    def at(self, u: Grid, v: Grid, loss: Grid) -> Grid:
        """Return positions, shape (..., 3)."""
        low, high = (side.numpy() for side in self.plane.window())
        flat = SIDE * ((np.stack([u, v], axis=-1) - low) / (high - low) - 0.5)
        return np.concatenate([flat, self.height(loss)[..., None]], axis=-1)

    def height(self, loss: Grid) -> Grid:
        """Return the height of a loss, cut at both ends of the scale; NaN for none."""
        return HEIGHT * self.shade(loss)

    def shade(self, loss: Grid) -> Grid:
        """Return where a loss is on the scale, 0 to 1; NaN for none."""
        least = self.scale.ends[0] if self.scale.logarithmic else -np.inf
        return np.clip(np.asarray(self.scale.norm(np.maximum(loss, least)), dtype=np.float64), 0.0, 1.0)


@dataclass(frozen=True)
class Cells:
    """Hold the cells of a slice as quadrilaterals: corners and outward normals, shape (face, 4, 3) and (face, 3).

    `sample` is whose colour each has, a number of the flattened slice.
    """

    corners: Grid
    normals: Grid
    sample: NDArray[np.intp]


def cells(relief: Relief, dataset: xr.Dataset) -> Cells:
    """Return a flat top for every sample, over its cell of the map, and upright walls down to what is beside it.

    Nothing is drawn between samples that was not sampled: a wall has the colour of the sample it belongs to, the higher
    one. A sample that failed has no top, and like the border of the slice is walled down to the ground.
    """
    loss = dataset["loss"].transpose("v", "u").to_numpy()
    height = relief.height(loss)
    edges = contour.cell_edges(dataset)
    u, v = (SIDE * ((at - at[0]) / (at[-1] - at[0]) - 0.5) for at in edges)
    whole = np.isfinite(height)
    rows, columns = np.nonzero(whole)
    tops = np.stack(
        [
            np.stack([u[columns + right], v[rows + back], height[rows, columns]], axis=-1)
            for right, back in ((0, 0), (1, 0), (1, 1), (0, 1))
        ],
        axis=1,
    )
    parts = [(tops, np.tile([0.0, 0.0, 1.0], (len(rows), 1)), rows * loss.shape[1] + columns)]
    padded = np.pad(np.nan_to_num(height, nan=0.0), 1)  # the ground, where there is nothing
    for right, back in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        beside = padded[rows + 1 + back, columns + 1 + right]
        lower = beside < height[rows, columns]
        at = rows[lower], columns[lower]
        parts.append(
            (_walls(u, v, at, height[at], beside[lower], right, back), *_owners(at, right, back, loss.shape[1]))
        )
    return Cells(*(np.concatenate([part[number] for part in parts]) for number in range(3)))


def _walls(
    u: Grid, v: Grid, at: tuple[NDArray[np.intp], NDArray[np.intp]], top: Grid, foot: Grid, right: int, back: int
) -> Grid:
    """Return the walls at one side of cells, counterclockwise from outside."""
    rows, columns = at
    if right:
        x = np.stack([u[columns + (right > 0)]] * 2)
        y = np.stack([v[rows], v[rows + 1]])[::right]
    else:
        y = np.stack([v[rows + (back > 0)]] * 2)
        x = np.stack([u[columns + 1], u[columns]])[::back]
    ends = [(0, foot), (1, foot), (1, top), (0, top)]
    return np.stack([np.stack([x[end], y[end], z], axis=-1) for end, z in ends], axis=1)


def _owners(
    at: tuple[NDArray[np.intp], NDArray[np.intp]], right: int, back: int, columns: int
) -> tuple[Grid, NDArray[np.intp]]:
    return np.tile([float(right), float(back), 0.0], (len(at[0]), 1)), at[0] * columns + at[1]


@dataclass(frozen=True)
class Stand:
    """Say from where the surface is seen: the azimuth of the eye [degrees]."""

    azimuth: float

    def place(self, turn: float, away: float, up: float) -> tuple[float, float, float]:
        """Return a place so far from the middle, at an angle from the eye [degrees]."""
        angle = np.radians(self.azimuth + turn)
        return (float(away * np.cos(angle)), float(away * np.sin(angle)), FOCUS + up)

    @property
    def front(self) -> tuple[float, float]:
        """On which side of the surface the edges in front are, -1 or 1 along u and v."""
        x, y, _ = self.place(0.0, 1.0, 0.0)
        return float(np.sign(x)), float(np.sign(y))

    def beside(self, axis: int, share: float, away: float) -> tuple[float, float, float]:
        """Return a place beside an axis: u and v along the edges in front, the loss up the edge at the right."""
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


def stand(relief: Relief, dataset: xr.Dataset) -> Stand:
    """Return where most of the valley is seen from."""
    return Stand(azimuth(relief, dataset))


def azimuth(relief: Relief, dataset: xr.Dataset) -> float:
    """Return from which of the azimuths [degrees] most of the valley is seen, over what stands in front of it."""
    height = relief.height(dataset["loss"].transpose("v", "u").to_numpy())
    if not np.isfinite(height).any():
        return AZIMUTHS[0]
    rows, columns = np.nonzero(height <= np.nanquantile(height, LOWEST))
    seen = [_seen(np.nan_to_num(height, nan=0.0), rows, columns, np.radians(angle)) for angle in AZIMUTHS]
    return AZIMUTHS[int(np.argmax(np.round(seen, 6)))]  # the first of equals


def _seen(height: Grid, rows: NDArray[np.intp], columns: NDArray[np.intp], angle: float) -> float:
    """Return which share of the cells the eye sees: on the way to it, nothing is higher than the line of sight."""
    way = np.linspace(0.0, 1.5 * SIDE, STEPS)[1:, None]
    size = np.array(height.shape)
    at = np.stack([rows, columns]) + 0.5
    steps = np.array([np.sin(angle), np.cos(angle)]) / SIDE * size
    row, column = (np.floor(at[axis] + way * steps[axis]).astype(int) for axis in (0, 1))
    inside = (row >= 0) & (row < size[0]) & (column >= 0) & (column < size[1])
    passed = np.where(inside, height[np.clip(row, 0, size[0] - 1), np.clip(column, 0, size[1] - 1)], 0.0)
    return float((passed <= height[rows, columns] + way * UP / AWAY + 1e-9).all(axis=0).mean())
