"""Searches that the gallery keeps: a run's table in one small file."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import xarray as xr
from zarr.storage import ZipStore

from ..landscapes.storage.arrays import COMPACT_CODECS
from ..landscapes.storage.files import replacing
from ..landscapes.storage.records import reading
from ..optim.runs.arrays import COLUMNS
from .files import REMAKE


def save_run(table: xr.Dataset, path: Path) -> None:
    """Write a run's table as one file, whole or not at all."""
    numbers = [str(name) for name, column in table.variables.items() if column.dtype.kind in "fi"]
    encoding = {name: {"compressors": COMPACT_CODECS, "chunks": table[name].shape} for name in numbers}
    with replacing(path) as partial, ZipStore(partial, mode="w") as store, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr's specification has no strings yet
        table.to_zarr(store, encoding=encoding, zarr_format=3, consolidated=False)


def open_run(path: Path) -> xr.Dataset:
    """Read a run's table. Raises ValueError, naming the file, where it is not what `save_run` wrote."""
    plain: Any = {"mask_and_scale": False, "decode_times": False}
    with reading(path, REMAKE.format("searches")):
        with ZipFile(path) as packed:
            if torn := packed.testzip():  # a chunk that is not found would be one of nothing but its fill value
                raise ValueError(f"{torn} in it is torn")
        with ZipStore(path, mode="r") as store:
            table: xr.Dataset = xr.open_zarr(store, zarr_format=3, consolidated=False, **plain).load()
        if lost := COLUMNS.keys() - table.variables.keys():
            raise ValueError(f"it lacks {', '.join(sorted(lost))}")
    return table


def searched(run: Mapping[str, Any], slice_: Mapping[str, Any]) -> bool:
    """Whether a run searched a slice's scene; an option that one of them was made without does not tell them apart."""
    ours, theirs = run.get("options", {}), slice_.get("options", {})
    shared = set(ours) & set(theirs)
    same = run["objective"] == slice_["objective"] and run["parameters"] == slice_["parameters"]
    return same and all(ours[name] == theirs[name] for name in shared)
