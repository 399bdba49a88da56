"""The zarr layout of a slice; nothing else knows it.

A slice is a group of arrays: `loss(v, u)`, `grad(v, u, dim)` unless sampled without gradients, `status(v, u)` and the
coordinates `u`, `v`, `dim`; a line has no `v`. Axes are stored coarse to fine (`tiling.coarse_to_fine`) and one chunk
is one tile, so the first tile is a coarse picture of the whole box and every square of tiles from it a finer one.

A tile is finished when its chunks decode, its status has no MISSING, and loss and gradient are finite exactly where the
status is OK. Everything else, a torn file included, is as if it had never been written.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
import zarr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from zarr.storage import MemoryStore

from .files import placing
from .identity import StoreError, StoreExistsError, check_identity, full_identity, plain_json
from .integrity import check_integrity
from .layout import CODECS, SMALL, consolidate, create_array, flags
from .objective import Evaluation, Status
from .plane import Plane
from .space import ParameterSpace
from .tiling import Tile, coarse_to_fine, tile_side

FORMAT = 1
AXES = ("u", "v")


class SliceStore:
    """Keep a slice on disk tile by tile, so that a run stopped at any instant can go on.

    Make one with `create`, `open`, `open_or_create` or `in_memory`. Two processes may fill the same store: a tile is
    the same whoever writes it, and each file appears whole or not at all.
    """

    def __init__(self, group: zarr.Group, path: Path | None) -> None:
        arrays = dict(group.arrays())
        self.path = path
        self._inode = path.stat().st_ino if path else None
        self.identity: dict[str, Any] = dict(group.attrs["identity"])  # type: ignore[arg-type]
        self.provenance: dict[str, Any] = dict(group.attrs["provenance"])  # type: ignore[arg-type]
        self.plane = Plane.from_record(self.identity["plane"])
        self.dims = AXES[: self.plane.rank][::-1]
        self._values: dict[str, zarr.Array[Any]] = {
            name: arrays[name] for name in ("loss", "grad", "status") if name in arrays
        }
        self._coordinates = {name: np.asarray(arrays[name][:]) for name in self.dims}
        self._parameters = [str(name) for name in np.asarray(arrays["dim"][:])]
        self._attributes = {name: dict(array.attrs) for name, array in arrays.items()}
        self.side = self._values["status"].chunks

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

        `identity` holds what decides the numbers (objective, options, fidelity, device); plane, parameters, gradients
        and version are added here. `provenance` is anything else worth keeping. Both must be plain JSON. `overwrite`
        replaces a slice store, and refuses to replace anything else.
        """
        path = Path(path).resolve()
        whole = full_identity(identity, plane, space, grad=grad)
        if path.exists() and not overwrite:
            raise StoreExistsError(f"{path} exists already; write elsewhere with --out, or replace it with --force")
        if path.exists() and not is_slice(path):
            raise StoreError(f"{path} is no slice store, so it is not replaced; move it away or write elsewhere")
        try:
            with placing(path, overwrite=overwrite) as new:
                group = zarr.create_group(new, zarr_format=3)
                _lay_out(group, plane, space, whole, plain_json(provenance or {}, "a slice's provenance"), grad=grad)
                consolidate(new)
        except FileExistsError as error:
            raise StoreExistsError(str(error)) from None
        return cls.open(path)

    @classmethod
    def open(cls, path: str | Path) -> SliceStore:
        """Open a store that exists."""
        path = Path(path).resolve()
        if not path.exists():
            raise StoreError(f"there is no slice store at {path}; make one with `landscape slice`")
        if not is_slice(path):
            raise StoreError(f"{path} is no slice store of format {FORMAT}; move it away or write elsewhere")
        try:
            group = zarr.open_group(path, mode="r+", use_consolidated=False)
            store = cls(group, path)
            axes = {**dict(_coordinates(store.plane)), "dim": np.array(store.identity["parameters"], dtype=object)}
            check_integrity(path, group, axes, ["loss", "status", *(["grad"] if store.identity["gradients"] else [])])
            return store
        except StoreError:
            raise
        except Exception as error:  # a damaged axis or layout raises whatever reads it; of tiles nothing is read here
            raise StoreError(f"{path} is damaged ({type(error).__name__}: {error}); begin anew with --force") from error

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
        with contextlib.suppress(StoreExistsError):
            cls.create(path, plane, space, identity=identity, provenance=provenance, grad=grad)
        store = cls.open(path)
        check_identity(store.path, wanted=full_identity(identity, plane, space, grad=grad), found=store.identity)
        return store

    @classmethod
    def in_memory(
        cls, plane: Plane, space: ParameterSpace, *, identity: Mapping[str, Any] | None = None, grad: bool = True
    ) -> SliceStore:
        """Make a store that lives as long as the object."""
        group = zarr.create_group(MemoryStore(), zarr_format=3)
        _lay_out(group, plane, space, full_identity(identity or {}, plane, space, grad=grad), {}, grad=grad)
        return cls(group, None)

    @property
    def grad(self) -> bool:
        """Whether the slice holds gradients."""
        return "grad" in self._values

    @property
    def shape(self) -> tuple[int, ...]:
        """Points per axis, in array order."""
        return tuple(len(self._coordinates[name]) for name in self.dims)

    def tiles(self) -> list[Tile]:
        """Return every tile, coarse to fine."""
        counts = [math.ceil(points / side) for points, side in zip(self.shape, self.side, strict=True)]
        return sorted(map(Tile, np.ndindex(*counts)), key=lambda tile: (tile.level, sum(tile.index), tile.index))

    def pending(self, status: NDArray[np.int8] | None = None) -> list[Tile]:
        """Return the tiles that are not finished, coarse to fine; `status` spares reading it again."""
        status = self.status() if status is None else status
        return [tile for tile in self.tiles() if (status[self._place(tile)] == Status.MISSING).any()]

    def damaged(self, pending: Sequence[Tile]) -> list[Tile]:
        """Return those of the tiles not finished that once were: their status is there, or torn.

        A tile that another process has finished in the meantime is none of them.
        """
        try:
            status = np.asarray(self._values["status"][:])
            written = [tile for tile in pending if status[self._place(tile)].any()]
        except Exception:  # as in `_read`
            written = [tile for tile in pending if self._has_status(tile)]
        return [tile for tile in written if not self.statuses(tile)]

    def finished(self, tile: Tile) -> dict[str, NDArray[Any]] | None:
        """Return the arrays of a tile that is finished, None of one that is not."""
        try:
            values = self._stored(self._place(tile))
        except Exception:  # as in `_read`
            return None
        return None if (self._judged(values) == Status.MISSING).any() else values

    def statuses(self, tile: Tile) -> Counter[Status]:
        """Count how the points of a finished tile ended; nothing of one that is not finished."""
        values = self.finished(tile)
        return Counter() if values is None else Counter(map(Status, values["status"].ravel().tolist()))

    def count(self, tile: Tile) -> int:
        """Return how many points a tile has."""
        return math.prod(at.stop - at.start for at in self._place(tile))

    def points(self, tile: Tile) -> Float[Tensor, "points dim"]:
        """Return the parameters at the points of a tile."""
        parts = [self._coordinates[name][place] for name, place in zip(self.dims, self._place(tile), strict=True)]
        grid = np.meshgrid(*parts, indexing="ij")[::-1]
        return self.plane.lift(torch.from_numpy(np.stack([axis.ravel() for axis in grid], axis=1)))

    def write(self, tile: Tile, evaluation: Evaluation) -> None:
        """Write a whole tile, status last; `evaluation` has its points in the order of `points`, failures blanked."""
        place = self._place(tile)
        shape = tuple(at.stop - at.start for at in place)
        if self.grad and evaluation.grad is None:
            raise ValueError("this slice holds gradients; got an evaluation without, so evaluate with grad=True")
        if bool((evaluation.status == Status.MISSING).any()):
            raise ValueError("a tile is written whole; got an evaluation with status MISSING")
        self._check_in_place()
        for name, values in self._values.items():  # loss, grad, status
            tensor: Tensor = getattr(evaluation, name)
            values[place] = tensor.detach().cpu().numpy().reshape(shape + tensor.shape[1:]).astype(values.dtype)

    def status(self) -> NDArray[np.int8]:
        """Return the status of every point in stored order, MISSING wherever a tile is not finished."""
        return self._read(tuple(slice(points) for points in self.shape))["status"]

    def dataset(self, known: Mapping[Tile, Mapping[str, NDArray[Any]]] | None = None) -> xr.Dataset:
        """Return everything sampled so far, axes ascending; MISSING and NaN where nothing is.

        `known` spares reading tiles again: what `finished` returned of them.
        """
        return self._dataset(tuple(slice(points) for points in self.shape), known)

    def coarse(self) -> xr.Dataset | None:
        """Return the largest coarse picture of the whole that is complete, axes ascending; None before the first."""
        pending = self.pending()
        if not pending:
            return self.dataset()
        level = pending[0].level
        return self._dataset(tuple(slice(level * side) for side in self.side)) if level else None

    def _check_in_place(self) -> None:
        """Refuse to write into a store that was replaced or removed since it was opened."""
        with contextlib.suppress(FileNotFoundError):
            if self.path is None or self.path.stat().st_ino == self._inode:
                return
        raise StoreError(f"{self.path} was replaced or removed while it was being filled; run the command again")

    def _place(self, tile: Tile) -> tuple[slice, ...]:
        sizes = zip(tile.index, self.side, self.shape, strict=True)
        return tuple(slice(at * side, min((at + 1) * side, points)) for at, side, points in sizes)

    def _has_status(self, tile: Tile) -> bool:
        try:
            return bool(np.asarray(self._values["status"][self._place(tile)]).any())
        except Exception:  # as in `_read`
            return True

    def _judged(self, values: Mapping[str, NDArray[Any]]) -> NDArray[np.int8]:
        """Return the status, MISSING where it and the numbers contradict each other."""
        intact = np.isfinite(values["loss"])
        if self.grad:
            intact &= np.isfinite(values["grad"]).all(axis=-1)
        status: NDArray[np.int8] = values["status"]
        status[(status == Status.OK) != intact] = Status.MISSING
        return status

    def _read(
        self, box: tuple[slice, ...], known: Mapping[Tile, Mapping[str, NDArray[Any]]] | None = None
    ) -> dict[str, NDArray[Any]]:
        """Read a box of whole tiles, each array at once; where that fails, tile by tile, leaving out what is torn.

        Where some tiles are `known`, the others are read one by one, too.
        """
        try:
            values = self._by_tile(box, known) if known else self._stored(box)
        except Exception:  # a damaged chunk raises whatever its codec does
            values = self._by_tile(box, {})
        status = self._judged(values)
        for tile in self.tiles() if (status == Status.MISSING).any() else ():  # finished whole or not at all
            if (status[self._place(tile)] == Status.MISSING).any():
                status[self._place(tile)] = Status.MISSING
        values["loss"][status == Status.MISSING] = np.nan
        if self.grad:
            values["grad"][status == Status.MISSING] = np.nan
        return values

    def _stored(self, box: tuple[slice, ...]) -> dict[str, NDArray[Any]]:
        """Read a box of every array; where its status says that nothing is there, nothing else is looked for."""
        status = np.asarray(self._values["status"][box])
        if not status.any():
            return self._blank(box)
        return {name: status if name == "status" else np.asarray(array[box]) for name, array in self._values.items()}

    def _blank(self, box: tuple[slice, ...]) -> dict[str, NDArray[Any]]:
        shape = tuple(len(range(points)[at]) for at, points in zip(box, self.shape, strict=True))
        return {
            name: np.full(shape + array.shape[len(shape) :], array.fill_value, array.dtype)
            for name, array in self._values.items()
        }

    def _by_tile(
        self, box: tuple[slice, ...], known: Mapping[Tile, Mapping[str, NDArray[Any]]]
    ) -> dict[str, NDArray[Any]]:
        values = self._blank(box)
        for tile in self.tiles():
            place = self._place(tile)
            inside = all(at.stop <= size for at, size in zip(place, values["status"].shape, strict=True))
            if inside and (part := known.get(tile) or self.finished(tile)):
                for name, array in part.items():
                    values[name][place] = array
        return values

    def _dataset(
        self, box: tuple[slice, ...], known: Mapping[Tile, Mapping[str, NDArray[Any]]] | None = None
    ) -> xr.Dataset:
        values = self._read(box, known)
        shaped = {"loss": self.dims, "grad": (*self.dims, "dim"), "status": self.dims}
        coordinates = {name: self._coordinates[name][at] for name, at in zip(self.dims, box, strict=True)}
        dataset = xr.Dataset(
            {name: (shaped[name], values[name], self._attributes[name]) for name in values},
            {name: (name, values, self._attributes[name]) for name, values in coordinates.items()},
            {"identity": self.identity, "provenance": self.provenance},
        )
        parameters = ("dim", self._parameters, self._attributes["dim"])
        return dataset.assign_coords(dim=parameters).sortby(list(self.dims))


def pack(path: Path) -> None:
    """Rewrite a finished slice as a few small files, one chunk an array; it reads as before."""
    if SliceStore.open(path).pending():
        raise StoreError(f"{path} is not finished, so it is not packed; run the command that samples it again")
    present = zarr.open_group(path, mode="r", use_consolidated=False)
    with placing(path.resolve(), overwrite=True) as new:
        group = zarr.create_group(new, zarr_format=3, attributes=dict(present.attrs))
        for name, array in present.arrays():
            dims = tuple(str(dim) for dim in getattr(array.metadata, "dimension_names", None) or ())
            numbers = array.dtype.kind in "fi"
            kind, codecs = (array.dtype.name, SMALL) if numbers else ("string", CODECS)
            attributes: dict[str, Any] = dict(array.attrs)
            create_array(group, name, array.shape, array.shape, dims, kind, codecs=codecs, **attributes)[...] = array[:]
        consolidate(new)


def open_slice(path: str | Path) -> xr.Dataset:
    """Read a slice from disk: loss and gradient in float64, axes ascending, MISSING where it is not sampled yet."""
    return SliceStore.open(path).dataset()


def plane_of(dataset: xr.Dataset) -> Plane:
    """Return the plane that a slice was sampled on."""
    return Plane.from_record(dataset.attrs["identity"]["plane"])


def is_slice(path: Path) -> bool:
    """Say whether a slice store of this format is at `path`."""
    try:
        return zarr.open_group(path, mode="r", use_consolidated=False).attrs.get("gradscape_slice") == FORMAT
    except Exception:  # whatever else is there is none
        return False


def _lay_out(
    group: zarr.Group,
    plane: Plane,
    space: ParameterSpace,
    identity: dict[str, Any],
    provenance: dict[str, Any],
    *,
    grad: bool,
) -> None:
    names = AXES[: plane.rank][::-1]
    coordinates = dict(_coordinates(plane))
    shape = tuple(len(coordinates[name]) for name in names)
    side = tuple(tile_side(points) for points in shape)
    group.attrs.update({"gradscape_slice": FORMAT, "identity": identity, "provenance": provenance})
    loss_unit = str(provenance.get("loss_unit", ""))
    create_array(group, "loss", shape, side, names, "float64", long_name="loss", units=loss_unit)
    if grad:
        deep = (*shape, space.dim), (*side, space.dim), (*names, "dim")
        create_array(
            group, "grad", *deep, "float64", long_name="gradient of the loss by each parameter in its own unit"
        )
    create_array(group, "status", shape, side, names, "int8", long_name="how the evaluation ended", **flags(Status))
    for name, axis in coordinates.items():
        number = AXES.index(name)
        label = {"label": plane.labels[number], "long_name": plane.names[number], "units": plane.units[number]}
        create_array(group, name, axis.shape, axis.shape, (name,), "float64", **label)[:] = axis
    parameters = np.array(space.names, dtype=object)
    about = {"long_name": "parameter", "units": list(space.units)}
    create_array(group, "dim", (space.dim,), (space.dim,), ("dim",), "string", **about)[:] = parameters


def _coordinates(plane: Plane) -> Iterator[tuple[str, NDArray[np.float64]]]:
    for name, axis in zip(AXES, plane.axes(), strict=False):
        values = axis.numpy()
        yield name, values[coarse_to_fine(len(values), tile_side(len(values)))]
