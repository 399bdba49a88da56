"""Read what results hold on disk, with zarr, NumPy and JSON alone, so that two checkouts can be compared by it."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
from collections.abc import Container, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

Value = str | NDArray[Any]
# What is measured in seconds, or says by whom, when and with which words a result was made.
VOLATILE = {"seconds", "gradient_cost", "forwards", "batch"}
VOLATILE |= {"created", "command", "versions", "folder", "history", "source"}
VOLATILE |= {"code", "method_code", "gradscape", "model_version", "method_version"}  # some of before, some of now
VOLATILE |= {"checksum", "key"}  # of a record, which are taken of the others
TIMED = ("forward", "with_gradient", "batch")  # of the pieces of a trade-off
SECONDS = ("seconds", "forwards")  # columns of runs
RENAMED = {"longest": "max_step", "together": "batch_size", "most": "max_points"}  # options of methods, since 2026-11
EMBEDDED = ("identity", "provenance")  # attributes that may be JSON in text


def contents(folder: Path, without: Container[str] = ()) -> dict[str, Value]:
    """Return what a folder's files hold but for those named, by file and value; nothing where there is no folder."""
    found: dict[str, Value] = {}
    for path in sorted(folder.rglob("*")):
        inside = path.relative_to(folder).parts
        if path.name in without or any(part.endswith(".zarr") or part.startswith(".") for part in inside[:-1]):
            continue
        for name, value in _values(path):
            found["/".join(inside) + f" {name}"] = value
    return found


def _values(path: Path) -> Iterator[tuple[str, Value]]:
    if path.suffix == ".zarr":
        yield from _stored(path)
    elif path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as found:
            yield from ((name, found[name]) for name in found if name not in TIMED)
    elif path.suffix == ".json":
        yield from _leaves(json.loads(path.read_text()))
    elif path.suffix == ".csv":
        yield from _table(path.read_text())


def arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a store as they are on disk."""
    return {name: np.asarray(array[:]) for name, array in zarr.open_group(path, mode="r").arrays()}


def _stored(path: Path) -> Iterator[tuple[str, Value]]:
    """Yield arrays with their dimensions and attributes, but for what is measured in seconds."""
    group = zarr.open_group(path, mode="r")
    found = arrays(path)
    timed = {"seconds"} | ({"forwards"} if np.isfinite(found.get("grad", np.nan)).any() else set())
    for name, array in group.arrays():
        if name not in timed:
            yield name, found[name]
        yield f"{name} dims", f"{array.metadata.dimension_names} {array.chunks}"  # type: ignore[union-attr]
        yield from ((f"{name} {where}", value) for where, value in _leaves(array.attrs.asdict()))
    yield from ((f"attribute {where}", value) for where, value in _leaves(_decoded(group.attrs.asdict())))


def _decoded(attributes: dict[str, Any]) -> dict[str, Any]:
    return {
        name: json.loads(value) if name in EMBEDDED and isinstance(value, str) else value
        for name, value in attributes.items()
    }


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """Yield every number and word in a JSON value, with its place; numbers are written out to the last bit."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key not in VOLATILE:
                key = RENAMED.get(key, key) if "method_options" in name else key
                yield from _leaves(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list):
        yield f"{name} length", str(len(value))
        for number, inner in enumerate(value):
            yield from _leaves(inner, f"{name}[{number}]")
    else:
        yield name, json.dumps(value)


def _table(text: str) -> Iterator[tuple[str, Value]]:
    rows = list(csv.DictReader(io.StringIO(text)))
    for column in rows[0] if rows else ():
        if not column.startswith(SECONDS):
            yield column, " ".join(str(row[column]) for row in rows)


def pixels(folder: Path) -> dict[str, str]:
    """Return a digest of the pixels of every picture."""
    from matplotlib.image import imread

    return {
        str(path.relative_to(folder)): hashlib.sha256(np.ascontiguousarray(imread(path)).tobytes()).hexdigest()
        for path in sorted(folder.rglob("*.png"))
    }


def same(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Say whether two arrays have the same shape, type and bits."""
    if one.shape != other.shape or one.dtype != other.dtype:
        return False
    if one.dtype.kind in "OTU":
        return bool((one == other).all())
    return one.tobytes() == other.tobytes()


def differences(wanted: dict[str, Value], found: dict[str, Value]) -> list[str]:
    """Name what is not there, what should not be, and what has other bits."""
    differ = [f"{name} is gone" for name in wanted if name not in found]
    differ += [f"{name} is new" for name in found if name not in wanted]
    for name, one in wanted.items():
        other = found.get(name)
        if other is None:
            continue
        if isinstance(one, str) or isinstance(other, str):
            differ += [f"{name}: {_short(one)} / {_short(other)}"] if str(one) != str(other) else []
        elif not same(one, other):
            differ.append(f"{name}: {_off(one, other)}")
    return differ


def _short(value: Value) -> str:
    return str(value) if len(str(value)) < 80 else f"{str(value)[:80]}..."


def _off(one: NDArray[Any], other: NDArray[Any]) -> str:
    """Say by how much arrays differ."""
    if one.shape != other.shape or one.dtype != other.dtype:
        return f"{one.shape} {one.dtype} / {other.shape} {other.dtype}"
    if one.dtype.kind != "f":
        return f"{int((one != other).sum())} of {one.size} differ"
    equal = (one == other) | (np.isnan(one) & np.isnan(other))
    largest = float(np.nanmax(np.abs(one - other)[~equal], initial=0.0))
    return f"{math.prod(one.shape) - int(equal.sum())} of {one.size} differ, by up to {largest:.3g}"
