"""Searches that the gallery keeps: a run's table in one small file."""

from __future__ import annotations

import warnings
from pathlib import Path

import xarray as xr
import zarr
from zarr.storage import ZipStore

from ..landscapes.files import replacing
from ..landscapes.identity import stored_identity, stored_provenance
from ..landscapes.layout import SMALL
from ..landscapes.records import reading
from ..optim.run import COLUMNS
from .page_data import REMAKE

FOLDER, SUFFIX = "runs", ".zarr.zip"


def save_run(table: xr.Dataset, path: Path) -> None:
    """Write a run's table as one file, whole or not at all."""
    numbers = [str(name) for name, column in table.variables.items() if column.dtype.kind in "fi"]
    encoding = {name: {"compressors": SMALL, "chunks": table[name].shape} for name in numbers}
    with replacing(path) as partial, ZipStore(partial, mode="w") as store, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr's specification has no strings yet
        table.to_zarr(store, encoding=encoding, zarr_format=3, consolidated=False)


def open_run(path: Path) -> xr.Dataset:
    """Read a run's table; raise ValueError, naming the file, where it is not what `save_run` wrote."""
    with reading(path, REMAKE.format("searches")), ZipStore(path, mode="r") as store:
        group = zarr.open_group(store, mode="r", use_consolidated=False)
        lost = [name for name, array in group.arrays() if array.nchunks_initialized < array.nchunks]
        if lost := [*lost, *(COLUMNS.keys() - set(group.array_keys()))]:
            raise ValueError(f"it lacks some of {', '.join(sorted(lost))}")
        table: xr.Dataset = xr.open_zarr(store, consolidated=False, mask_and_scale=False, decode_times=False).load()
        stored_identity(table), stored_provenance(table), table.attrs["method"], table.attrs["seed"]
    return table
