"""Smoothing of a slice by a Gaussian: each loss becomes a weighted mean of the samples around it."""

from __future__ import annotations

import numpy as np
import xarray as xr

from .identity import plane_of


def smooth(dataset: xr.Dataset, width: float) -> xr.Dataset:
    """Average a slice's losses by a Gaussian of standard deviation `width`, a fraction of each side of its box.

    Only existing samples count: weights outside the box and on failed samples are left out, and the others scaled to
    sum to one, so no value is invented. A failed sample stays failed. Gradients are left out. Width 0 is the slice
    itself. Raises ValueError where the width is negative.
    """
    if not width >= 0:
        raise ValueError(f"smooth takes a width of at least 0; got {width}")
    losses = dataset.drop_vars("grad", errors="ignore").transpose("v", "u", ...)
    if width == 0:
        return losses
    lower, upper = (side.numpy() for side in (plane_of(dataset).lower, plane_of(dataset).upper))
    places = [losses[name].to_numpy() for name in ("u", "v")]
    apart = [(at[:, None] - at) / (width * side) for at, side in zip(places, upper - lower, strict=True)]
    u, v = (np.exp(-(one**2) / 2) for one in apart)
    loss = losses["loss"].to_numpy()
    there = np.isfinite(loss)
    total, weight = (v @ np.where(there, part, 0.0) @ u.T for part in (loss, 1.0))
    mean = np.where(there, total / np.where(there, weight, 1.0), np.nan)
    return losses.assign(loss=losses["loss"].copy(data=mean))
