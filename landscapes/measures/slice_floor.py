"""The numerical floor of a slice: measured at a few of its samples and stored with it, or everywhere, as a map."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import islice

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..convert import from_attribute, to_attribute
from ..identity import digest_of, gradient_stride, plane_of, stored_identity
from ..objective import Evaluation, Objective, Status
from ..space import sobol
from ..statistics import Values
from .floor import MIN_POINTS, Floor, evaluate_replicas, floor_between, point_deviations, replica_cosines
from .ruggedness import span

APART = 4.0  # standard deviations from trough to peak: numerics' differences are waves (2.8), no independent draws
ATTRIBUTE = "floor"  # the attribute of a slice, and of its map, that holds the record
OF = "slice"  # the attribute of a map that says of which slice it is
SAMPLES_EACH, MOST_POINTS = 10, 16  # samples of a slice for each evaluation of a replica; points of a slice


def floor_of(dataset: xr.Dataset) -> Floor | None:
    """Read the numerical floor from a slice, None where it has none."""
    return from_attribute(Floor, dataset.attrs, ATTRIBUTE)


def floor_attribute(floor: Floor) -> dict[str, str]:
    """Return the text of the attribute in which a slice stores its numerical floor."""
    return to_attribute(ATTRIBUTE, floor)


def counted_from(floor: Floor | None) -> float:
    """Return the difference of losses that numerics alone can make [loss unit]; 0 where unknown."""
    return 0.0 if floor is None else float(np.nan_to_num(APART * floor.deviation))


def refuse_without_replicas(objective: Objective, *, refined: bool) -> None:
    """Raise ValueError where no numerical floor can be mapped: without replicas, and for a refined slice."""
    if refined:
        raise ValueError("--floor evaluates replicas at every sample; got --refine or --budget: leave out one")
    if not objective.replicas():
        raise ValueError(
            f"{objective.name} has no replicas, so its numerical floor is unknown; leave out --floor, or give it "
            "replicas that compute the same physics differently: replicas={'shifted grid': fn} in gs.from_torch "
            "and similar, or the method replicas()"
        )


def split_effort(samples: int, replicas: int) -> tuple[int, int]:
    """Return the numbers of points and of replicas to evaluate: in total about a tenth of a slice's samples.

    For a small slice these are four points and its first replicas.
    """
    budget = samples // SAMPLES_EACH
    used = min(replicas, max(1, budget // MIN_POINTS))
    return min(MOST_POINTS, max(MIN_POINTS, budget // used)), used


def find_floor(
    objective: Objective,
    dataset: xr.Dataset,
    *,
    through: Callable[[Objective], Objective] = lambda replica: replica,
    seed: int = 0,
) -> Floor | None:
    """Measure the numerical floor of a slice at a few of its samples; None where its objective has no replicas.

    The samples are those nearest to Sobol points; their own losses are the slice's. `through` wraps each replica before
    it is evaluated. Raises any error of `evaluate_replicas`.
    """
    replicas = objective.replicas()
    if not replicas:
        return None
    points, used = split_effort(int((dataset["status"] != Status.INTERPOLATED).sum()), len(replicas))
    rows = spread_samples(dataset, points, seed=seed)
    if not len(rows):
        return None
    x, whole = sample_points(dataset), evaluation_of(dataset)
    chosen = {name: through(one) for name, one in islice(replicas.items(), used)}
    own = whole.rows(torch.from_numpy(rows))
    found = evaluate_replicas(objective, x[rows], chosen, grad=own.grad is not None)
    sides = objective.space.upper - objective.space.lower
    return floor_between(own, found, sides=sides, range=span(dataset["loss"].to_numpy()), seed=seed)


def spread_samples(dataset: xr.Dataset, points: int, *, seed: int = 0) -> NDArray[np.intp]:
    """Return the numbers of at most this many samples with a loss, among those that requested a gradient.

    They are spread evenly: the nearest to Sobol points, in fractions of the plane.
    """
    from scipy.spatial.distance import cdist

    loss, asked = dataset["loss"], np.zeros(dataset["loss"].shape, bool)
    every = gradient_stride(stored_identity(dataset)) if "grad" in dataset else 1
    asked[(slice(None, None, every),) * loss.ndim] = True
    able = np.flatnonzero(asked & np.isfinite(loss.to_numpy()))
    places = np.stack(np.unravel_index(able, loss.shape), axis=1) / np.maximum(np.array(loss.shape) - 1, 1)
    chosen = list[int]()
    for apart in cdist(sobol(points, loss.ndim, seed=seed).numpy(), places):
        apart[chosen] = np.inf
        if np.isfinite(apart).any():
            chosen.append(int(apart.argmin()))
    return able[np.sort(np.array(chosen, np.intp))]


def sample_points(dataset: xr.Dataset) -> Float[Tensor, "sample dim"]:
    """Return the parameters at all samples of a slice, v before u."""
    plane = plane_of(dataset)
    return plane.grid().reshape(-1, plane.dim)


def evaluation_of(dataset: xr.Dataset) -> Evaluation:
    """Return the results at all samples of a slice, in the order of its array."""
    loss, status = dataset["loss"].to_numpy().ravel(), dataset["status"].to_numpy().ravel()
    if "grad" not in dataset:
        return Evaluation(torch.from_numpy(loss), None, torch.from_numpy(status))
    grad = dataset["grad"].transpose(*dataset["loss"].dims, "dim").to_numpy().reshape(len(loss), -1)
    unasked = (status == Status.OK) & ~np.isfinite(grad).all(axis=1)  # a loss at a sample between those with gradients
    status = np.where(unasked, np.int8(Status.NO_GRADIENT), status)
    return Evaluation(torch.from_numpy(loss), torch.from_numpy(grad), torch.from_numpy(status))


def map_floor(objective: Objective, dataset: xr.Dataset, replicas: Mapping[str, xr.Dataset]) -> xr.Dataset:
    """Return the differences between a slice and its replicas at every sample.

    It has `deviation` (v, u), the standard deviation between the losses [loss unit], and `cosine` (v, u), the median
    cosine of the replicas' gradients with the slice's, where there are gradients. It also has the losses of each
    `replica`. Its attributes identify the slice, and contain the floor over all samples.
    """
    own, found = evaluation_of(dataset), {name: evaluation_of(one) for name, one in replicas.items()}
    sides = objective.space.upper - objective.space.lower
    floor = floor_between(own, found, sides=sides, range=span(dataset["loss"].to_numpy()))
    dims, shape = dataset["loss"].dims, dataset["loss"].shape
    about = {name: dataset["loss"].attrs[name] for name in ("units",) if name in dataset["loss"].attrs}
    said = {"long_name": "standard deviation between the loss and those of its replicas", **about}
    losses = np.stack([one["loss"].to_numpy() for one in replicas.values()])
    arrays = {
        "deviation": (dims, point_deviations(own, found).numpy().reshape(shape), said),
        "loss": (("replica", *dims), losses, {"long_name": "loss of a replica", **about}),
    }
    if own.grad is not None:
        cosines = np.stack([replica_cosines(own, one, sides) for one in found.values()])
        said = {"long_name": "median cosine of the gradient with those of its replicas"}
        arrays["cosine"] = (dims, median_known(cosines).reshape(shape), said)
    axes = {str(name): dataset[name] for name in dims} | {"replica": np.array(list(replicas), object)}
    return xr.Dataset(arrays, axes, {OF: digest_of(dataset), **floor_attribute(floor)})


def median_known(values: Values) -> Values:
    """Return the median of each column without NaN; NaN for columns with nothing else."""
    found = np.full(values.shape[1], np.nan)
    known = np.isfinite(values).any(axis=0)
    found[known] = np.nanmedian(values[:, known], axis=0)
    return found
