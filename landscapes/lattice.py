"""The samples of a refined slice, which is not sampled everywhere, for measures and for pictures."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray

from .identity import gradient_stride, plane_of, stored_identity
from .objective import Status
from .plane import Plane
from .space import as_stride

DRAWN = ("loss", "status")


def has_all_gradients(dataset: xr.Dataset) -> bool:
    """Whether a slice has a gradient at each of its samples, except failed ones."""
    return "grad" in dataset and gradient_stride(stored_identity(dataset)) == 1


def check_gradients(gradients: bool | int, plane: Plane, *, refined: bool) -> int:
    """Return the requested stride of gradients along each axis of a slice, 0 for none.

    Raises ValueError where it would then have fewer than two along an axis, or is refined, which needs gradients
    everywhere.
    """
    gradients = as_stride(gradients)
    if gradients > 1 and refined:
        raise ValueError(
            f"refining a slice needs the gradients of all its samples; got gradients at every {gradients} samples, so "
            "leave out one of the two"
        )
    if gradients >= min(plane.resolution):
        shape = " x ".join(map(str, plane.resolution))
        raise ValueError(
            f"a slice needs gradients at two or more samples along each axis; got {shape} samples and gradients at "
            f"every {gradients}; use at most {min(plane.resolution) - 1}, or a higher resolution"
        )
    return gradients


def count_gradients(resolution: Sequence[int], gradients: int) -> int:
    """Return the number of samples of a slice with a gradient, for a stride along each axis, 0 for none."""
    return math.prod(-(-points // gradients) for points in resolution) if gradients else 0


def with_gradients(dataset: xr.Dataset) -> xr.Dataset:
    """Return the samples of a slice that have a gradient: all, or those at the stride."""
    return dataset[_every(dataset, gradient_stride(stored_identity(dataset)))]


def sampled_lattice(dataset: xr.Dataset) -> xr.Dataset:
    """Return a slice without interpolated points: itself, or every second, fourth, eighth ... sample of it.

    A measure over neighbours needs equal distances, and must not take an interpolated value for a loss.
    """
    stride = 1
    while (dataset["status"][_every(dataset, stride)] == Status.INTERPOLATED).any():
        stride *= 2
    if stride == 1:
        return dataset
    plane, part = plane_of(dataset), dataset[_every(dataset, stride)]
    shape = tuple(part.sizes[name] for name in ("u", "v")[: plane.rank])
    upper = torch.stack([axis[stride * (count - 1)] for axis, count in zip(plane.axes(), shape, strict=True)])
    identity = json.loads(dataset.attrs["identity"]) | {"plane": replace(plane, upper=upper, resolution=shape).record()}
    return part.drop_vars("interpolated", errors="ignore").assign_attrs(identity=json.dumps(identity))


def _every(dataset: xr.Dataset, stride: int) -> dict[str, slice]:
    return {str(name): slice(None, None, stride) for name in dataset["loss"].dims}


def lift_between(plane: Plane, places: NDArray[np.float64]) -> torch.Tensor:
    """Return the parameters at positions between samples, shape (count, rank), in array steps along each axis."""
    axes = [axis.numpy() for axis in plane.axes()[::-1]]
    u = [np.interp(places[:, axis], np.arange(len(one)), one) for axis, one in enumerate(axes)][::-1]
    return plane.lift(torch.from_numpy(np.stack(u, axis=-1)))


def own_cells(dataset: xr.Dataset, kind: Status = Status.INTERPOLATED) -> xr.Dataset:
    """Return a slice for drawing: points that were not sampled have loss and status of the nearest sample.

    These are the points with a status of that `kind`, unless the slice has no samples.
    """
    lacking = dataset["status"].to_numpy() == kind if "status" in dataset else np.zeros(0, bool)
    if not lacking.any() or lacking.all():
        return dataset
    from scipy.ndimage import distance_transform_edt

    nearest = tuple(distance_transform_edt(lacking, return_distances=False, return_indices=True))
    return dataset.assign({name: dataset[name].copy(data=dataset[name].to_numpy()[nearest]) for name in DRAWN})


def sampled_line(dataset: xr.Dataset) -> xr.Dataset:
    """Return the points of a line that were evaluated."""
    return dataset.isel(u=dataset["status"].to_numpy() != Status.INTERPOLATED)
