"""The arrays of a slice that hold its samples: read and written tile by tile; what is damaged counts as missing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from ..objective import Status, has_loss
from .checksums import Checksums, tile_sum
from .paths import corner
from .tiles import Tile

Arrays = dict[str, NDArray[Any]]  # loss, status and, unless sampled without gradients, grad
Box = tuple[slice, ...]


class Samples:
    """Hold the arrays `loss`, `status` and perhaps `grad` of an open store, in stored order.

    A tile counts when it decodes, its status has no MISSING, loss and gradient are finite exactly where the status says
    so, and its checksum is right. Everything else is as if it had never been written. `place` is the store's folder,
    None of one in memory; `ascending` says that it was finished, so that every tile is there. `sloped` says along each
    axis which samples have a gradient where the others on it do, too; the gradient of all others is NaN.
    """

    def __init__(
        self,
        group: zarr.Group,
        shape: tuple[int, ...],
        place: Path | None,
        *,
        ascending: bool,
        sloped: Sequence[NDArray[np.bool_]],
    ) -> None:
        arrays = dict(group.arrays())
        self.shape = shape
        self.arrays = {name: arrays[name] for name in ("loss", "grad", "status") if name in arrays}
        self.side = self.arrays["status"].chunks[: len(shape)]
        self._sums = Checksums.of(group, self.tile_counts) if place else None
        self._filling = None if ascending else place
        self._sloped = sloped

    @property
    def whole(self) -> Box:
        """The box of all samples."""
        return tuple(slice(points) for points in self.shape)

    @property
    def tile_counts(self) -> tuple[int, ...]:
        """Tiles along each axis."""
        return tuple(math.ceil(points / side) for points, side in zip(self.shape, self.side, strict=True))

    def tiles(self) -> list[Tile]:
        """Return every tile, coarse to fine."""
        return sorted(
            map(Tile, np.ndindex(*self.tile_counts)), key=lambda tile: (tile.level, sum(tile.index), tile.index)
        )

    def place(self, tile: Tile) -> Box:
        """Return the box of a tile."""
        sizes = zip(tile.index, self.side, self.shape, strict=True)
        return tuple(slice(at * side, min((at + 1) * side, points)) for at, side, points in sizes)

    def sloped(self, box: Box) -> NDArray[np.bool_]:
        """Return which samples of a box have a gradient."""
        found: NDArray[np.bool_] = np.ones((), dtype=bool)
        for axis, at in zip(self._sloped, box, strict=True):
            found = found[..., None] & axis[at]
        return found

    def read_tile(self, tile: Tile) -> Arrays | None:
        """Return the arrays of a tile that is finished, None of one that is not."""
        place = self.place(tile)
        try:
            values = self._load(place)
        except Exception:  # as in `read`
            return None
        if self._sums and self._sums.one(tile.index) != tile_sum(tile.index, values):
            return None
        return None if (self._check_status(values, place) == Status.MISSING).any() else values

    def write_tile(self, tile: Tile, values: Mapping[str, NDArray[Any]]) -> None:
        """Write the arrays of a tile, status last."""
        if self._sums is not None:
            self._sums.write(tile.index, values)
        for name in self.arrays:  # loss, grad, status
            self.arrays[name][self.place(tile)] = values[name]

    def find_written(self, tiles: Sequence[Tile]) -> list[Tile]:
        """Return those of the tiles that something was written of: their status is there, or torn."""
        try:
            status, begun = np.zeros(self.shape, np.int8), self._begun_corner(self.whole)
            status[begun] = self.arrays["status"][begun]
            return [tile for tile in tiles if status[self.place(tile)].any()]
        except Exception:  # as in `read`
            return [tile for tile in tiles if self._has_status(tile)]

    def read(self, box: Box, known: Mapping[Tile, Mapping[str, NDArray[Any]]] | None = None) -> Arrays:
        """Read a box of whole tiles, each array at once; where that fails, tile by tile, leaving out what is torn.

        Where some tiles are `known`, the others are read one by one, too.
        """
        try:
            values = self._read_tiles(box, known) if known else self._load(box)
        except Exception:  # a damaged chunk raises whatever its codec does
            values = self._read_tiles(box, {})
        status = self._check_status(values, box)
        sums = self._sums.read(self._tiles_begun()) if self._sums else None
        for tile in self.tiles() if self._sums or (status == Status.MISSING).any() else ():
            place = self.place(tile)
            part = {name: array[place] for name, array in values.items()}
            torn = sums is not None and part["status"].any() and sums[tile.index] != tile_sum(tile.index, part)
            if torn or (part["status"] == Status.MISSING).any():  # finished whole or not at all
                part["status"][...] = Status.MISSING
        for name in values.keys() - {"status"}:
            values[name][status == Status.MISSING] = np.nan
        return values

    def _check_status(self, values: Mapping[str, NDArray[Any]], box: Box) -> NDArray[np.int8]:
        """Return the status, MISSING where it and the numbers contradict each other."""
        status: NDArray[np.int8] = values["status"]
        finite, lacking = np.isfinite(values["loss"]), np.zeros(status.shape, dtype=bool)
        if "grad" in values:
            lacking = ~np.isfinite(values["grad"]).all(axis=-1) & self.sloped(box)
        whole = np.where(has_loss(status), finite & (lacking == (status == Status.NO_GRADIENT)), ~finite)
        status[~whole] = Status.MISSING
        return status

    def _load(self, box: Box) -> Arrays:
        """Read a box of every array; where its status says that nothing is there, nothing else is looked for."""
        values, begun = self._blank(box), self._begun_corner(box)
        inside = tuple(slice(len(range(points)[at])) for points, at in zip(self.shape, begun, strict=True))
        values["status"][inside] = self.arrays["status"][begun]
        for name, array in self.arrays.items() if values["status"].any() else ():
            if name != "status":
                values[name][inside] = array[begun]
        return values

    def _read_tiles(self, box: Box, known: Mapping[Tile, Mapping[str, NDArray[Any]]]) -> Arrays:
        values = self._blank(box)
        for tile in self.tiles():
            place = self.place(tile)
            inside = all(at.stop <= size for at, size in zip(place, values["status"].shape, strict=True))
            if inside and (part := known.get(tile) or self.read_tile(tile)):
                for name, array in part.items():
                    values[name][place] = array
        return values

    def _has_status(self, tile: Tile) -> bool:
        try:
            return bool(np.asarray(self.arrays["status"][self.place(tile)]).any())
        except Exception:  # as in `read`
            return True

    def _begun_corner(self, box: Box) -> Box:
        """Return the corner of the whole beyond which no tile is, since looking for each of many files takes long."""
        if box != self.whole:
            return box
        begun = zip(self._tiles_begun(), self.side, self.shape, strict=True)
        return tuple(slice(min(count * side, points)) for count, side, points in begun)

    def _tiles_begun(self) -> tuple[int, ...]:
        """Return how many tiles along each axis there may be."""
        return corner(self._filling / "status", len(self.shape)) if self._filling else self.tile_counts

    def _blank(self, box: Box) -> Arrays:
        shape = tuple(len(range(points)[at]) for at, points in zip(box, self.shape, strict=True))
        return {
            name: np.full(shape + array.shape[len(shape) :], array.fill_value, array.dtype)
            for name, array in self.arrays.items()
        }
