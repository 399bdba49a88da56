"""The numerical floor at every sample of a slice, on disk next to it: floor.zarr."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

import xarray as xr

from ..identity import digest_of
from ..measures.slice_floor import OF, floor_attribute, floor_of
from ..plain import plain_name
from .arrays import consolidate
from .files import discard, placing
from .paths import slice_path

FLOOR, FILLING = "floor.zarr", "floor.filling"  # the map, and the slices of replicas until it is there


def replica_paths(folder: Path, names: Sequence[str]) -> list[Path]:
    """Return the paths of the slices of replicas, until the map in a folder is made from them."""
    return [folder / FILLING / f"{number}-{plain_name(name)}.zarr" for number, name in enumerate(names)]


def save_floor_map(folder: Path, found: xr.Dataset) -> None:
    """Write a map whole or not at all, and clear away its sources."""
    with contextlib.suppress(FileExistsError), placing(folder / FLOOR, overwrite=True) as new:
        found.to_zarr(new, zarr_format=3, consolidated=False)
        consolidate(new)
    discard(folder / FILLING)


def open_floor_map(path: Path, dataset: xr.Dataset) -> xr.Dataset | None:
    """Return the map next to a slice, given by its store or its folder; None where there is none for this slice."""
    place = slice_path(path).parent / FLOOR
    if not place.is_dir():
        return None
    try:
        found = xr.open_zarr(place, zarr_format=3, consolidated=False).load()
    except Exception:  # a damaged map is as if it had never been written
        return None
    return found if found.attrs.get(OF) == digest_of(dataset) and floor_of(found) else None


def with_map(dataset: xr.Dataset, found: xr.Dataset | None) -> xr.Dataset:
    """Return a slice with the floor of its map, over all samples."""
    floor = floor_of(found) if found is not None else None
    return dataset if floor is None else dataset.assign_attrs(floor_attribute(floor))


def discard_floor_map(folder: Path) -> None:
    """Remove a map and its sources."""
    for name in (FLOOR, FILLING):
        discard(folder / name)
