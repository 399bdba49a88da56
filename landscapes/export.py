"""Write a slice or a run as a file for other programs: CSV, Parquet, netCDF."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import xarray as xr

from .identity import plane_of, stored_scales
from .space import LINEAR, labelled, scaled_labels, to_values
from .storage.arrays import parameters_of
from .storage.files import replacing

if TYPE_CHECKING:
    import pandas as pd

BLANK = ("\t", "\r", "\n")
FORMULA = ("=", "+", "-", "@", *BLANK)  # what a spreadsheet may take for the beginning of one
SUFFIXES = {"csv": ".csv", "parquet": ".parquet", "netcdf": ".nc"}


def save_as(dataset: xr.Dataset, path: Path, kind: str) -> None:
    """Write a slice or a run as csv, parquet or netcdf, whole or not at all.

    The first two contain `frame`; netcdf contains the dataset itself, with all its attributes. Raises ValueError for
    another `kind`.
    """
    if kind not in SUFFIXES:
        raise ValueError(f"export takes {', '.join(SUFFIXES)}; got {kind!r}")
    with replacing(path) as partial:
        if kind == "netcdf":
            dataset.to_netcdf(partial)
        elif kind == "csv":
            save_csv(frame(dataset), partial)
        else:
            frame(dataset).to_parquet(partial, index=False)


def save_csv(table: pd.DataFrame, path: Path) -> None:
    """Write a table as CSV without cells that a spreadsheet would take for formulas: words are `quoted`."""
    words = table.select_dtypes(exclude=["number", "bool"]).columns
    table = table.assign(**{name: table[name].map(quoted) for name in words})
    table.rename(columns=quoted).to_csv(path, index=False)


def quoted(cell: Any) -> Any:
    """Return a cell, after an apostrophe where a spreadsheet would take it for a formula."""
    return f"'{cell}" if isinstance(cell, str) and _is_formula(cell) else cell


def unquoted(cell: str) -> str:
    """Return a cell without the apostrophe that `quoted` has put before it."""
    return cell[1:] if cell.startswith("'") and _is_formula(cell[1:]) else cell


def _is_formula(cell: str) -> bool:
    if not cell.startswith(FORMULA):
        return False
    try:
        float(cell)  # such as -1.5
    except ValueError:
        return True
    return cell.startswith(BLANK)


def frame(dataset: xr.Dataset) -> pd.DataFrame:
    """Return a slice, a row for each sample, or a run, a row for each episode, columns named with their units.

    A slice's rows begin with the values along the plane's axes, a run's with those of the parameters. Then come the
    loss, the status in words and, if requested, the gradient's components. For a logarithmic parameter the column is
    "gradient by log10 k", per decade.
    """
    import pandas as pd

    columns = _places(dataset) if "x" not in dataset else _points(dataset)
    unit = str(dataset["loss"].attrs.get("units", ""))
    columns[labelled("loss", unit)] = dataset["loss"].to_numpy().ravel()
    for name in ("status", "kind"):
        if name in dataset:
            about, codes = dataset[name].attrs, dataset[name].to_numpy().ravel().tolist()
            words = dict(zip(about["flag_values"], str(about["flag_meanings"]).split(), strict=True))
            columns[name] = np.array([words[code] for code in codes])
    for name in ("forwards", "seconds"):
        if name in dataset:
            columns[labelled(name, str(dataset[name].attrs.get("units", "")))] = dataset[name].to_numpy()
    if "grad" in dataset:
        grad = dataset["grad"].to_numpy().reshape(-1, dataset.sizes["dim"])
        for (name, by), scale, slope in zip(parameters_of(dataset), stored_scales(dataset), grad.T, strict=True):
            per = f"{unit or '1'}/({by})" if by and scale == LINEAR else unit
            columns[labelled(f"gradient by {scaled_labels([name], [scale])[0]}", per)] = slope
    return pd.DataFrame(columns)


def _places(dataset: xr.Dataset) -> dict[str, np.ndarray]:
    """Return the values along the plane's axes at every sample, u varying fastest."""
    axes, plane = [dataset[name].to_numpy() for name in dataset["loss"].dims], plane_of(dataset)
    grid = np.stack(np.meshgrid(*axes, indexing="ij")[::-1], axis=-1).reshape(-1, plane.rank)
    return dict(zip(plane.labels, plane.to_values(torch.from_numpy(grid)).numpy().T, strict=True))


def _points(run: xr.Dataset) -> dict[str, np.ndarray]:
    """Return number and parameters of every episode."""
    values = to_values(torch.from_numpy(run["x"].to_numpy()), stored_scales(run)).numpy().T
    named = {labelled(*one): column for one, column in zip(parameters_of(run), values, strict=True)}
    return {"episode": run["episodes"].to_numpy(), **named}
