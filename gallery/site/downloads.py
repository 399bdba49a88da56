"""Downloads: the data of a picture as CSV, and that of a slice also as zarr."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from ...landscapes.export import frame, quoted, save_csv
from ...landscapes.identity import plane_of
from ...landscapes.storage.arrays import write_finished
from ...landscapes.storage.paths import is_finished
from ..files import CSV, ZARR


def save_slice(dataset: xr.Dataset, store: Path, folder: Path) -> list[str]:
    """Write a slice as CSV and, from its finished store, as one zarr file; return their names.

    The CSV has a row for each sample: its position, loss and status. With gradients it also has the slope of the loss
    along each axis and the gradient norm over all parameters. An unfinished slice has no zarr file.
    """
    table = frame(dataset.drop_vars("grad", errors="ignore"))
    for name, column in _slopes(dataset).items():
        table[name] = column
    exact = table.select_dtypes(float).columns  # digits of single precision say all there is
    save_csv(table.astype(dict.fromkeys(exact, np.float32)), folder / CSV)
    if not is_finished(store):
        return [CSV]
    write_finished(folder / ZARR, dataset)
    return [CSV, ZARR]


def _slopes(dataset: xr.Dataset) -> dict[str, np.ndarray[Any, Any]]:
    if "grad" not in dataset:
        return {}
    plane = plane_of(dataset)
    grad = dataset["grad"].to_numpy().reshape(dataset["loss"].size, -1)
    along = plane.slope(torch.from_numpy(grad)).numpy().T
    slopes = {f"slope along {label}": column for label, column in zip(plane.scaled_labels, along, strict=True)}
    return {**slopes, "length of the gradient in all dimensions": np.linalg.norm(grad, axis=1)}


def save_table(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write records as CSV, one row each; a nested field has its own column, named by both fields."""
    flat = [{quoted(name): quoted(cell) for name, cell in _flatten(row)} for row in rows]
    columns = list(dict.fromkeys(name for row in flat for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(flat)


def _flatten(row: Mapping[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in row.items():
        said = f"{within} {name}".strip()
        if isinstance(value, Mapping):
            yield from _flatten(value, said)
        elif isinstance(value, list | tuple):
            yield said, "; ".join(map(str, value))
        else:
            yield said, "" if value is None else value
