"""A slice on disk: tiles while it is being filled, and plain ascending arrays once it is finished.

A slice is a group of arrays: `loss(v, u)`, `grad(v, u, dim)` unless sampled without gradients, `status(v, u)` and the
coordinates `u`, `v`, `dim`, `unit(dim)`; a line has no `v`. It lies in one of two places:

- `slice.filling.zarr` while it is being filled. Axes are stored coarse to fine (`tiles.coarse_to_fine`) and one chunk
  is one tile, so the first tile is a coarse picture of the whole box and every square of tiles from it a finer one.
- `slice.zarr` once every point is there. Axes ascend, and chunks are as large as analysis wants them
  (`layout.analysis_chunks`), so that anybody's xarray or zarr reads it right. It appears whole, and only then the
  tiles go: a process killed at any instant leaves one or the other.

A tile, or a chunk of a finished slice, counts when it is whole (`samples.Samples`); a torn one is as if it had never
been written.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
import xarray as xr
import zarr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from zarr.storage import MemoryStore

from ..identity import (
    ERROR,
    StoreError,
    StoreExistsError,
    check_identity,
    current_identity,
    current_provenance,
    full_identity,
    gradient_stride,
)
from ..objective import Evaluation, Status, has_loss
from ..plain import plain_json
from ..plane import Plane
from ..space import ParameterSpace
from .arrays import (
    AXES,
    FILES,
    FORMAT,
    INTERPOLATED,
    Checksums,
    Tile,
    attributes_of,
    axes_of,
    check_integrity,
    check_layouts,
    consolidate,
    damage,
    lay_out,
    open_group,
    refuse_too_large,
    text_sum,
    tile_sum,
    write_finished,
)
from .files import has_lost_root, placing, remove, resolve
from .paths import SLICE, check_replaceable, corner, filling_path, finished_path, is_slice, place_of, slice_exists

T = TypeVar("T")


class SliceStore:
    """Keep a slice on disk tile by tile, so that a run stopped at any instant can go on.

    Make one with `create`, `open`, `open_or_create` or `in_memory`, all by the `path` of the finished slice; `place` is
    where its arrays are now. Two processes may fill the same store: a tile is the same whoever writes it, and each file
    appears whole or not at all.
    """

    def __init__(self, group: zarr.Group, path: Path | None, place: Path | None) -> None:
        self.verified_for: object = None  # the objective that gave a few stored points again
        self._adopt(group, path, place)

    def _adopt(self, group: zarr.Group, path: Path | None, place: Path | None) -> None:
        arrays = dict(group.arrays())
        self.path, self.place = path, place
        self._inode = place.stat().st_ino if place else None
        self._about = attributes_of(group)
        stored = json.loads(str(self._about["identity"]))
        self.identity = current_identity(stored)
        self.provenance = current_provenance(json.loads(str(self._about["provenance"])), stored)
        self.plane = Plane.from_record(self.identity["plane"])
        self.dims = AXES[: self.plane.rank][::-1]
        self._coordinates = {name: np.asarray(arrays[name][:]) for name in self.dims}
        self._parameters, self._units = ([str(one) for one in np.asarray(arrays[name][:])] for name in ("dim", "unit"))
        self._attributes = {name: attributes_of(array) for name, array in arrays.items()}
        self._interpolated = arrays.get(INTERPOLATED)
        shape = tuple(len(self._coordinates[name]) for name in self.dims)
        sloped = [self._has_slopes(name) for name in self.dims]
        self._samples = Samples(group, shape, place, ascending=self.ascending, sloped=sloped)

    def _has_slopes(self, name: str) -> NDArray[np.bool_]:
        """Return which samples along an axis, in stored order, may have a gradient."""
        found: NDArray[np.bool_] = self._coordinates[name].argsort().argsort() % self.every == 0
        return found

    @classmethod
    def create(
        cls,
        path: str | Path,
        plane: Plane,
        space: ParameterSpace,
        *,
        identity: Mapping[str, Any],
        provenance: Mapping[str, Any] | None = None,
        grad: bool = True,
        overwrite: bool = False,
    ) -> SliceStore:
        """Make an empty store at a path where there is none, all at once.

        `identity` holds what decides the numbers (objective, options, fidelity, device); plane, parameters and
        gradients are added here. `provenance` is anything else worth keeping. Both must be plain JSON. `overwrite`
        replaces a slice store with nothing else in it, and refuses to replace anything else.

        Raises StoreExistsError where the path is taken, StoreError where what is there is not replaced, and
        TooLargeError where the slice does not fit onto the disk or into memory.
        """
        path = resolve(path)
        whole = full_identity(identity, plane, space, grad=grad)
        for taken in (path, filling_path(path)):
            if taken.exists() and not overwrite:
                raise StoreExistsError(f"{path} exists already; write elsewhere with --out, or replace it with --force")
            if taken.exists():
                check_replaceable(taken)
        refuse_too_large(plane, path, grad=grad)
        try:
            with placing(filling_path(path), overwrite=overwrite) as new:
                group = zarr.create_group(new, zarr_format=3)
                lay_out(group, plane, space, whole, plain_json(provenance or {}, "a slice's provenance"), grad=grad)
                consolidate(new)
        except FileExistsError as error:
            raise StoreExistsError(str(error)) from None
        remove(path, FILES)
        return cls.open(path)

    @classmethod
    def open(cls, path: str | Path) -> SliceStore:
        """Open a store that exists, the finished slice where there is one.

        Raises StoreError where there is none, DamagedError where it is not what was written.
        """
        path = finished_path(resolve(path))
        place = place_of(path)
        if not place.exists():
            raise StoreError(f"there is no slice store at {path}; make one with `landscape slice`")
        if not is_slice(place):
            if has_lost_root(place, FILES):
                raise damage(place / "zarr.json", "it does not say what it is of")
            raise StoreError(f"{place} is no slice store of format {FORMAT}; move it away or write elsewhere")
        try:
            group = open_group(place, "r+")
            store = cls(group, path, place)
            axes = axes_of(store.plane, store.identity["parameters"], store._units, ascending=store.ascending)
            if store._attributes["unit"].get("checksum", sums := text_sum(store._units)) != sums:
                raise damage(place / "unit", "it is not what was written")
            check_integrity(place, group, axes, ["loss", "status", *(["grad"] if store.identity["gradients"] else [])])
            return store
        except StoreError:
            raise
        except Exception as error:  # a damaged axis or layout raises whatever reads it; of tiles nothing is read here
            check_layouts(place)
            raise damage(place, f"{type(error).__name__}: {error}") from error

    @classmethod
    def open_or_create(
        cls,
        path: str | Path,
        plane: Plane,
        space: ParameterSpace,
        *,
        identity: Mapping[str, Any],
        provenance: Mapping[str, Any] | None = None,
        grad: bool = True,
    ) -> SliceStore:
        """Go on with the store at `path`, or make it; a store made by other settings raises `StoreMismatchError`."""
        try:
            return cls.create(path, plane, space, identity=identity, provenance=provenance, grad=grad)
        except StoreExistsError:
            store = cls.open(path)
        check_identity(store.path, wanted=full_identity(identity, plane, space, grad=grad), found=store.identity)
        if store.ascending and store.path:
            remove(filling_path(store.path), FILES)  # left by a process that was killed when it had finished the slice
        return store

    @classmethod
    def in_memory(
        cls,
        plane: Plane,
        space: ParameterSpace,
        *,
        identity: Mapping[str, Any] | None = None,
        provenance: Mapping[str, Any] | None = None,
        grad: bool = True,
    ) -> SliceStore:
        """Make a store that lives as long as the object.

        Raises TooLargeError where it does not fit into memory.
        """
        refuse_too_large(plane, None, grad=grad)
        group = zarr.create_group(MemoryStore(), zarr_format=3)
        whole = full_identity(identity or {}, plane, space, grad=grad)
        lay_out(group, plane, space, whole, plain_json(provenance or {}, "a slice's provenance"), grad=grad)
        return cls(group, None, None)

    @property
    def ascending(self) -> bool:
        """Whether this is a slice that was complete once, and so lies in its final place and order."""
        return self.place is not None and self.place == self.path

    @property
    def error(self) -> str:
        """What the first point that raised said; empty where none did."""
        return str(self._about.get(ERROR, ""))

    @property
    def grad(self) -> bool:
        """Whether the slice holds gradients."""
        return "grad" in self._samples.arrays

    @property
    def every(self) -> int:
        """At every how many samples along each axis there is a gradient, in a slice that holds gradients."""
        return gradient_stride(self.identity)

    @property
    def shape(self) -> tuple[int, ...]:
        """Points per axis, in array order."""
        return self._samples.shape

    def tiles(self) -> list[Tile]:
        """Return every tile, coarse to fine."""
        return self._samples.tiles()

    def pending(self, status: NDArray[np.int8] | None = None) -> list[Tile]:
        """Return the tiles that are not finished, coarse to fine; `status` spares reading it again."""
        status = self.status() if status is None else status
        return [tile for tile in self.tiles() if (status[self._samples.place(tile)] == Status.MISSING).any()]

    def damaged_tiles(self, pending: Sequence[Tile]) -> list[Tile]:
        """Return those of the tiles not finished that once were: their status is there, or torn.

        A tile that another process has finished in the meantime is none of them.
        """
        return [tile for tile in self._samples.find_written(pending) if not self.statuses(tile)]

    def read_tile(self, tile: Tile) -> dict[str, NDArray[Any]] | None:
        """Return the arrays of a tile that is finished, None of one that is not."""
        return self._samples.read_tile(tile)

    def statuses(self, tile: Tile) -> Counter[Status]:
        """Count how the points of a finished tile ended; nothing of one that is not finished."""
        values = self.read_tile(tile)
        return Counter() if values is None else Counter(map(Status, values["status"].ravel().tolist()))

    def count(self, tile: Tile) -> int:
        """Return how many points a tile has."""
        return math.prod(at.stop - at.start for at in self._samples.place(tile))

    def sloped(self, tile: Tile) -> NDArray[np.bool_]:
        """Return which points of a tile have a gradient, in the order of `points`, shape (points,)."""
        return self._samples.sloped(self._samples.place(tile)).ravel() & self.grad

    def points(self, tile: Tile) -> Float[Tensor, "points dim"]:
        """Return the parameters at the points of a tile."""
        box = zip(self.dims, self._samples.place(tile), strict=True)
        parts = [self._coordinates[name][part] for name, part in box]
        grid = np.meshgrid(*parts, indexing="ij")[::-1]
        return self.plane.lift(torch.from_numpy(np.stack([axis.ravel() for axis in grid], axis=1)))

    def write(self, tile: Tile, evaluation: Evaluation) -> None:
        """Write a whole tile, status last; `evaluation` has its points in the order of `points`, failures blanked.

        Raises ValueError where gradients are missing or a point was not evaluated, StoreError where the store was
        replaced.
        """
        shape = tuple(at.stop - at.start for at in self._samples.place(tile))
        if self.grad and evaluation.grad is None:
            raise ValueError("this slice holds gradients; got an evaluation without, so evaluate with grad=True")
        if bool((evaluation.status == Status.MISSING).any()):
            raise ValueError("a tile is written whole; got an evaluation with status MISSING")
        counts = zip(tile.index, self._samples.tile_counts, strict=True)
        if self._follow_finished() or any(at >= count for at, count in counts):
            return  # another process has finished the slice, which has larger and fewer tiles since
        self.keep_error(evaluation.error)
        arrays: Arrays = {}
        for name, stored in self._samples.arrays.items():
            tensor: Tensor = getattr(evaluation, name)
            arrays[name] = tensor.detach().cpu().numpy().reshape(shape + tensor.shape[1:]).astype(stored.dtype)
        try:
            self._samples.write_tile(tile, arrays)
        except FileNotFoundError:
            if not self._follow_finished():
                raise

    def keep_error(self, error: str) -> None:
        """Keep what the first point that raised said, as an attribute; what later ones say is not kept."""
        if not error or self.error:
            return
        self._about[ERROR] = error
        if self.place is not None and not self.ascending:
            with contextlib.suppress(FileNotFoundError):  # another process has finished the slice meanwhile
                open_group(self.place, "r+").attrs.update({ERROR: error})
                consolidate(self.place)

    def status(self) -> NDArray[np.int8]:
        """Return the status of every point in stored order, MISSING wherever a tile is not finished."""
        return self._read_steadily(lambda: self._samples.read(self._samples.whole)["status"])

    def dataset(self, known: Mapping[Tile, Mapping[str, NDArray[Any]]] | None = None) -> xr.Dataset:
        """Return everything sampled so far, axes ascending; MISSING and NaN where nothing is.

        `known` spares reading tiles again: what `read_tile` returned of them.

        Raises StoreError where the store was replaced.
        """
        return self._read_steadily(lambda: self._dataset(self._samples.whole, None if self.ascending else known))

    def finish(self, dataset: xr.Dataset) -> None:
        """Put the whole slice, which `dataset` returned, in the place of its tiles: ascending, in large chunks.

        It appears at once, and only then the tiles go.

        Raises StoreError where the slice is not complete, or the store was replaced.
        """
        if self.path is None or self.ascending or self._follow_finished():
            return
        if bool((dataset["status"] == Status.MISSING).any()):
            raise StoreError(f"{self.path} is not complete; run the command that samples it again")
        with contextlib.suppress(FileExistsError), placing(self.path, overwrite=False) as new:
            write_finished(new, dataset)
        self._move_on(self.path)

    def coarse(self) -> xr.Dataset | None:
        """Return the largest coarse picture of the whole that is complete, axes ascending; None before the first.

        It has no gradients where those of the whole are at every few samples, of which it has some alone.
        """
        pending = self.pending()
        if not pending:
            return self.dataset()
        if not (level := 0 if self.ascending else pending[0].level):
            return None
        found = self._dataset(tuple(slice(level * side) for side in self._samples.side))
        return found.drop_vars("grad", errors="ignore") if self.every > 1 else found

    def _read_steadily(self, read: Callable[[], T]) -> T:
        """Return what is read, once more where another process has finished the slice meanwhile."""
        self._follow_finished()
        found = read()
        return read() if self._follow_finished() else found

    def _follow_finished(self) -> bool:
        """Go on with the finished slice where another process has finished this one meanwhile, and say whether it has.

        Raise StoreError where the store was replaced or removed.
        """
        if self.path is None or self.place is None:
            return False
        with contextlib.suppress(FileNotFoundError):
            if self.place.stat().st_ino == self._inode:
                return False
        with contextlib.suppress(StoreError):
            if not self.ascending and SliceStore.open(self.path).identity == self.identity:
                self._move_on(self.path)
                return True
        raise StoreError(f"{self.path} was replaced or removed while it was being filled; run the command again")

    def _move_on(self, path: Path) -> None:
        """Become the finished slice, and clear the tiles away."""
        self._adopt(open_group(path, "r+"), path, path)
        remove(filling_path(path), FILES)

    def _dataset(
        self, box: tuple[slice, ...], known: Mapping[Tile, Mapping[str, NDArray[Any]]] | None = None
    ) -> xr.Dataset:
        values = self._samples.read(box, known)
        shaped = {"loss": self.dims, "grad": (*self.dims, "dim"), "status": self.dims}
        coordinates = {name: self._coordinates[name][at] for name, at in zip(self.dims, box, strict=True)}
        dataset = xr.Dataset(
            {name: (shaped[name], values[name], self._attributes[name]) for name in values},
            {name: (name, values, self._attributes[name]) for name, values in coordinates.items()},
            self._about,
        )
        if self._interpolated is not None:
            inside = np.asarray(self._interpolated[box])
            dataset[INTERPOLATED] = (self.dims, inside, self._attributes[INTERPOLATED])
        words = {"dim": self._parameters, "unit": self._units}
        named = {name: ("dim", np.array(said, object), self._attributes[name]) for name, said in words.items()}
        return dataset.assign_coords(named).sortby(list(self.dims))


def open_slice(path: str | Path) -> xr.Dataset:
    """Read a slice from disk: loss and gradient in float64, axes ascending, MISSING where it is not sampled yet.

    `path` is the slice, or the folder that `landscape slice` left it in.

    Raises StoreError where there is no slice, DamagedError where it is not what was written.
    """
    path = Path(path)
    return SliceStore.open(path / SLICE if slice_exists(path / SLICE) else path).dataset()


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
