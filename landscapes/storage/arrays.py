"""The arrays of a slice and their attributes, by the CF conventions."""

from __future__ import annotations

import json
import math
import threading
import warnings
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from heapq import heappop, heappush
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec

from ..capacity import BLOCK, Need, require
from ..identity import BOUNDS, PACKAGE, VERSIONS, DamagedError, with_package
from ..objective import Status
from ..plane import Plane
from ..space import LOG10, ParameterSpace
from .files import store_files

FORMAT = 2
AXES = ("u", "v")
CF = "CF-1.11"
SUMS = "checksum"
INTERPOLATED = "interpolated"  # the array of a refined slice that has what was not sampled
FILES = store_files(("loss", "grad", "status", INTERPOLATED, SUMS, *AXES, "dim", "unit"))  # of a slice on disk
DRAWN = 150  # bytes that a picture takes for each sample
COORDINATES = {"coordinates": "unit"}  # tells xarray that it is no variable


def axes_of(plane: Plane, parameters: list[str], units: list[str], *, ascending: bool) -> dict[str, NDArray[Any]]:
    """Return the coordinates of a slice in stored order: ascending, or coarse to fine while tiles are being filled."""
    found: dict[str, NDArray[Any]] = {}
    for name, axis in zip(AXES, plane.axes(), strict=False):
        values = axis.numpy()
        found[name] = values if ascending else values[coarse_to_fine(len(values), tile_side(len(values)))]
    return found | {"dim": np.array(parameters, dtype=object), "unit": np.array(units, dtype=object)}


def need_of(shape: tuple[int, ...], dim: int, *, grad: bool) -> Need:
    """Return an upper bound of what sampling a slice takes: memory beside what the process holds, and disk.

    In memory there are four copies of the arrays when it is finished and sorted, and what a picture takes. On the disk
    there are the files of the tiles, and for a moment the finished slice beside them.
    """
    points, depth = math.prod(shape), dim if grad else 0
    tiles = math.prod(-(-side // tile_side(side)) for side in shape)
    array = points * (9 + 8 * depth)
    return Need(4.0 * (8 * points + array) + DRAWN * points, 2.0 * array + tiles * (2 + grad) * BLOCK)


def refuse_too_large(plane: Plane, path: Path | None, *, grad: bool) -> None:
    """Refuse a slice that is larger than this machine, in memory alone where there is no path.

    Raises TooLargeError.
    """
    most = max(plane.resolution)

    def need(side: int) -> Need:
        return need_of(tuple(-(-points * side // most) for points in plane.resolution), plane.dim, grad=grad)

    require("resolution", most, need, path)


def lay_out(
    group: zarr.Group,
    plane: Plane,
    space: ParameterSpace,
    identity: Mapping[str, Any],
    provenance: Mapping[str, Any],
    *,
    grad: bool,
) -> None:
    """Make the empty arrays of a slice that is to be filled tile by tile."""
    axes = axes_of(plane, list(space.names), list(space.units), ascending=False)
    names = AXES[: plane.rank][::-1]
    shape = tuple(len(axes[name]) for name in names)
    side = tuple(tile_side(points) for points in shape)
    bounds = [space.to_values(bound).tolist() for bound in (space.lower, space.upper)]
    group.attrs.update({**_about(identity, {**with_package(provenance), BOUNDS: bounds}), **COORDINATES})
    unit = str(provenance.get("loss_unit", ""))
    create_array(group, "loss", shape, side, names, "float64", long_name="loss", **({"units": unit} if unit else {}))
    if grad:
        said = "gradient of the loss by each parameter, in the loss's unit per the parameter's"
        deep = (*shape, space.dim), (*side, space.dim), (*names, "dim")
        create_array(group, "grad", *deep, "float64", long_name=said)
    create_array(group, "status", shape, side, names, "int8", long_name="how the evaluation ended", **flags(Status))
    tiles = tuple(math.ceil(points / one) for points, one in zip(shape, side, strict=True))
    lay_out_sums(group, tiles, (1,) * len(tiles), names)
    for number, name in enumerate(AXES[: plane.rank]):
        _keep(group, name, axes[name], (name,), _axis(plane, number))
    _keep(group, "dim", axes["dim"], ("dim",), {"long_name": "parameter"})
    about = {"long_name": "unit of the parameter", "checksum": text_sum(axes["unit"])}  # nothing else says them
    _keep(group, "unit", axes["unit"], ("dim",), about)


def write_finished(path: Path, dataset: xr.Dataset) -> None:
    """Write a slice that is complete to a new folder: ascending, in chunks as analysis wants them."""
    group = zarr.create_group(path, zarr_format=3)
    group.attrs.update({**dataset.attrs, **COORDINATES})
    samples = dataset["loss"].shape
    for name, values in dataset.variables.items():
        dims = tuple(map(str, values.dims))
        if values.dtype.kind in "fi" and dims != (name,):
            chunks = analysis_chunks(samples, *values.shape[len(samples) :])
            array = create_array(
                group, str(name), values.shape, chunks, dims, values.dtype.name, codecs=COMPACT_CODECS, **values.attrs
            )
            array[...] = values.to_numpy()
        else:
            _keep(group, str(name), values.to_numpy(), dims, values.attrs)
    write_sums(group, dataset.drop_vars(INTERPOLATED, errors="ignore"))
    consolidate(path)


def attributes_of(node: zarr.Group | zarr.Array[Any]) -> dict[str, Any]:
    """Return the attributes of a group or an array, without the hints that xarray removes as it reads."""
    return {str(name): value for name, value in node.attrs.items() if name not in COORDINATES}


def parameters_of(dataset: xr.Dataset) -> list[tuple[str, str]]:
    """Return the name and the unit of every parameter of a slice."""
    names, units = (map(str, dataset[name].to_numpy()) for name in ("dim", "unit"))
    return list(zip(names, units, strict=True))


def _axis(plane: Plane, number: int) -> dict[str, str]:
    about = {"label": plane.labels[number], "long_name": plane.names[number]}
    about |= {"scale": LOG10} if plane.scales[number] == LOG10 else {}
    return about | ({"units": plane.units[number]} if plane.units[number] else {})


def _keep(
    group: zarr.Group, name: str, values: NDArray[Any], dims: tuple[str, ...], attributes: Mapping[str, Any]
) -> None:
    """Write a small array whole."""
    number = values.dtype.kind in "fi"
    kind, codecs = (values.dtype.name, COMPACT_CODECS) if number else ("string", CODECS)
    array = create_array(group, name, values.shape, values.shape, dims, kind, codecs=codecs, **attributes)
    array[...] = values if number else values.astype(object)


def _about(identity: Mapping[str, Any], provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a slice: what it is, in words, and its identity and provenance as JSON."""
    over = " and ".join(label.partition(" [")[0] for label in identity["plane"]["labels"])
    made = " ".join(str(provenance[name]) for name in ("created", "command") if provenance.get(name))
    return {
        "gradscape_slice": FORMAT,
        "Conventions": CF,
        "title": f"{identity.get('objective', 'loss')} over {over}",
        "source": f"{PACKAGE} {provenance[VERSIONS][PACKAGE]}",
        **({"history": made} if made else {}),
        "identity": json.dumps(identity),
        "provenance": json.dumps(provenance),
    }


FILL = {"float64": float("nan"), "int8": 0, "int64": 0, "string": ""}
CODECS = [ZstdCodec(level=3, checksum=True)]
COMPACT_CODECS = [BloscCodec(cname="zstd", clevel=9, shuffle="shuffle"), Crc32cCodec()]
_QUIET = threading.Lock()  # threads share what warnings are shown
SIDE, VALUES = 256, 1 << 20  # of a chunk of a finished slice: samples along an axis and values in all, at most


def open_group(path: Path, mode: Literal["r", "r+"] = "r") -> zarr.Group:
    """Open a store of zarr's format 3 alone: format 2 has a codec (pickle) that runs what it reads."""
    return zarr.open_group(path, mode=mode, zarr_format=3, use_consolidated=False)


def create_array(
    group: zarr.Group,
    name: str,
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    dims: tuple[str, ...],
    dtype: str,
    codecs: Sequence[Any] = CODECS,
    **attributes: Any,
) -> zarr.Array[Any]:
    """Make an empty array of named dimensions whose torn or altered chunks do not decode."""
    return group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        fill_value=FILL[dtype],
        dimension_names=dims,
        compressors=list(codecs),
        config={"write_empty_chunks": True},  # a chunk of NaN is a result too
        attributes=attributes,
    )


def analysis_chunks(samples: Sequence[int], *deep: int) -> tuple[int, ...]:
    """Return the chunk of an array over so many samples along each axis, which may have another dimension after them.

    A chunk holds a whole map where that is not large, and of as many components of the gradient as make 8 MB.
    """
    sides = tuple(min(count, SIDE) for count in samples)
    return (*sides, *(min(size, max(1, VALUES // math.prod(sides))) for size in deep))


def flags(kind: type[IntEnum]) -> dict[str, Any]:
    """Return the attributes (CF conventions) that say what the codes of an int8 array mean."""
    return {"flag_values": [int(k) for k in kind], "flag_meanings": " ".join(k.name.lower() for k in kind)}


def consolidate(path: Path) -> None:
    """Gather a store's layout in one file, so that plain xarray.open_zarr reads it."""
    with _QUIET, warnings.catch_warnings():  # not in zarr's specification yet
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(str(path))


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


ANEW = "restore it, or sample the slice anew in another folder"


def check_integrity(path: Path, group: zarr.Group, axes: Mapping[str, NDArray[Any]], values: Sequence[str]) -> None:
    """Raise DamagedError, naming the file, where a slice store's layout or axes are not what they were made.

    `axes` hold what its coordinates must be, in stored order; `values` name the other arrays. Chunks of those have
    checksums, and are looked at when they are read.
    """
    wanted, found = {*axes, *values}, set(group.array_keys())
    known = _index(path)
    if not wanted <= found or known.keys() not in (set(), found):
        raise damage(path, f"it needs the arrays {', '.join(sorted(wanted))} and an index of them")
    for name, layout in known.items():
        if _read(path / name) != layout:
            raise damage(path / name, "its layout is not what the store's index says")
    for name, axis in axes.items():
        if not np.array_equal(_values(path / name, group[name]), axis):
            raise damage(path / name, "it is not what the store's identity says")


def check_layouts(path: Path) -> None:
    """Raise DamagedError, naming the file, where what says how an array is stored cannot be read."""
    for folder in sorted(one for one in path.iterdir() if one.is_dir()):
        if _read(folder).get("node_type") != "array":
            raise damage(folder / "zarr.json", "it does not say how an array is stored")


def _index(path: Path) -> dict[str, Any]:
    """Return the layout of every array as the store's index has it, nothing where it has no index."""
    root = _read(path)
    if "consolidated_metadata" not in root:
        return {}
    index = root["consolidated_metadata"]
    known = index.get("metadata") if isinstance(index, dict) else None
    if not isinstance(known, dict) or not known:
        raise damage(path, "the index of its arrays is not what it was made")
    return known


def _values(path: Path, array: Any) -> NDArray[Any]:
    try:
        return np.asarray(array[...])
    except Exception as error:  # whatever a codec raises
        raise damage(path, str(error)) from None


def _read(folder: Path) -> dict[str, Any]:
    path = folder / "zarr.json"
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise damage(path, str(error)) from None
    if not isinstance(found, dict):
        raise damage(path, "it is no JSON object")
    return found


def damage(path: Path, why: str) -> DamagedError:
    """Return what to raise for a file of a slice that is not what was written."""
    return DamagedError.of(path, why, ANEW)
