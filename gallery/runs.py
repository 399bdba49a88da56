"""Searches that the gallery keeps: a run's table in one small file."""

from __future__ import annotations

import warnings
from pathlib import Path

import xarray as xr
from zarr.storage import ZipStore

from ..landscapes.files import replacing
from ..landscapes.layout import SMALL

FOLDER, SUFFIX = "runs", ".zarr.zip"


def save_run(table: xr.Dataset, path: Path) -> None:
    """Write a run's table as one file, whole or not at all."""
    numbers = [str(name) for name, column in table.variables.items() if column.dtype.kind in "fi"]
    encoding = {name: {"compressors": SMALL, "chunks": table[name].shape} for name in numbers}
    with replacing(path) as partial, ZipStore(partial, mode="w") as store, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr's specification has no strings yet
        table.to_zarr(store, encoding=encoding, zarr_format=3, consolidated=False)


def open_run(path: Path) -> xr.Dataset:
    """Read a run's table."""
    with ZipStore(path, mode="r") as store:
        table: xr.Dataset = xr.open_zarr(
            store, zarr_format=3, consolidated=False, mask_and_scale=False, decode_times=False
        ).load()
    return table
