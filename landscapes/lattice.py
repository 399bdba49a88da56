"""What is taken of a refined slice, which is not sampled everywhere: for measures, and for pictures."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray

from .identity import plane_of, stored_identity
from .objective import Status
from .plane import Plane

DRAWN = ("loss", "status")


def sampled_lattice(dataset: xr.Dataset) -> xr.Dataset:
    """Return a slice without points that are interpolated: itself, or every second, fourth, eighth ... sample of it.

    A measure over neighbours takes them to be equally far apart, and nothing that is interpolated to be a loss.
    """
    stride = 1
    while (dataset["status"][_every(dataset, stride)] == Status.INTERPOLATED).any():
        stride *= 2
    if stride == 1:
        return dataset
    plane, part = plane_of(dataset), dataset[_every(dataset, stride)]
    shape = tuple(part.sizes[name] for name in ("u", "v")[: plane.rank])
    upper = torch.stack([axis[stride * (count - 1)] for axis, count in zip(plane.axes(), shape, strict=True)])
    identity = stored_identity(dataset) | {"plane": replace(plane, upper=upper, resolution=shape).record()}
    return part.drop_vars("interpolated", errors="ignore").assign_attrs(identity=json.dumps(identity))


def _every(dataset: xr.Dataset, stride: int) -> dict[str, slice]:
    return {str(name): slice(None, None, stride) for name in dataset["loss"].dims}


def lift_between(plane: Plane, places: NDArray[np.float64]) -> torch.Tensor:
    """Return the parameters at places between samples, shape (count, rank), in steps along each axis of the array."""
    axes = [axis.numpy() for axis in plane.axes()[::-1]]
    u = [np.interp(places[:, axis], np.arange(len(one)), one) for axis, one in enumerate(axes)][::-1]
    return plane.lift(torch.from_numpy(np.stack(u, axis=-1)))


def own_cells(dataset: xr.Dataset) -> xr.Dataset:
    """Return a slice as it is drawn: where it was not sampled it has loss and status of the nearest sample."""
    from scipy.ndimage import distance_transform_edt

    lacking = dataset["status"].to_numpy() == Status.INTERPOLATED if "status" in dataset else np.zeros(0, bool)
    if not lacking.any():
        return dataset
    nearest = tuple(distance_transform_edt(lacking, return_distances=False, return_indices=True))
    return dataset.assign({name: dataset[name].copy(data=dataset[name].to_numpy()[nearest]) for name in DRAWN})


def sampled_line(dataset: xr.Dataset) -> xr.Dataset:
    """Return the points of a line that were evaluated."""
    return dataset.isel(u=dataset["status"].to_numpy() != Status.INTERPOLATED)
