"""Integrity of a slice on disk: its layout is stored twice, and its axes follow from its identity.

A copy that xarray wrote (`Dataset.to_zarr`) has its layout once; its axes are held against its identity all the same.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from ..identity import DamagedError

ANEW = "restore it, or sample the slice anew in another folder"


def check_integrity(path: Path, group: zarr.Group, axes: Mapping[str, NDArray[Any]], values: Sequence[str]) -> None:
    """Raise DamagedError, naming the file, where a slice store's layout or axes are not what they were made.

    `axes` hold what its coordinates must be, in stored order; `values` name the other arrays. Chunks of those have
    checksums, and are looked at when they are read.
    """
    wanted, found = {*axes, *values}, set(group.array_keys())
    known = _index(path)
    if not wanted <= found or known.keys() not in (set(), found):
        raise damage(path, f"it needs the arrays {', '.join(sorted(wanted))} and an index of them")
    for name, layout in known.items():
        if _read(path / name) != layout:
            raise damage(path / name, "its layout is not what the store's index says")
    for name, axis in axes.items():
        if not np.array_equal(_values(path / name, group[name]), axis):
            raise damage(path / name, "it is not what the store's identity says")


def check_layouts(path: Path) -> None:
    """Raise DamagedError, naming the file, where what says how an array is stored cannot be read."""
    for folder in sorted(one for one in path.iterdir() if one.is_dir()):
        if _read(folder).get("node_type") != "array":
            raise damage(folder / "zarr.json", "it does not say how an array is stored")


def _index(path: Path) -> dict[str, Any]:
    """Return the layout of every array as the store's index has it, nothing where it has no index."""
    root = _read(path)
    if "consolidated_metadata" not in root:
        return {}
    index = root["consolidated_metadata"]
    known = index.get("metadata") if isinstance(index, dict) else None
    if not isinstance(known, dict) or not known:
        raise damage(path, "the index of its arrays is not what it was made")
    return known


def _values(path: Path, array: Any) -> NDArray[Any]:
    try:
        return np.asarray(array[...])
    except Exception as error:  # whatever a codec raises
        raise damage(path, str(error)) from None


def _read(folder: Path) -> dict[str, Any]:
    path = folder / "zarr.json"
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise damage(path, str(error)) from None
    if not isinstance(found, dict):
        raise damage(path, "it is no JSON object")
    return found


def damage(path: Path, why: str) -> DamagedError:
    """Return what to raise for a file of a slice that is not what was written."""
    return DamagedError.of(path, why, ANEW)
