"""Losses so large that their differences overflow: a slice of them is drawn in its own unit."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

LARGE = 1e200  # from where on losses have a unit of their own
LARGEST = 1e300  # of what is drawn or measured as it is: room is needed for differences, and for sums of them
SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def unit_of(loss: NDArray[Any]) -> float:
    """Return the divisor that makes differences of losses finite: 1 unless they are large."""
    most = _largest(loss)
    return 10.0 ** math.floor(math.log10(most)) if most > LARGE else 1.0


def in_unit(dataset: xr.Dataset) -> xr.Dataset:
    """Return a slice with losses and gradients divided by that unit, which their own unit then includes."""
    unit = unit_of(dataset["loss"].to_numpy())
    if unit == 1.0:
        return dataset
    exponent = str(round(math.log10(unit))).translate(SUPERSCRIPTS)
    names = [name for name in ("loss", "grad") if name in dataset]
    scaled = {name: (dataset[name] / unit).assign_attrs(dataset[name].attrs) for name in names}
    scaled["loss"].attrs["units"] = f"10{exponent} {dataset['loss'].attrs.get('units', '')}".strip()
    return dataset.assign(scaled)


def refuse_large(values: NDArray[Any]) -> None:
    """Raise ValueError for values whose differences and sums can overflow."""
    if (most := _largest(values)) > LARGEST:
        raise ValueError(
            f"values up to {most:.3g} cannot be measured or drawn, because their differences overflow; divide the "
            "loss by a constant"
        )


def _largest(values: NDArray[Any]) -> float:
    known = np.abs(values[np.isfinite(values)])
    return float(known.max()) if known.size else 0.0
