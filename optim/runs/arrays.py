"""The arrays of a run, and what it says of itself."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr
from numpy.typing import NDArray

from ...landscapes.identity import record_parameters, with_package
from ...landscapes.objective import Status
from ...landscapes.plain import plain_json
from ...landscapes.space import ParameterSpace
from ...landscapes.storage.arrays import FILL, create_array, flags
from ...landscapes.storage.files import store_files
from ..base import Kind
from .journal import CHUNK, STATE, damage_error

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

FORMAT = 2
DEEP = ("x", "grad")
FORWARD_EQUIVALENTS = "forwards"  # what files have called it since the first run: a column, and a key of summaries
COLUMNS: dict[str, tuple[str, dict[str, Any]]] = {  # status last: a row that has one is whole
    "x": ("float64", {"long_name": "parameters, each in its own unit"}),
    "loss": ("float64", {"long_name": "loss"}),
    "grad": ("float64", {"long_name": "gradient of the loss by each parameter in its own unit"}),
    "slope": ("float64", {"long_name": "length of the gradient"}),
    "kind": ("int8", {"long_name": "what the point was evaluated for", **flags(Kind)}),
    "episodes": ("int64", {"long_name": "episodes so far"}),
    FORWARD_EQUIVALENTS: ("float64", {"long_name": "episodes so far, in episodes without gradient"}),
    "seconds": ("float64", {"long_name": "time so far", "units": "s"}),
    "status": ("int8", {"long_name": "how the evaluation ended", **flags(Status)}),
}

Columns = dict[str, NDArray[Any]]
FILES = store_files((*COLUMNS, "dim"), STATE)  # of a run on disk


def empty(rows: int, dim: int) -> Columns:
    """Return columns of so many rows, in which nothing is yet."""
    return {
        name: np.full((rows, dim) if name in DEEP else rows, FILL[dtype], dtype) for name, (dtype, _) in COLUMNS.items()
    }


def read_rows(path: Path, group: zarr.Group, name: str, rows: int, dim: int) -> NDArray[Any]:
    """Return the first rows of a column of the run at `path`.

    Raises StoreError, which names the column, where they cannot be read.
    """
    wanted = empty(0, dim)[name]
    try:
        array: Any = group[name]
        if (array.dtype, array.shape[1:], array.chunks[0]) != (wanted.dtype, wanted.shape[1:], CHUNK):
            raise ValueError("its layout is not what it was made")
        if array.shape[0] < rows:
            raise ValueError(f"it has room for {array.shape[0]} rows, and {rows} were written")
        return np.asarray(array[:rows])
    except Exception as error:  # whatever a missing array, a damaged layout or a codec raises
        raise damage_error(path / name, f"it cannot be read ({' '.join(str(error).split())})") from None


def stored_record(record: DataclassInstance) -> dict[str, Any]:
    """Return a record as files have it, in which forward equivalents go by the name they have there."""
    names = {"forward_equivalents": FORWARD_EQUIVALENTS}
    return {names.get(key, key): value for key, value in asdict(record).items()}


def plain_attributes(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's attributes as any format of files has them; what is not known yet is left out."""
    known = {name: value for name, value in attributes.items() if value is not None and name != "units"}
    return {name: json.dumps(value) if isinstance(value, dict) else value for name, value in known.items()}


def dims_of(column: str) -> tuple[str, ...]:
    """Return the names of a column's dimensions."""
    return ("evaluation", "dim") if column in DEEP else ("evaluation",)


def attributes_of(
    space: ParameterSpace, identity: Mapping[str, Any], provenance: Mapping[str, Any], budget: int
) -> dict[str, Any]:
    """Return what a run says of itself, on disk as attributes of its group."""
    box = {**record_parameters(space), "lower": space.lower.tolist(), "upper": space.upper.tolist()}
    whole = plain_json({**identity, **box}, "a run's identity")
    return {
        "gradscape_run": FORMAT,
        "env": whole.get("objective", ""),
        "method": whole.get("method", ""),
        "seed": whole.get("seed", 0),
        "budget": budget,
        "fidelity": whole.get("fidelity", ""),
        "loss_unit": str(provenance.get("loss_unit", "")),
        "units": list(space.units),
        "lower": whole["lower"],
        "upper": whole["upper"],
        "gradient_cost": None,
        "identity": whole,
        "provenance": plain_json(with_package(provenance), "a run's provenance"),
    }


def lay_out(group: zarr.Group, attributes: dict[str, Any]) -> None:
    """Make the empty arrays of a run."""
    group.attrs.update(attributes)
    budget, parameters = attributes["budget"], attributes["identity"]["parameters"]
    for name, (dtype, about) in COLUMNS.items():
        unit = {"units": attributes["loss_unit"]} if name == "loss" else {}
        deep = (len(parameters),) if name in DEEP else ()
        create_array(group, name, (budget, *deep), (CHUNK, *deep), dims_of(name), dtype, **{**about, **unit})
    axis = create_array(
        group, "dim", (len(parameters),), (len(parameters),), ("dim",), "string",
        long_name="parameter", units=attributes["units"],
    )  # fmt: skip
    axis[:] = np.array(parameters, dtype=object)
