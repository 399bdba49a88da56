"""The arrays of a slice and their attributes, by the CF conventions."""

from __future__ import annotations

import json
import math
import re
import threading
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from heapq import heappop, heappush
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile, ZipInfo

import numpy as np
import torch
import xarray as xr
import zarr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from zarr.abc.store import Store
from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec
from zarr.core.buffer import Buffer
from zarr.storage import MemoryStore, ZipStore

from ..capacity import BLOCK, Need, require
from ..identity import ERROR, PACKAGE, VERSIONS, DamagedError, current_identity, current_provenance
from ..objective import Status
from ..plane import Plane
from ..space import LOG10
from .checkpoint import PARTS
from .files import store_files

FORMAT = 2
HEADER = "slice.json"  # what a slice is that is being filled
MARK = "gradscape_slice"  # the attribute that says that something is a slice, and of which format
AXES = ("u", "v")
SAMPLES = ("loss", "grad", "status")  # the arrays of what was evaluated
CF = "CF-1.11"
SUMS = "checksum"
INTERPOLATED = "interpolated"  # the array of a refined slice that has what was not sampled
ROOT = "zarr.json"  # what a zarr store is, and every array in it
FIRST_BYTES = re.compile(rb"PK\x03\x04.{26}zarr\.json", re.DOTALL)  # of a finished slice's file
FILES = store_files((*SAMPLES, INTERPOLATED, SUMS, *AXES, "dim", "unit"))  # of one that is a folder
POINTS = "points"  # what names of files begin with that hold points of a slice that is refined
FILLING_FILES = re.compile(rf"{HEADER}|{PARTS}/(?:{POINTS}-)?\d+(?:-\d+)*\.npz").fullmatch  # of one that is filled
DRAWN = 150  # bytes that a picture takes for each sample
COORDINATES = {"coordinates": "unit"}  # tells xarray that it is no variable
Arrays = dict[str, NDArray[Any]]  # loss, status and, unless sampled without gradients, grad


def need_of(shape: tuple[int, ...], dim: int, *, grad: bool) -> Need:
    """Return an upper bound of the need of sampling a slice: memory in addition to that of the process, and disk.

    Memory has four copies of the arrays when the slice is finished and sorted, and a picture. The disk has the files of
    the tiles, and for a moment the finished slice next to them.
    """
    points, depth = math.prod(shape), dim if grad else 0
    tiles = math.prod(chunk_counts(shape, list(map(tile_side, shape))))
    array = points * (9 + 8 * depth)
    return Need(4.0 * (8 * points + array) + DRAWN * points, 2.0 * array + tiles * (2 + grad) * BLOCK)


def refuse_too_large(plane: Plane, path: Path | None, *, grad: bool) -> None:
    """Refuse a slice that does not fit on this machine, or in its memory if there is no path.

    Raises TooLargeError.
    """
    most = max(plane.resolution)

    def need(side: int) -> Need:
        return need_of(tuple(-(-points * side // most) for points in plane.resolution), plane.dim, grad=grad)

    require("resolution", most, need, path)


def blank(
    identity: Mapping[str, Any], provenance: Mapping[str, Any], units: Sequence[str], *, error: str = ""
) -> xr.Dataset:
    """Return a slice without samples; its arrays take no memory, and cannot be written to."""
    plane, parameters = Plane.from_record(identity["plane"]), identity["parameters"]
    names, shape, unit = AXES[: plane.rank][::-1], plane.resolution[::-1], str(provenance.get("loss_unit", ""))
    arrays: dict[str, Any] = {"loss": (names, _nothing("float64", shape), {"long_name": "loss"})}
    arrays["loss"][2].update({"units": unit} if unit else {})
    if identity["gradients"]:
        said = "gradient of the loss by each parameter, in the loss's unit per the parameter's"
        arrays["grad"] = ((*names, "dim"), _nothing("float64", (*shape, len(parameters))), {"long_name": said})
    arrays["status"] = (names, _nothing("int8", shape), {"long_name": "how the evaluation ended", **flags(Status)})
    axes: dict[str, Any] = {
        name: (name, axis.numpy(), _axis(plane, number))
        for number, (name, axis) in enumerate(zip(AXES, plane.axes(), strict=False))
    }
    axes["dim"] = ("dim", np.array(parameters, object), {"long_name": "parameter"})
    about = {"long_name": "unit of the parameter", "checksum": text_sum(units)}  # nothing else says them
    axes["unit"] = ("dim", np.array(units, object), about)
    return xr.Dataset(arrays, axes, _about(identity, provenance) | ({ERROR: error} if error else {}))


def _nothing(dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    return np.broadcast_to(np.array(FILL[dtype], dtype), shape)


def write_finished(path: Path, dataset: xr.Dataset) -> None:
    """Write a complete slice to a new file, a zarr store in a zip: ascending, in chunks for analysis.

    The same slice makes the same bytes. Chunks are compressed one by one, their metadata by the zip.
    """
    files: dict[str, Buffer] = {}
    group = zarr.create_group(MemoryStore(files), zarr_format=3)
    group.attrs.update({**dataset.attrs, **COORDINATES})
    samples = dataset["loss"].shape
    for name, values in dataset.variables.items():
        dims, number = tuple(map(str, values.dims)), values.dtype.kind in "fi"
        large = number and dims != (name,)
        chunks = analysis_chunks(samples, *values.shape[len(samples) :]) if large else values.shape
        kind, codecs = (values.dtype.name, COMPACT_CODECS) if number else ("string", CODECS)
        array = create_array(group, str(name), values.shape, chunks, dims, kind, codecs=codecs, **values.attrs)
        array[...] = values.to_numpy() if number else values.to_numpy().astype(object)
    write_sums(group, dataset.drop_vars(INTERPOLATED, errors="ignore"))
    consolidate(group.store)
    with ZipFile(path, "w") as archive:
        for name in sorted(files, key=lambda name: (name != ROOT, name)):
            packing = ZIP_DEFLATED if name.endswith(ROOT) else ZIP_STORED
            archive.writestr(ZipInfo(name), files[name].to_bytes(), packing)


def attributes_of(node: zarr.Group | zarr.Array[Any]) -> dict[str, Any]:
    """Return the attributes of a group or an array, without the hints that xarray removes as it reads."""
    return {str(name): value for name, value in node.attrs.items() if name not in COORDINATES}


def parameters_of(dataset: xr.Dataset) -> list[tuple[str, str]]:
    """Return the name and the unit of every parameter of a slice."""
    names, units = (map(str, dataset[name].to_numpy()) for name in ("dim", "unit"))
    return list(zip(names, units, strict=True))


def count_statuses(dataset: xr.Dataset) -> dict[str, int]:
    """Count the points of a slice by status."""
    status = dataset["status"].to_numpy()
    return {kind.name.lower(): int((status == kind).sum()) for kind in Status}


def _axis(plane: Plane, number: int) -> dict[str, str]:
    about = {"label": plane.labels[number], "long_name": plane.names[number]}
    about |= {"scale": LOG10} if plane.scales[number] == LOG10 else {}
    return about | ({"units": plane.units[number]} if plane.units[number] else {})


def _about(identity: Mapping[str, Any], provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a slice: its description, and its identity and provenance as JSON."""
    over = " and ".join(label.partition(" [")[0] for label in identity["plane"]["labels"])
    made = " ".join(str(provenance[name]) for name in ("created", "command") if provenance.get(name))
    return {
        MARK: FORMAT,
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
    """Open a folder or a zip only of zarr's format 3: format 2 has a codec (pickle) that executes its data."""
    store = ZipStore(path, mode="r") if path.is_file() else path
    return zarr.open_group(store, mode=mode, zarr_format=3, use_consolidated=False)


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
    """Make an empty array with named dimensions whose torn or altered chunks do not decode."""
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
    """Return the chunk sizes of an array with this many samples along each axis, and possibly another dimension.

    A chunk has a whole map unless that is large, and as many components of the gradient as make 8 MB.
    """
    sides = tuple(min(count, SIDE) for count in samples)
    return (*sides, *(min(size, max(1, VALUES // math.prod(sides))) for size in deep))


def flags(kind: type[IntEnum]) -> dict[str, Any]:
    """Return the attributes (CF conventions) that name the codes of an int8 array."""
    return {"flag_values": [int(k) for k in kind], "flag_meanings": " ".join(k.name.lower() for k in kind)}


def consolidate(store: Path | Store) -> None:
    """Gather a store's metadata in one file, for plain xarray.open_zarr."""
    with _QUIET, warnings.catch_warnings():  # not in zarr's specification yet
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(store)


@dataclass(frozen=True)
class Tile:
    """Number one tile of a slice, in array order: (row along v, column along u), or (column,) on a line."""

    index: tuple[int, ...]

    @classmethod
    def named(cls, name: str) -> Tile | None:
        """Return the tile of this name, None for another name."""
        return cls(tuple(map(int, name.split("-")))) if re.fullmatch(r"\d+(-\d+)?", name) else None

    @property
    def name(self) -> str:
        """The name of the file of its samples."""
        return "-".join(map(str, self.index))

    @property
    def level(self) -> int:
        """The square of tiles that this one helps to complete: 0 is the first, coarsest picture."""
        return max(self.index)


@dataclass(frozen=True)
class Tiling:
    """The samples of a slice in each tile: coarse to fine, or the chunks of a finished slice.

    `every` is the stride of the samples with gradients along each axis, 0 for none. `chunks` are the sides of the
    chunks.
    """

    plane: Plane
    every: int
    chunks: tuple[int, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Points per axis, in array order."""
        return tuple(self.plane.resolution[::-1])

    @cached_property
    def sides(self) -> tuple[int, ...]:
        """Points of a tile along each axis."""
        return self.chunks or tuple(map(tile_side, self.shape))

    @cached_property
    def order(self) -> list[NDArray[np.intp]]:
        """The samples along each axis in the order of tiles."""
        pairs = zip(self.shape, self.sides, strict=True)
        return [np.arange(n) if self.chunks else np.array(coarse_to_fine(n, side)) for n, side in pairs]

    def tiles(self) -> list[Tile]:
        """Return every tile, coarse to fine."""
        return sorted(
            map(Tile, np.ndindex(*chunk_counts(self.shape, self.sides))),
            key=lambda tile: (tile.level, sum(tile.index), tile.index),
        )

    def rows(self, tile: Tile) -> list[NDArray[np.intp]]:
        """Return the positions of a tile's samples along each axis."""
        parts = zip(tile.index, self.order, self.sides, strict=True)
        return [order[at * side : (at + 1) * side] for at, order, side in parts]

    def count(self, tile: Tile) -> int:
        """Return the number of points of a tile."""
        return math.prod(map(len, self.rows(tile)))

    def sloped(self, tile: Tile) -> NDArray[np.bool_]:
        """Return which points of a tile have a gradient, in the order of `points`, shape (points,)."""
        if not self.every:
            return np.zeros(self.count(tile), bool)
        having = np.meshgrid(*(rows % self.every == 0 for rows in self.rows(tile)), indexing="ij")
        found: NDArray[np.bool_] = np.logical_and.reduce(having).ravel()
        return found

    def points(self, tile: Tile) -> Float[Tensor, "points dim"]:
        """Return the parameters at the points of a tile."""
        pairs = zip(self.plane.axes()[::-1], self.rows(tile), strict=True)
        grid = np.meshgrid(*(axis.numpy()[rows] for axis, rows in pairs), indexing="ij")[::-1]
        return self.plane.lift(torch.from_numpy(np.stack([axis.ravel() for axis in grid], axis=1)))


def chunk_counts(shape: Sequence[int], sides: Sequence[int]) -> tuple[int, ...]:
    """Return the number of chunks with these sides along each axis."""
    return tuple(-(-points // side) for points, side in zip(shape, sides, strict=True))


def _box(index: tuple[int, ...], sides: Sequence[int]) -> tuple[slice, ...]:
    return tuple(slice(at * side, (at + 1) * side) for at, side in zip(index, sides, strict=True))


def tile_side(points: int) -> int:
    """Return the number of an axis' points per tile: an eighth of them, at least 4 and at most 16."""
    return min(points, max(4, min(16, points // 8)))


def coarse_to_fine(points: int, side: int) -> list[int]:
    """Order an axis so that every `side` consecutive points spread evenly over the whole of it.

    The axis is cut into `side` cells, equal to within one point. The first group takes the middle of each cell, the
    next ones the position in the cell farthest (cyclically) from those taken.
    """
    edges = [cell * points // side for cell in range(side + 1)]
    orders = {width: _offsets(width) for width in {high - low for low, high in pairwise(edges)}}
    cells = [[low + offset for offset in orders[high - low]] for low, high in pairwise(edges)]
    return [cell[turn] for turn in range(len(max(cells, key=len))) for cell in cells if turn < len(cell)]


def _offsets(size: int) -> list[int]:
    """Order the positions of a cell: its middle, then always the first of the farthest from all previous ones.

    Distances are cyclic. Between two taken ones, the farthest is halfway, so gaps wait in a heap, the widest first.
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
    """Return a gap between taken positions of a cycle as a heap key: the distance of its middle, and its position."""
    middles = ((start + width // 2) % size, (start + width - width // 2) % size)  # of an odd gap there are two
    return -(width // 2), min(middles), start, width


class Chunks:
    """Read the samples of a finished slice, a chunk at a time, each with a checksum.

    A chunk counts if it decodes and its checksum is right. Copies written by xarray have no checksums.
    """

    def __init__(self, open_it: Callable[[], zarr.Group], shape: tuple[int, ...], sides: tuple[int, ...]) -> None:
        self._open, self._shape, self.sides = open_it, shape, sides

    @cached_property
    def _all(self) -> dict[str, zarr.Array[Any]]:
        return dict(self._open().arrays())

    @cached_property
    def _arrays(self) -> dict[str, zarr.Array[Any]]:
        return {name: self._all[name] for name in SAMPLES if name in self._all}

    @cached_property
    def _sums(self) -> zarr.Array[Any] | None:
        counts = chunk_counts(self._shape, self.sides)
        return self._all[SUMS] if SUMS in self._all and self._all[SUMS].shape == counts else None

    @classmethod
    def open(cls, path: Path) -> tuple[xr.Dataset, Path, Chunks]:
        """Return a finished slice without samples, its path and its chunks.

        Raises DamagedError where its layout or its axes differ from what was written.
        """
        check_layouts(path)
        try:
            group = open_group(path)
            status = group["status"]
            if not isinstance(status, zarr.Array):
                raise TypeError("its status is not an array")
            return _read_blank(path, group), path, cls(lambda: group, status.shape, status.chunks)
        except DamagedError:
            raise
        except Exception as error:  # a damaged axis raises whatever reads it; no chunk is read here
            raise damage(path, f"{type(error).__name__}: {error}") from error

    @classmethod
    def written(cls, path: Path, dataset: xr.Dataset) -> tuple[xr.Dataset, Path, Chunks]:
        """Return the same for a slice that was just written; it reads nothing before a sample is needed."""
        arrays = {name: dataset.variables[name] for name in SAMPLES if name in dataset}
        empty = {name: one.copy(data=_nothing(one.dtype.name, one.shape)) for name, one in arrays.items()}
        shape = dataset["status"].shape
        return dataset.assign(empty), path, cls(lambda: open_group(path), shape, analysis_chunks(shape))

    def read(self, tile: Tile) -> Arrays | None:
        """Return the samples of a chunk, None where they differ from what was written."""
        try:
            values = {name: np.asarray(array[_box(tile.index, self.sides)]) for name, array in self._arrays.items()}
            known = None if self._sums is None else int(np.asarray(self._sums[tile.index]))
        except Exception:  # a damaged chunk raises whatever its codec does
            return None
        return values if known is None or known == tile_sum(tile.index, values) else None


def _read_blank(path: Path, group: zarr.Group) -> xr.Dataset:
    """Return a finished slice without samples, from its plane, which must match its axes."""
    about, arrays = attributes_of(group), dict(group.arrays())
    stored = json.loads(str(about["identity"]))
    identity, provenance = current_identity(stored), current_provenance(json.loads(str(about["provenance"])), stored)
    units = [str(unit) for unit in np.asarray(arrays["unit"][:])]
    if attributes_of(arrays["unit"]).get("checksum", sums := text_sum(units)) != sums:
        raise damage(path / "unit", "it differs from what was written")
    empty = blank(identity, provenance, units)
    axes = {str(name): one.to_numpy() for name, one in empty.coords.items()}
    check_axes(path, group, axes, list(map(str, empty.data_vars)))
    for name, one in empty.variables.items():
        one.attrs = attributes_of(arrays[str(name)])
    if INTERPOLATED in arrays:
        inside = arrays[INTERPOLATED]
        if inside.nchunks_initialized != inside.nchunks:
            raise damage(path / INTERPOLATED, "some of its chunks are missing")
        empty[INTERPOLATED] = (empty["loss"].dims, np.asarray(inside[...]), attributes_of(inside))
    return empty.drop_attrs(deep=False).assign_attrs(about)


def tile_sum(index: tuple[int, ...], values: Arrays) -> int:
    """Return the checksum of a tile, at least 1: of its position, and of the names and the content of its arrays."""
    total = zlib.crc32(str(index).encode())
    for name in sorted(values):
        total = zlib.crc32(np.ascontiguousarray(values[name]).tobytes(), total)
    return total + 1


def text_sum(words: Iterable[str]) -> str:
    """Return the checksum of a list of words in hexadecimal digits: as a number it is too large for netCDF."""
    return f"{zlib.crc32(json.dumps(list(words)).encode()):08x}"


def write_sums(group: zarr.Group, dataset: xr.Dataset) -> None:
    """Write the checksum of every chunk of a finished slice."""
    samples, names = dataset["loss"].shape, [str(name) for name in dataset["loss"].dims]
    sides = analysis_chunks(samples)
    tiles = chunk_counts(samples, sides)
    sums = np.zeros(tiles, dtype=np.int64)
    for index in np.ndindex(*tiles):
        values = {str(name): one.to_numpy()[_box(index, sides)] for name, one in dataset.items()}
        sums[index] = tile_sum(index, values)
    said = "checksum (CRC-32, plus one) of a tile's place, gradient, loss and status"
    dims = tuple(f"{name}_tile" for name in names)
    create_array(group, SUMS, tiles, tiles, dims, "int64", long_name=said)[...] = sums


ANEW = "restore it, or sample the slice again in another folder"


def check_layouts(path: Path) -> None:
    """Raise DamagedError, naming the file, where an array's layout is unreadable or contradicts the index."""
    at = path
    try:
        with _files(path) as read:
            at = path / ROOT
            root = _object(read(ROOT))
            index = root.get("consolidated_metadata", {"metadata": {}})  # copies that xarray wrote may have none
            known = index.get("metadata") if isinstance(index, dict) else None
            if not isinstance(known, dict) or not (known or "consolidated_metadata" not in root):
                raise damage(path, "the index of its arrays differs from what was written")
            for name in known or [name for name in (*SAMPLES, *AXES, "dim", "unit") if (path / name).is_dir()]:
                at = path / name / ROOT
                layout = _object(read(f"{name}/{ROOT}"))
                if layout.get("node_type") != "array" or known.get(name, layout) != layout:
                    raise damage(path / name, "its layout contradicts the store's index")
    except DamagedError:
        raise
    except Exception as error:  # a damaged zip raises anything
        raise damage(at, str(error)) from None


def check_axes(path: Path, group: zarr.Group, axes: Mapping[str, NDArray[Any]], values: Sequence[str]) -> None:
    """Raise DamagedError where a slice lacks arrays, `axes` or other `values`, or where an axis has changed."""
    wanted = {*axes, *values}
    if not wanted <= set(group.array_keys()):
        raise damage(path, f"it needs the arrays {', '.join(sorted(wanted))}")
    for name, axis in axes.items():
        if not np.array_equal(_values(path / name, group[name]), axis):
            raise damage(path / name, "it contradicts the store's identity")


def _values(path: Path, array: Any) -> NDArray[Any]:
    try:
        return np.asarray(array[...])
    except Exception as error:  # whatever a codec raises
        raise damage(path, str(error)) from None


@contextmanager
def _files(store: Path) -> Iterator[Callable[[str], bytes]]:
    """Return a reader for the files of a store, a folder or a zip, by name."""
    if store.is_file():
        with ZipFile(store) as archive:
            yield archive.read
    else:
        yield lambda name: (store / name).read_bytes()


def read_layout(store: Path) -> dict[str, Any]:
    """Return the layout of a store, a folder or a zip, with its attributes.

    Raises any error of a damaged or different file.
    """
    with _files(store) as read:
        return _object(read(ROOT))


def _object(content: bytes) -> dict[str, Any]:
    found = json.loads(content)
    if not isinstance(found, dict):
        raise TypeError("it is not a JSON object")
    return found


def is_torn(archive: Path) -> bool:
    """Whether a file is a finished slice's, empty or truncated, and does not open."""
    with archive.open("rb") as file:
        begins = file.read(64)
    try:
        return not isinstance(read_layout(archive)["attributes"], dict)
    except Exception:  # a damaged zip raises anything
        return not begins or FIRST_BYTES.match(begins) is not None


def damage(path: Path, why: str) -> DamagedError:
    """Return the error for a file of a slice that differs from what was written."""
    return DamagedError.of(path, why, ANEW)
