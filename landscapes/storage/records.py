"""JSON files that one command writes and another reads; an error names the damaged file."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..identity import DamagedError
from .files import replacing, write_json

if TYPE_CHECKING:
    import xarray as xr

CHECKSUM = "checksum"  # of the rest of a record, which holds it under this name
REASON_LENGTH = 160  # characters of what is wrong


@contextmanager
def reading(path: Path, todo: str) -> Iterator[None]:
    """Read a file within this context: any error from its content is reported as a damaged file.

    Raises DamagedError, with the advice `todo`; errors of missing or unreadable files pass.
    """
    try:
        yield
    except (DamagedError, FileNotFoundError, PermissionError, IsADirectoryError):
        raise
    except Exception as error:  # a file of any content makes libraries raise anything at all
        said = f"it has no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise DamagedError.of(path, said[:REASON_LENGTH] or type(error).__name__, todo) from error


def write_record(path: Path, record: Mapping[str, Any]) -> None:
    """Write a file for `read_json`, with a checksum."""
    write_json(path, sign(record))


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file, compared with its checksum if it has one.

    Raises ValueError where it is no JSON or differs from what was written, TypeError where it is no object.
    """
    return verify(json.loads(path.read_text()))


def sign(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record with its checksum."""
    return {**record, CHECKSUM: _sum(json.loads(json.dumps(record)))}


def verify(found: Any) -> dict[str, Any]:
    """Return a record without its checksum; those of earlier versions have none.

    Raises TypeError where it is not a JSON object, ValueError where the checksum does not match.
    """
    if not isinstance(found, dict):
        raise TypeError("it is not a JSON object")
    record = {name: value for name, value in found.items() if name != CHECKSUM}
    if CHECKSUM in found and found[CHECKSUM] != _sum(record):
        raise ValueError("it differs from what was written")
    return record


def _sum(record: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(record, sort_keys=True).encode())


def save_bundle(path: Path, **datasets: xr.Dataset) -> None:
    """Write datasets by name, whole or not at all: the file's arrays are called DATASET/VARIABLE/DIMENSION,..."""
    import numpy as np

    arrays: dict[str, Any] = {
        f"{name}/{variable}/{','.join(map(str, array.dims))}": array.to_numpy()
        for name, dataset in datasets.items()
        for variable, array in dataset.variables.items()
    }
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)


def open_bundle(path: Path) -> dict[str, xr.Dataset]:
    """Read the datasets of a file by name."""
    import numpy as np
    import xarray as xr

    found: dict[str, dict[str, Any]] = {}
    with reading(path, "delete its folder to measure it again"), np.load(path, allow_pickle=False) as arrays:
        for key, values in arrays.items():
            name, variable, dims = key.split("/")
            found.setdefault(name, {})[variable] = (dims.split(",") if dims else [], values)
        return {name: xr.Dataset(variables) for name, variables in found.items()}
