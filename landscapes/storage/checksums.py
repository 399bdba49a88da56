"""Checksums of tiles that include the tile's place, which the checksums of single chunks do not."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray

from .layout import analysis_chunks, create_array

SUMS = "checksum"
Values = Mapping[str, NDArray[Any]]


class Checksums:
    """Hold the checksum of every tile of a slice, in the array `checksum` beside the others."""

    def __init__(self, array: zarr.Array[Any]) -> None:
        self._array = array

    @classmethod
    def of(cls, group: zarr.Group, tiles: tuple[int, ...]) -> Checksums | None:
        """Return the checksums of a slice on disk, or None: copies that xarray wrote have none for their tiles."""
        array: Any = group.get(SUMS)
        return cls(array) if array is not None and array.shape == tiles else None

    def write(self, index: tuple[int, ...], values: Values) -> None:
        """Write the checksum of a tile."""
        self._array[index] = tile_sum(index, values)

    def read(self, tiles: tuple[int, ...]) -> NDArray[np.int64]:
        """Return the checksums of the first `tiles` along each axis, and 0 for the others, which is no tile's."""
        found = np.zeros(self._array.shape, dtype=np.int64)
        box = tuple(slice(count) for count in tiles)
        try:
            found[box] = self._array[box]
        except Exception:  # a torn one raises whatever its codec does
            for index in np.ndindex(*tiles):
                found[index] = self.one(index)
        return found

    def one(self, index: tuple[int, ...]) -> int:
        """Return the checksum of a tile, 0 where it cannot be read."""
        try:
            return int(np.asarray(self._array[index]))
        except Exception:  # as in `read`
            return 0


def tile_sum(index: tuple[int, ...], values: Values) -> int:
    """Return the checksum of a tile, at least 1: of its place, and of the names and the content of its arrays."""
    total = zlib.crc32(str(index).encode())
    for name in sorted(values):
        total = zlib.crc32(np.ascontiguousarray(values[name]).tobytes(), total)
    return total + 1


def text_sum(words: Iterable[str]) -> str:
    """Return the checksum of a list of words in hexadecimal digits: as a number it is too large for netCDF."""
    return f"{zlib.crc32(json.dumps(list(words)).encode()):08x}"


def lay_out_sums(
    group: zarr.Group, tiles: tuple[int, ...], chunks: tuple[int, ...], names: Sequence[str]
) -> zarr.Array[Any]:
    """Make the empty array of the checksums of so many tiles along the dimensions of these names."""
    said = "checksum (CRC-32, plus one) of a tile's place, gradient, loss and status"
    return create_array(group, SUMS, tiles, chunks, tuple(f"{name}_tile" for name in names), "int64", long_name=said)


def write_sums(group: zarr.Group, dataset: xr.Dataset) -> None:
    """Write the checksum of every chunk of a finished slice."""
    samples, names = dataset["loss"].shape, [str(name) for name in dataset["loss"].dims]
    sides = analysis_chunks(samples)
    tiles = tuple(math.ceil(points / side) for points, side in zip(samples, sides, strict=True))
    sums = np.zeros(tiles, dtype=np.int64)
    for index in np.ndindex(*tiles):
        place = tuple(slice(at * side, (at + 1) * side) for at, side in zip(index, sides, strict=True))
        sums[index] = tile_sum(index, {str(name): one.to_numpy()[place] for name, one in dataset.items()})
    lay_out_sums(group, tiles, tiles, names)[...] = sums
