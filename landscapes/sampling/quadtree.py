"""Choose the samples of a slice: a quadtree over its grid, split where gradients do not explain neighbours.

A cell lies between points of a lattice, which is every second, fourth, eighth ... point of the grid along each axis and
the last one; a plane's cell has four corners, a line's two. Inside, the loss is interpolated in two ways: linearly, and
by the cubic of its losses and gradients (Hermite; in a plane the incomplete bicubic of Adini & Clough 1961, which is
exact for cubics). A cell is judged by the better of the two at its test samples: those of the split it comes from, and
later ones inside it or at its border.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..large import refuse_large

Values = NDArray[np.float64]
Places = NDArray[np.intp]  # of points of the grid, shape (count, rank), in array order
CELLS = 6  # along the longer axis, of the coarsest lattice, at least
UNTESTED = 1 / 4  # of the error of a cell that its halves are taken to have, where nothing is known yet,
SMOOTHEST = 1 / 16  # and at best: that of a cubic falls by the fourth power of its length
SURPRISE = 1 / 2  # of the difference of an edge from what its gradients say, which counts as an error,
BULGE = 1 / 4  # and of how far its cubic is from its chord, which is not an error yet where it is a bowl's
CALMEST = 1 / 8  # of that surprise is taken, at least, where less has come of it so far
INSIDE = 1e-9  # steps of the grid below its upper border


@dataclass
class Cells:
    """The cells that are not split: their lower and upper corners, each shape (cell, rank), and their levels.

    A cell of level k is 2^k points wide, or the rest at the upper border. `error` are those of its parent's cubic and
    linear interpolation, shape (cell, 2), and `before` is the better one of its grandparent: NaN where there was none.
    `weight` is the reliability of its parent's suspicion.
    """

    low: Places
    high: Places
    level: NDArray[np.intp]
    error: Values
    before: Values
    weight: Values

    def __len__(self) -> int:
        return len(self.low)

    def take(self, which: Any) -> Cells:
        """Return some of the cells."""
        return self.pick(np.flatnonzero(which))

    def pick(self, numbers: NDArray[np.intp]) -> Cells:
        """Return cells by their numbers, with repetitions."""
        return Cells(*(getattr(self, name)[numbers] for name in self.__dataclass_fields__))

    def join(self, others: Cells) -> Cells:
        """Return these cells and others."""
        pairs = ((getattr(self, name), getattr(others, name)) for name in self.__dataclass_fields__)
        return Cells(*(np.concatenate(pair) for pair in pairs))


class Quadtree:
    """The samples of a grid, and the cells between them.

    `loss` [loss unit], NaN where an evaluation failed, and `slope`, by a step of the grid along each axis of the array,
    have the grid's shape; `sampled` marks known ones. Without gradients all slopes are NaN.
    """

    def __init__(self, shape: Sequence[int]) -> None:
        self.shape, self.rank = tuple(shape), len(shape)
        self.loss = np.full(self.shape, np.nan)
        self.slope = np.full((*self.shape, self.rank), np.nan)
        self.sampled = np.zeros(self.shape, bool)
        self.probed = np.zeros((0, self.rank), np.intp)
        self.corners = np.array(list(product((0, 1), repeat=self.rank)))
        self.cells = self._coarsest()
        self._known: Values | None = None  # what `_tested` has found

    @property
    def range(self) -> float:
        """The range of the losses. Raises ValueError where their differences would overflow."""
        known = self.loss[np.isfinite(self.loss)]
        refuse_large(known)
        return float(np.ptp(known)) if known.size else 0.0

    def lattice(self) -> Places:
        """Return the points of the coarsest lattice."""
        return self._unique(np.concatenate(list(self._corner_places(self.cells).swapaxes(0, 1))))

    def add(self, places: Places, loss: Values, slope: Values) -> None:
        """Add samples: their losses, shape (count,), and slopes by a step of the grid, shape (count, rank)."""
        at = tuple(places.T)
        self.loss[at], self.slope[at], self.sampled[at] = loss, slope, True
        self._known = None

    def probe(self, places: Places, said: Values) -> Values:
        """Add samples that test `predict`, and return its errors.

        A failed evaluation counts as infinite, unless the interpolation has failures around it, too.
        """
        self.probed, self._known = np.concatenate([self.probed, places]), None
        return _distance(said, self.loss[tuple(places.T)])

    def suspects(self) -> Values:
        """Return the suspected error in each cell [loss unit], zero where it has no point left to sample.

        It is infinite where only some corners failed, because failures have a border.
        """
        cells, tested = self.cells, self._tested()
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.clip(_better(cells.error) / cells.before, SMOOTHEST, 1.0)
        expected = _better(cells.error) * np.where(np.isfinite(ratio), ratio, UNTESTED)
        found = np.where(np.isfinite(expected), expected, 0.0)
        found = np.fmax(found, np.where(self._trusts_cubic(), self._surprise(), 0.0))
        found = np.fmax(found, _better(tested))
        failed = np.isnan(self.loss[self._index(self._corner_places(cells))])
        found = np.where(failed.any(axis=1) & ~failed.all(axis=1), np.inf, found)
        return np.where((cells.high - cells.low > 1).any(axis=1), found, 0.0)

    def unbalanced(self) -> NDArray[np.bool_]:
        """Return the cells with neighbours less than half as large, whose fine structure can continue in them."""
        cells, found = self.cells, np.zeros(len(self.cells), bool)
        quarter = 2 ** np.maximum(cells.level - 2, 0)[:, None]
        for axis in range(self.rank if self.rank > 1 else 0):
            for corner in self.corners[self.corners[:, axis] == 0]:
                for part in (1, 3):
                    places = np.where(corner, cells.high, cells.low)
                    places[:, axis] = np.minimum((cells.low + part * quarter)[:, axis], cells.high[:, axis])
                    inside = (places[:, axis] < cells.high[:, axis]) & (cells.level > 1)
                    found |= inside & self.sampled[self._index(places)] & ~self._is_probed(places)
        return found

    def _is_probed(self, places: Places) -> NDArray[np.bool_]:
        return np.isin(
            np.ravel_multi_index(tuple(places.T), self.shape), np.ravel_multi_index(tuple(self.probed.T), self.shape)
        )

    def split_points(self, which: NDArray[np.bool_]) -> Places:
        """Return the points to sample for splitting some cells."""
        places, inside = self._thirds(self.cells.take(which))
        wanted = self._unique(places[inside])
        new: NDArray[np.bool_] = np.logical_not(self.sampled[tuple(wanted.T)])
        return wanted[new]

    def split(self, which: NDArray[np.bool_]) -> None:
        """Split some cells, whose points are sampled."""
        parents, error = self.cells.take(which), self._tested()[which]
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = np.fmin(np.fmax(parents.weight * _better(error) / self._surprise()[which], CALMEST), 1.0)
        middle = parents.low + 2 ** (parents.level - 1)[:, None]
        parts = [self.cells.take(np.logical_not(which))]
        for corner in self.corners:
            low = np.where(corner, middle, parents.low)
            high = np.where(corner, parents.high, np.minimum(middle, parents.high))
            whole = Cells(low, high, parents.level - 1, error, _better(parents.error), weight)
            parts.append(whole.take((low < high).all(axis=1)))
        self.cells = reduce(Cells.join, parts)
        self._known = None

    def predict(self, places: Values) -> Values:
        """Return the interpolated loss at positions, shape (count, rank), in steps of the grid."""
        numbers = self._find(places)
        cells = self.cells.pick(numbers)
        at = (places - cells.low) / (cells.high - cells.low)
        both = self._interpolate(cells, at[:, None, :])[:, 0]
        return np.where(self._trusts_cubic()[numbers], both[:, 0], both[:, 1])

    def fill(self) -> Values:
        """Return the interpolated loss at every point of the grid that is not sampled, NaN at the others."""
        found, trusted = np.full(self.shape, np.nan), self._trusts_cubic()
        sizes = self.cells.high - self.cells.low
        for size in np.unique(sizes, axis=0):
            which = (sizes == size).all(axis=1)
            some, inner = self.cells.take(which), np.array(list(product(*(range(one + 1) for one in size))))
            both = self._interpolate(some, np.broadcast_to(inner / size, (len(some), *inner.shape)))
            places = some.low[:, None, :] + inner
            found[self._index(places)] = np.where(trusted[which][:, None], both[..., 0], both[..., 1])
        return np.where(self.sampled, np.nan, found)

    def _coarsest(self) -> Cells:
        level, axes = coarsest_lattice(self.shape)
        low = np.array(list(product(*(axis[:-1] for axis in axes))), dtype=np.intp)
        high = np.array(list(product(*(axis[1:] for axis in axes))), dtype=np.intp)
        count = len(low)
        return Cells(
            low, high, np.full(count, level), np.full((count, 2), np.nan), np.full(count, np.nan), np.ones(count)
        )

    def _find(self, places: Values) -> NDArray[np.intp]:
        """Return the number of the cell that contains each position."""
        names = zip(self.cells.level.tolist(), *self.cells.low.T.tolist(), strict=True)
        number = {name: at for at, name in enumerate(names)}
        inside = np.minimum(places, np.array(self.shape) - 1 - INSIDE).astype(int)
        levels = sorted(set(self.cells.level.tolist()))
        names_of = ([(level, *(place >> level << level).tolist()) for level in levels] for place in inside)
        return np.array([next(number[one] for one in some if one in number) for some in names_of], dtype=np.intp)

    def _corner_places(self, cells: Cells) -> Places:
        """Return the corners of cells, shape (cell, corner, rank)."""
        return np.where(self.corners, cells.high[:, None, :], cells.low[:, None, :])

    def _thirds(self, cells: Cells) -> tuple[Places, NDArray[np.bool_]]:
        """Return lower, middle and upper points of cells along each axis, and which are there and no corners."""
        half = 2 ** np.maximum(cells.level - 1, 0)[:, None]
        middle = np.minimum(cells.low + half, cells.high)
        stages = np.stack([cells.low, middle, cells.high])
        which = np.array(list(product(range(3), repeat=self.rank)))
        places = np.stack([stages[one, :, axis] for axis, one in enumerate(which.T)], axis=-1).swapaxes(0, 1)
        new = (which == 1) & (middle < cells.high)[:, None, :]
        there = (new | (which != 1)).all(axis=2)
        return places, there & new.any(axis=2)

    def _tested(self) -> Values:
        """Return the largest errors of both interpolations at samples in each cell other than its corners.

        NaN where there is no such sample, infinite where one failed.
        """
        if self._known is None:
            places, inside = self._thirds(self.cells)
            known = np.expand_dims(inside & self.sampled[self._index(places)], -1)
            found: Values = np.fmax.reduce(np.where(known, self._off(self.cells, places), np.nan), axis=1)
            if len(self.probed):
                numbers = self._find(self.probed.astype(float))
                off = self._off(self.cells.pick(numbers), self.probed[:, None, :])[:, 0]
                np.fmax.at(found, numbers, off)
            self._known = found
        return self._known

    def _off(self, cells: Cells, places: Places) -> Values:
        """Return the errors of both interpolations at positions of each cell, infinite where one failed."""
        at = (places - cells.low[:, None, :]) / (cells.high - cells.low)[:, None, :]
        both, loss = self._interpolate(cells, at), self.loss[self._index(places)]
        lacking = ~np.isfinite(both[..., :1]) & np.isfinite(both[..., 1:])  # gradients, while there are losses
        return np.where(
            np.concatenate([lacking, np.zeros_like(lacking)], axis=-1), np.inf, _distance(both, loss[..., None])
        )

    def _trusts_cubic(self) -> NDArray[np.bool_]:
        """Return for each cell whether it has gradients that did not predict worse than losses alone."""
        tested = self._tested()
        untested: NDArray[np.bool_] = np.asarray(np.isnan(tested).all(axis=1))
        error = np.where(untested[:, None], self.cells.error, tested)
        there = np.isfinite(self.slope[self._index(self._corner_places(self.cells))]).all(axis=(1, 2))
        trusted: NDArray[np.bool_] = there & np.logical_not(error[:, 0] > error[:, 1])
        return trusted

    def _surprise(self) -> Values:
        """Return the error suggested by the edges of cells, whose losses and gradients contradict each other."""
        cells = self.cells
        places, found = self._corner_places(cells), np.zeros(len(cells))
        loss, slope = self.loss[self._index(places)], self.slope[self._index(places)]
        for axis in range(self.rank):
            width = (cells.high - cells.low)[:, axis]
            for start in np.flatnonzero(self.corners[:, axis] == 0):
                end = start + 2 ** (self.rank - 1 - axis)
                rise = slope[:, [start, end], axis] * width[:, None]
                contradiction = np.abs(loss[:, end] - loss[:, start] - rise.mean(axis=1))
                bulge = np.abs(rise[:, 0] - rise[:, 1]) / 8
                found = np.fmax(found, np.fmax(SURPRISE * contradiction, BULGE * bulge))
        return cells.weight * found

    def _interpolate(self, cells: Cells, at: Values) -> Values:
        """Return the cubic and the linear interpolation at places `at` from 0 to 1 along each side of each cell.

        Shape (cell, place, rank) to (cell, place, 2).
        """
        places = self._corner_places(cells)
        loss, slope = self.loss[self._index(places)], self.slope[self._index(places)]
        half = (cells.high - cells.low)[:, None, :] / 2
        sign = 2 * self.corners - 1
        x = (2 * at - 1)[:, :, None, :] * sign  # from -1 at the opposite side to 1 at the corner's
        linear = ((1 + x) / 2).prod(axis=-1)
        cubic = linear * (2 + x.sum(axis=-1) - (x**2).sum(axis=-1)) / 2
        steep = linear[..., None] * (1 + x) * (x - 1) / 2 * sign  # of a derivative by half a side
        if self.rank == 1:
            cubic = linear * (2 + x[..., 0] - x[..., 0] ** 2) / 2
        value = (cubic * loss[:, None]).sum(axis=-1)
        value = value + (steep * (slope * half)[:, None]).sum(axis=(-1, -2))
        return np.stack([value, (linear * loss[:, None]).sum(axis=-1)], axis=-1)

    def _index(self, places: Places) -> tuple[Places, ...]:
        return tuple(np.moveaxis(places, -1, 0))

    def _unique(self, places: Places) -> Places:
        flat = np.unique(np.ravel_multi_index(tuple(places.reshape(-1, self.rank).T), self.shape))
        return np.stack(np.unravel_index(flat, self.shape), axis=-1)


def coarsest_lattice(shape: Sequence[int]) -> tuple[int, list[NDArray[np.intp]]]:
    """Return the level of the coarsest lattice of a grid, and its points along each axis."""
    level = 0
    while (max(shape) - 1) / 2 ** (level + 1) >= CELLS:
        level += 1
    return level, [np.append(np.arange(0, points - 1, 2**level), points - 1) for points in shape]


def _better(errors: Values) -> Values:
    """Return the smaller of the errors of both interpolations."""
    found: Values = errors.min(axis=1)
    return found


def _distance(said: Values, found: Values) -> Values:
    """Return the distance of interpolated losses from found ones, infinite where one is missing."""
    off = np.abs(said - found)
    return np.where(np.isnan(said) & np.isnan(found), 0.0, np.where(np.isnan(off), np.inf, off))
