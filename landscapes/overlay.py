"""Runs overlaid on a slice: plane coordinates of their points, distances from the plane, and losses of the slice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from .identity import plane_of, stored_scales
from .lattice import own_cells
from .objective import Status
from .plane import Plane

IMPROVEMENTS_OF = "improvements_of"  # attribute of a run of which only improvements are laid: how many episodes it has
RECENT = 64  # how many evaluations ago an iterate's predecessor is looked for
PARALLEL = 1e-12  # most by which the cosine between a step and the negative gradient may differ from 1


def overlay(dataset: xr.Dataset, tables: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Overlay runs on a slice of rank 2: return their tables with the plane coordinates of each point.

    Added columns over `evaluation` are: `u` and `v` [plane units], the nearest point of the plane; `distance` to it
    [half-widths of the box]; `outside`, whether it is outside the slice's picture; `beneath` [loss unit], the loss of
    the sample whose cell contains it, NaN outside and where that sample failed; `previous`, the row whose gradient led
    to this one, -1 for none; `best`, the lowest loss so far. Distances are measured in the box scaled to [-1, 1], so
    the parameters' units do not matter. The attribute `label` distinguishes runs. Raises ValueError where the slice is
    a line, or a run searched other parameters.
    """
    plane = plane_of(dataset)
    if plane.rank != 2:
        raise ValueError(f"an overlay needs a plane; got a slice of rank {plane.rank}, so vary two parameters")
    return [lay(dataset, table, label) for table, label in zip(tables, _labels(tables), strict=True)]


def lay(dataset: xr.Dataset, table: xr.Dataset, label: str) -> xr.Dataset:
    """Overlay one run on a line, where no point has a `v`, or on a plane, as `overlay` does.

    Raises ValueError where the run searched other parameters than the slice has.
    """
    plane = plane_of(dataset)
    parameters = [str(name) for name in dataset["dim"].to_numpy()]
    if parameters != [str(name) for name in table["dim"].to_numpy()]:
        raise ValueError(
            f"{label} searched {table.sizes['dim']} parameters ({_list_parameters(table)}), the slice has "
            f"{len(parameters)} ({_list_parameters(dataset)}); overlay runs on slices of the same environment"
        )
    if stored_scales(dataset) != stored_scales(table):
        raise ValueError(
            f"{label} searched parameters on the scales {', '.join(stored_scales(table))}, the slice has "
            f"{', '.join(stored_scales(dataset))}; overlay runs on slices of the same environment"
        )
    half, x = _box(table)[1], _points(table)
    scaled = replace(plane, origin=plane.origin / half, basis=plane.basis / half)
    place = scaled.project(x / half)
    low, high = plane.cell_bounds()
    outside = ((place < low) | (place > high)).any(dim=1).numpy()
    axes = dict(zip(("u", "v"), place.numpy().T, strict=False))
    columns = {
        **axes,
        "distance": scaled.distance(x / half).numpy(),
        "outside": outside,
        "beneath": np.where(outside, np.nan, _nearest(dataset, axes)),
        "previous": _previous(table),
        "best": np.fmin.accumulate(table["loss"].to_numpy()),
    }
    added = {name: ("evaluation", values) for name, values in columns.items()}
    return table.assign(added).assign_attrs(label=label)


def run_name(table: xr.Dataset, between: str = ", seed ") -> str:
    """Return a run's method and seed, or the label of points of another program, which have none."""
    method, seed = table.attrs["method"], table.attrs.get("seed")
    return f"{method}{between}{seed}" if seed is not None else str(method)


def improvements(run: xr.Dataset) -> NDArray[np.intp]:
    """Return the rows of an overlaid run that lowered its lowest loss so far, in the order of evaluation."""
    return lowered(run["best"].to_numpy())


def lowered(best: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return where the lowest loss so far has fallen; NaN means none yet."""
    before = np.append(np.inf, best[:-1])
    return np.flatnonzero(np.isfinite(best) & ~(best >= before))


def best_point(tables: Sequence[xr.Dataset]) -> tuple[Float[Tensor, " dim"], float]:
    """Return the point with the lowest loss of all runs, as `evaluate` takes it, and its loss.

    Raises ValueError where no episode succeeded.
    """
    losses = np.concatenate([table["loss"].to_numpy() for table in tables])
    if not np.isfinite(losses).any():
        raise ValueError("no episode of these runs succeeded, so there is no best point")
    row = int(np.nanargmin(losses))
    points = np.concatenate([table["x"].to_numpy() for table in tables])
    return torch.from_numpy(points[row].copy()), float(losses[row])


def principal_plane(
    tables: Sequence[xr.Dataset], *, resolution: int | Sequence[int], through: Float[Tensor, " dim"] | None = None
) -> Plane:
    """Lay a plane through the principal directions of the runs' points, found in the box scaled to [-1, 1].

    Its coordinates are in half-widths of the box. `through` moves it, parallel to itself, to contain that point. Raises
    ValueError where the points are too few, or spread in a single direction.
    """
    center, half = _box(tables[0])
    scaled = torch.cat([(_points(table) - center) / half for table in tables])
    flat = Plane.principal(scaled, resolution=resolution)
    if through is not None:
        flat = flat.shift_to((through - center) / half)
    return replace(flat, origin=center + half * flat.origin, basis=half * flat.basis)


def _nearest(dataset: xr.Dataset, axes: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the loss of the samples whose cells contain these positions, as in a picture."""
    samples = {name: dataset[name].to_numpy() for name in reversed(axes)}
    cells = tuple(np.searchsorted((at[1:] + at[:-1]) / 2, axes[name]) for name, at in samples.items())
    found: NDArray[np.float64] = own_cells(dataset)["loss"].transpose(*samples).to_numpy()[cells]
    return found


def _previous(table: xr.Dataset) -> NDArray[np.intp]:
    """Find the descents among a run's points: each iterate lies along the negative gradient of the previous one.

    Both are taken in the scaled box, where descents step; parameters that a step stopped at the border are ignored.
    """
    center, half = (part.numpy() for part in _box(table))
    z, slope = (table["x"].to_numpy() - center) / half, -table["grad"].to_numpy() * half
    found = np.full(len(z), -1)
    free = np.isfinite(slope).all(axis=1) & (slope != 0).any(axis=1)  # may be followed, once
    lacking = table["status"].to_numpy() == Status.NO_GRADIENT
    for row in np.flatnonzero(np.isfinite(slope).all(axis=1) | np.isnan(table["loss"].to_numpy()) | lacking):
        first = max(0, int(row) - RECENT)
        earlier = first + np.flatnonzero(free[first:row])
        if len(earlier) and (near := _is_aligned(z[row] - z[earlier], slope[earlier], np.abs(z[row]) < 1 - 1e-9)).any():
            found[row] = earlier[near][np.argmin(np.linalg.norm(z[row] - z[earlier[near]], axis=1))]
            free[found[row]] = False
    return found


def _is_aligned(step: NDArray[np.float64], slope: NDArray[np.float64], inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    step, slope = step[:, inside], slope[:, inside]
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (step * slope).sum(axis=1) / np.linalg.norm(step, axis=1) / np.linalg.norm(slope, axis=1)
    found: NDArray[np.bool_] = cosine > 1 - PARALLEL
    return found


def _labels(tables: Sequence[xr.Dataset]) -> list[str]:
    named = [run_name(table, "-s") for table in tables]
    seen: Counter[str] = Counter()
    labels = []
    for name in named:
        seen[name] += 1
        labels.append(f"{name}-{seen[name]}" if named.count(name) > 1 else name)
    return labels


def _box(table: xr.Dataset) -> tuple[Float[Tensor, " dim"], Float[Tensor, " dim"]]:
    """Return the middle and the half-widths of the box that a run searched."""
    lower, upper = (torch.tensor(table.attrs[side], dtype=torch.float64) for side in ("lower", "upper"))
    return (lower + upper) / 2, (upper - lower) / 2


def _points(table: xr.Dataset) -> Float[Tensor, "evaluation dim"]:
    return torch.from_numpy(table["x"].to_numpy().copy())


def _list_parameters(dataset: xr.Dataset) -> str:
    names = [str(name) for name in dataset["dim"].to_numpy()]
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
