"""Several datasets in one small file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from .files import replacing
from .records import reading


def save_bundle(path: Path, **datasets: xr.Dataset) -> None:
    """Write datasets by name, whole or not at all: the file's arrays are called DATASET/VARIABLE/DIMENSION,..."""
    arrays: dict[str, Any] = {
        f"{name}/{variable}/{','.join(map(str, array.dims))}": array.to_numpy()
        for name, dataset in datasets.items()
        for variable, array in dataset.variables.items()
    }
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)


def open_bundle(path: Path) -> dict[str, xr.Dataset]:
    """Read the datasets of a file by name."""
    found: dict[str, dict[str, Any]] = {}
    with reading(path, "delete its folder to measure it anew"), np.load(path, allow_pickle=False) as arrays:
        for key, values in arrays.items():
            name, variable, dims = key.split("/")
            found.setdefault(name, {})[variable] = (dims.split(",") if dims else [], values)
        return {name: xr.Dataset(variables) for name, variables in found.items()}
