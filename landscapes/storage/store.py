"""A slice on disk: a file for each tile while it is being filled, and one file, a zarr store, when it is finished.

A slice is `loss(v, u)`, `grad(v, u, dim)` unless sampled without gradients, `status(v, u)` and the coordinates `u`,
`v`, `dim`, `unit(dim)`; a line has no `v`. It is in one of two places:

- `slice.filling` while it is being filled: a record of its identity, and a file for each tile, written whole. Samples
  are taken coarse to fine (`arrays.coarse_to_fine`), so the first tile is a coarse picture of the whole box and every
  square of tiles from it a finer one. A damaged file counts as never written.
- `slice.zarr.zip` when every point is there, with ascending axes and large chunks for analysis
  (`arrays.analysis_chunks`), so that any xarray or zarr reads it correctly. It appears whole, and only then the tiles
  are removed: a process killed at any moment leaves one or the other. Its tiles are its chunks, each with a checksum.
  It never changes: if a damaged chunk is computed again, another whole file replaces it. Earlier versions left the
  same store as a folder, `slice.zarr`, which is read in the same way.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..identity import (
    BOUNDS,
    ERROR,
    DamagedError,
    StoreError,
    StoreExistsError,
    check_identity,
    current_identity,
    current_provenance,
    full_identity,
    gradient_stride,
    with_package,
)
from ..objective import Evaluation, Objective, Status, has_loss
from ..plain import digest, plain_json
from ..plane import Plane
from ..space import ParameterSpace
from ..verification import StoredPoints, stored_evaluation, verify
from .arrays import (
    ANEW,
    AXES,
    FILES,
    FILLING_FILES,
    FORMAT,
    HEADER,
    MARK,
    ROOT,
    SAMPLES,
    Arrays,
    Chunks,
    Tile,
    Tiling,
    blank,
    damage,
    refuse_too_large,
    write_finished,
)
from .checkpoint import Checkpoint
from .files import placing, remove, replacing, resolve
from .paths import (
    archive_path,
    check_replaceable,
    filling_path,
    finished_path,
    folder_path,
    has_lost_root,
    is_slice,
    slice_path,
    slice_places,
)
from .records import read_json, reading, write_record

T = TypeVar("T")


class SliceStore:
    """Store a slice on disk tile by tile, so that a run stopped at any moment can continue.

    Make one with `create`, `open`, `open_or_create` or `in_memory`, all by the `path` of the finished slice; `place` is
    its present path. Two processes can fill the same store: a tile is the same whoever writes it, and each file appears
    whole or not at all.
    """

    def __init__(self, empty: xr.Dataset, path: Path | None = None, chunks: Chunks | None = None) -> None:
        self._verified_for: Objective | None = None  # the objective that gave a few stored points again
        self._adopt(empty, path, chunks)

    def _adopt(self, empty: xr.Dataset, path: Path | None, chunks: Chunks | None) -> None:
        """Become the empty slice, or the finished one with these chunks."""
        self.path, self._empty, self._chunks = path, empty, chunks
        self.place = path if path is None or chunks else filling_path(path)
        self._inode = self.place.stat().st_ino if self.place else None
        self.error = str(empty.attrs.get(ERROR, ""))  # what the first point that raised said
        stored = json.loads(str(empty.attrs["identity"]))
        self.identity = current_identity(stored)
        self.provenance = current_provenance(json.loads(str(empty.attrs["provenance"])), stored)
        self.plane = Plane.from_record(self.identity["plane"])
        self.dims = AXES[: self.plane.rank][::-1]
        self.tiling = Tiling(self.plane, self.every if self.grad else 0, chunks.sides if chunks else ())
        self._tiles: dict[Tile, Arrays] = {}  # what is known of a slice that is being filled, or was computed again
        # the files of what is being filled: of tiles, or of the points of a slice that is refined
        self.parts = Checkpoint(self.place, digest(self.identity)) if self.place and not chunks else None

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
        """Make an empty store at a new path in one step.

        `identity` contains the settings that decide the numbers (objective, options, fidelity, device); plane,
        parameters and gradients are added here. `provenance` is any other information to store. Both must be plain
        JSON. `overwrite` replaces a slice store without other files, and nothing else. Raises StoreExistsError where
        the path is taken, StoreError where its content is not replaced, and TooLargeError where the slice does not fit
        onto the disk or into memory.
        """
        path = _resolve(path)
        header = _header(plane, space, identity, provenance or {}, grad=grad)
        for taken in filter(Path.exists, slice_places(path)):
            if not overwrite:
                raise StoreExistsError(
                    f"{taken} already exists; write elsewhere with --out, or replace it with --force"
                )
            check_replaceable(taken)
        refuse_too_large(plane, path, grad=grad)
        try:
            with placing(filling_path(path), overwrite=overwrite) as new:
                write_record(new / HEADER, header)
        except FileExistsError as error:
            raise StoreExistsError(str(error)) from None
        archive_path(path).unlink(missing_ok=True)
        remove(folder_path(path), FILES)
        return cls.open(path)

    @classmethod
    def open(cls, path: str | Path) -> SliceStore:
        """Open an existing store, the finished slice if there is one.

        Raises StoreError where there is none, DamagedError where it differs from what was written.
        """
        path = _resolve(path)
        place = path if path.exists() else filling_path(path)
        if not place.exists():
            raise StoreError(f"there is no slice store at {path}; make one with `landscape slice`")
        if not is_slice(place):
            if has_lost_root(place):
                root = place if place.is_file() else place / (ROOT if place == path else HEADER)
                raise damage(root, "it has no identity")
            raise StoreError(f"{place} is not a slice store of format {FORMAT}; move it away or choose another folder")
        if place == path:
            return cls(*Chunks.open(path))
        with reading(place / HEADER, ANEW):
            return cls(_blank(read_json(place / HEADER)), path)

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
        """Continue the store at `path`, or make it; a store with other settings raises `StoreMismatchError`."""
        try:
            return cls.create(path, plane, space, identity=identity, provenance=provenance, grad=grad)
        except StoreExistsError:
            store = cls.open(path)
        check_identity(store.path, wanted=full_identity(identity, plane, space, grad=grad), found=store.identity)
        if store.ascending and store.path:
            store._clear_others(store.path)  # left by a process that was killed at its end
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
        return cls(_blank(_header(plane, space, identity or {}, provenance or {}, grad=grad)))

    @property
    def ascending(self) -> bool:
        """Whether this slice was complete once, and so is in its final place and order."""
        return self._chunks is not None

    @property
    def grad(self) -> bool:
        """Whether the slice has gradients."""
        return "grad" in self._empty

    @property
    def every(self) -> int:
        """The stride of the samples with gradients along each axis, in a slice that has gradients."""
        return gradient_stride(self.identity)

    @property
    def shape(self) -> tuple[int, ...]:
        """Points per axis, in array order."""
        return self.tiling.shape

    def tiles(self) -> list[Tile]:
        """Return every tile, coarse to fine."""
        return self.tiling.tiles()

    def points(self, tile: Tile) -> Float[Tensor, "points dim"]:
        """Return the parameters at the points of a tile."""
        return self.tiling.points(tile)

    def pending(self) -> list[Tile]:
        """Return the tiles that are not finished, coarse to fine."""
        finished = self._read_steadily(lambda: {tile for tile, _ in self._finished()})
        return [tile for tile in self.tiles() if tile not in finished]

    def damaged_tiles(self, pending: Sequence[Tile]) -> list[Tile]:
        """Return the unfinished tiles that were once finished: their files cannot be read."""
        written = set(self._written())
        return [tile for tile in pending if tile in written and self.read_tile(tile) is None]

    def read_tile(self, tile: Tile) -> Arrays | None:
        """Return the arrays of a finished tile, None for another one."""
        if self._chunks is not None and tile not in self._tiles:
            values = self._chunks.read(tile)
            return values if values is not None and self._is_whole(tile, values) else None
        if tile not in self._tiles and self.parts is not None:
            with contextlib.suppress(DamagedError, FileNotFoundError):
                self._tiles[tile] = self.parts.read(tile.name)
        return self._tiles.get(tile)

    def verify(self, objective: Objective) -> None:
        """Verify a slice on disk by three of its finished tiles, once for an objective.

        Raises StoreMismatchError where the objective gives other numbers.
        """
        if self.path is None or self._verified_for is objective:
            return
        left = set(self.pending())
        finished = [tile for tile in self.tiles() if tile not in left]
        chosen = sorted({0, len(finished) // 2, len(finished) - 1}) if finished else []
        read = [(tile, self.read_tile(tile)) for tile in (finished[number] for number in chosen)]
        parts = [(self.points(tile), values) for tile, values in read if values is not None]
        if parts:
            x, dim = torch.cat([x for x, _ in parts]), self.plane.dim
            found = Evaluation.join((stored_evaluation(values, dim) for _, values in parts), dim=dim, grad=self.grad)
            verify(objective, [StoredPoints(self.path, "slice", x, found, self.grad)])
        self._verified_for = objective

    def write(self, tile: Tile, evaluation: Evaluation) -> None:
        """Write a whole tile; `evaluation` has its points in the order of `points`, failures blanked.

        Raises ValueError where gradients are missing or a point was not evaluated, StoreError where the store was
        replaced.
        """
        if self.grad and evaluation.grad is None:
            raise ValueError(
                "this slice has gradients; got an evaluation without gradients, so evaluate with grad=True"
            )
        if bool((evaluation.status == Status.MISSING).any()):
            raise ValueError("a tile is written whole; got an evaluation with status MISSING")
        shape = tuple(map(len, self.tiling.rows(tile)))
        if self._follow_finished() or math.prod(shape) != len(evaluation.loss):
            return  # another process has finished the slice, which has larger and fewer tiles since
        self.keep_error(evaluation.error)
        arrays: Arrays = {}
        for name in SAMPLES:
            if name in self._empty:
                values = getattr(evaluation, name).detach().cpu().numpy()
                arrays[name] = values.reshape(shape + values.shape[1:]).astype(self._empty[name].dtype)
        if self.parts is not None:
            self.parts.save(tile.name, **arrays)
        self._tiles[tile] = arrays

    def keep_error(self, error: str) -> None:
        """Store the message of the first point that raised, as an attribute; later ones are not stored."""
        if not error or self.error:
            return
        self.error = self._empty.attrs[ERROR] = error
        if self.place is not None and not self.ascending:
            with contextlib.suppress(FileNotFoundError):  # another process has finished the slice meanwhile
                write_record(self.place / HEADER, read_json(self.place / HEADER) | {ERROR: error})

    def status(self) -> NDArray[np.int8]:
        """Return the status of every point, MISSING wherever a tile is not finished."""
        found: NDArray[np.int8] = self._read_steadily(lambda: self._collect(["status"]))["status"]
        return found

    def dataset(self) -> xr.Dataset:
        """Return everything sampled so far, axes ascending; MISSING and NaN where nothing is.

        Raises StoreError where the store was replaced.
        """
        return self._read_steadily(self._dataset)

    def finish(self, dataset: xr.Dataset) -> None:
        """Replace the tiles by the whole slice, as returned by `dataset`: ascending, in large chunks.

        It appears at once, and only then the tiles are removed. A slice that was finished before gets its recomputed
        chunks. Raises StoreError where the slice is not complete, or the store was replaced.
        """
        if self.path is None or self._follow_finished() or (self.ascending and not self._tiles):
            return
        if bool((dataset["status"] == Status.MISSING).any()):
            raise StoreError(f"{self.path} is not complete; run its sampling command again")
        archive = archive_path(self.path)
        with replacing(archive) as new:
            write_finished(new, dataset)
        self._move_on(*Chunks.written(archive, dataset))

    def coarse(self) -> xr.Dataset | None:
        """Return the largest complete coarse picture of the whole, axes ascending; None before the first.

        If the whole has gradients only at some samples, the picture has none, because it would have too few of them.
        """
        pending = self.pending()
        if not pending:
            return self.dataset()
        if not (level := 0 if self.ascending else pending[0].level):
            return None
        parts = zip(self.dims, self.tiling.order, self.tiling.sides, strict=True)
        found = self.dataset().isel({name: np.sort(order[: level * side]) for name, order, side in parts})
        return found.drop_vars("grad", errors="ignore") if self.every > 1 else found

    def _is_whole(self, tile: Tile, values: Arrays) -> bool:
        """Whether loss and gradient are finite exactly where the status says so, which is not MISSING anywhere."""
        status = values["status"]
        lacking = np.zeros(status.shape, bool)
        if "grad" in values:
            lacking = ~np.isfinite(values["grad"]).all(axis=-1) & self.tiling.sloped(tile).reshape(status.shape)
        finite, without = np.isfinite(values["loss"]), status == Status.NO_GRADIENT
        said = np.where(has_loss(status), finite & (lacking == without), ~finite)
        return bool((said & (status != Status.MISSING)).all())

    def _written(self) -> list[Tile]:
        """Return the tiles with a file."""
        if self.parts is None:
            return self.tiles() if self._chunks else list(self._tiles)
        return [tile for name in self.parts.names() if (tile := Tile.named(name)) is not None]

    def _finished(self) -> Iterator[tuple[Tile, Arrays]]:
        """Yield the finished tiles, with their arrays."""
        for tile in self._written():
            if (values := self.read_tile(tile)) is not None:
                yield tile, values

    def _collect(self, names: Sequence[str]) -> Arrays:
        """Return arrays of the whole slice, blank where nothing is sampled."""
        found: Arrays = {name: self._empty[name].to_numpy().copy() for name in names}
        for tile, values in self._finished():
            at = np.ix_(*self.tiling.rows(tile))
            for name, array in found.items():
                array[at] = values[name]
        return found

    def _dataset(self) -> xr.Dataset:
        found = self._collect([name for name in SAMPLES if name in self._empty])
        return self._empty.assign({name: self._empty.variables[name].copy(data=one) for name, one in found.items()})

    def _read_steadily(self, read: Callable[[], T]) -> T:
        """Return the result of reading, repeated if another process has finished the slice meanwhile."""
        self._follow_finished()
        found = read()
        return read() if self._follow_finished() else found

    def _follow_finished(self) -> bool:
        """Continue the finished slice if another process has finished this one meanwhile, and return whether it has.

        Raise StoreError where the store was replaced or removed.
        """
        if self.path is None or self.place is None:
            return False
        with contextlib.suppress(FileNotFoundError):
            if self.place.stat().st_ino == self._inode:
                return False
        with contextlib.suppress(StoreError):
            now = SliceStore.open(self.path)
            if now.ascending and now.path and now.identity == self.identity:
                self._move_on(*Chunks.open(now.path))
                return True
        raise StoreError(f"{self.path} was replaced or removed while it was being filled; run the command again")

    def _move_on(self, empty: xr.Dataset, path: Path, chunks: Chunks) -> None:
        """Become the finished slice, and clear away its sources."""
        self._adopt(empty, path, chunks)
        self._clear_others(path)

    @staticmethod
    def _clear_others(path: Path) -> None:
        """Remove the tiles of a finished slice, and the folder of an earlier version if it is a file now."""
        remove(filling_path(path), FILLING_FILES)
        if path != folder_path(path) and folder_path(path).is_dir():
            remove(folder_path(path), FILES)


def _resolve(path: str | Path) -> Path:
    """Return the present or future path of a finished slice, given any of its names, without links."""
    return resolve(finished_path(resolve(path)))


def open_slice(path: str | Path) -> xr.Dataset:
    """Read a slice from disk: loss and gradient in float64, axes ascending, MISSING where not yet sampled.

    `path` is the slice, or its folder from `landscape slice`. Raises StoreError where there is no slice, DamagedError
    where it differs from what was written.
    """
    return SliceStore.open(slice_path(Path(path))).dataset()


def _header(
    plane: Plane, space: ParameterSpace, identity: Mapping[str, Any], provenance: Mapping[str, Any], *, grad: bool
) -> dict[str, Any]:
    """Return the record of a new slice: its identity and provenance."""
    bounds = [space.to_values(bound).tolist() for bound in (space.lower, space.upper)]
    about = plain_json(provenance, "a slice's provenance")
    return {
        MARK: FORMAT,
        "identity": full_identity(identity, plane, space, grad=grad),
        "provenance": {**with_package(about), BOUNDS: bounds},
        "units": list(space.units),
    }


def _blank(header: Mapping[str, Any]) -> xr.Dataset:
    return blank(header["identity"], header["provenance"], header["units"], error=header.get(ERROR, ""))
