"""A slice as the loss map over its gradient arrows (matplotlib)."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import Colormap
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from numpy.typing import NDArray

from ...identity import gradient_stride, plane_of, stored_identity
from ...large import in_unit, unit_of
from ...lattice import own_cells, with_gradients
from ...objective import Status
from ...plane import Plane
from ...space import labelled
from .. import style
from . import page
from .path import draw_path, path_scale

Grid = NDArray[np.float64]

PITCH = 6.0  # room of a map with its colour bar on a screen [inch]


def landscape_figure(
    dataset: xr.Dataset, *, floor: xr.Dataset | None = None, width: float | None = None
) -> page.Picture:
    """Draw a slice of rank 2: the loss as colours above, its negated gradients as arrows below, or next to it.

    Each cell is one sample, or for a coarse or a refined slice the part of the box nearest to it; nothing is
    interpolated. All arrows have the same length and point along steepest descent in the picture as it is seen, with
    axes scaled to the same length. Their colour is the magnitude of the gradient along the plane. Failures are hatched
    and counted. In the panel of arrows, samples with a loss and no gradient are dotted. A slice along a training shows
    its path. `floor` is the map of the slice's numerical floor, in its own panel. `width` is that of a page for print
    [mm]. Without it, as for every picture, the size suits a screen.

    Raises ValueError if the slice is a line, or if the page is too narrow or too wide.
    """
    plane = plane_of(dataset)
    if plane.rank != 2:
        raise ValueError(f"landscape_figure draws planes; got a slice of rank {plane.rank}, so use profile_figure")
    panels = 1 + ("grad" in dataset) + (floor is not None)
    picture, axes = page.panels(style.Sheet.of(width, pitch=PITCH, panels=panels), panels, share=True)
    scale = path_scale(in_unit(dataset))
    loss_panel(axes[0], in_unit(dataset), scale)
    path = draw_path(axes[0], in_unit(dataset), scale)
    if floor is not None:
        floor_panel(axes[1], dataset, floor)
    if "grad" in dataset:
        arrow_panel(axes[-1], dataset)
    for ax in axes:
        frame(ax, dataset, plane)
        page.name_outer(ax, *plane.labels)
    page.head(picture, axes[0], dataset)
    page.finish(picture, [*path, *page.sampling_key(dataset)])
    return picture


def frame(ax: Axes, dataset: xr.Dataset, plane: Plane, within: str | None = "") -> None:
    """Give a panel limits, ticks and failures; the legend counts failures with the text `within`, unless it is None."""
    if plane.rank == 2:
        ax.set(xlim=_limits(plane, 0), ylim=_limits(plane, 1), box_aspect=1)
        page.name_axes(ax, y=plane.labels[1])
    else:
        ax.set_xlim(float(plane.lower[0]), float(plane.upper[0]))
    page.dress(ax, plane)
    for kind in (*style.FAILURES, Status.MISSING):
        shade(ax, dataset, kind, None if within is None else page.lost_samples(dataset, kind, within))


def shade(ax: Axes, dataset: xr.Dataset, kind: Status, label: str | None) -> None:
    """Shade the cells, or the stretches of a line, whose samples have one status."""
    where = own_cells(dataset)["status"].to_numpy() == kind
    if not where.any():
        return
    look = style.STATUS_LOOKS[kind] | {"gid": kind.name, "label": label}
    if where.ndim == 2:
        ax.add_patch(cells_patch(*cell_edges(dataset), where, **look, zorder=1.5))
    else:
        u, look["transform"] = dataset["u"].to_numpy(), ax.get_xaxis_transform()
        ax.add_patch(cells_patch(_edges(u, u[0], u[-1]), np.array([0.0, 1.0]), where[None], **look, zorder=0.6))


def cells_patch(u: Grid, v: Grid, where: NDArray[np.bool_], **look: Any) -> PathPatch:
    """Return the outlines of the chosen cells as one patch, which is as cheap to hatch as one cell."""
    corners = [
        [(u[column], v[row]), (u[column + 1], v[row]), (u[column + 1], v[row + 1]), (u[column], v[row + 1])]
        for row, column in np.argwhere(where)
    ]
    path = Path.make_compound_path(*(Path([*corner, corner[0]], closed=True) for corner in corners))
    return PathPatch(path, antialiased=False, **look)


def loss_panel(ax: Axes, dataset: xr.Dataset, scale: style.Scale | None = None) -> None:
    """Draw the loss map and its lowest sample, by default on the slice's own scale."""
    loss_map(ax, dataset, scale or style.Scale.of_loss(dataset["loss"].to_numpy()))
    lowest_sample(ax, dataset)


def lowest_sample(ax: Axes, dataset: xr.Dataset, said: str = "lowest sample") -> None:
    """Mark the lowest sample on a map or a line, with a label."""
    loss = dataset["loss"].to_numpy()
    if not np.isfinite(loss).any():
        return
    lowest = np.nanargmin(loss)
    if loss.ndim == 2 and loss.ravel()[lowest] == np.nanmax(loss):
        ax.plot([], [], linestyle="none", label=f"every sample: {style.number(loss.ravel()[lowest])}")
        return
    place = np.meshgrid(dataset["u"], dataset["v"]) if loss.ndim == 2 else (dataset["u"].to_numpy(), loss)
    look = page.sheet_of(ax).look(style.LOWEST_MARK)
    label = f"{said}: {style.number(loss.ravel()[lowest])}"
    ax.plot(*(at.ravel()[lowest] for at in place), **look, zorder=4 if loss.ndim == 1 else 2, label=label)


def loss_map(ax: Axes, dataset: xr.Dataset, scale: style.Scale) -> None:
    """Draw every sample's loss as the colour of its cell, with a colour bar; a refined slice has unequal cells."""
    mesh = cell_map(ax, dataset, own_cells(dataset)["loss"].to_numpy(), scale, style.LOSS_MAP)
    page.colour_bar(ax, mesh, page.loss_name(dataset), scale)


def cell_map(ax: Axes, dataset: xr.Dataset, values: Grid, scale: style.Scale, colours: Colormap) -> QuadMesh:
    """Draw a value for each sample, shape (v, u), as the colour of its cell, where it is finite."""
    return ax.pcolormesh(
        *cell_edges(dataset), np.ma.masked_invalid(values), cmap=colours, norm=scale.norm, rasterized=True
    )


def floor_panel(ax: Axes, dataset: xr.Dataset, floor: xr.Dataset) -> None:
    """Draw the standard deviation between replicas at every sample; hatch samples without a loss in a replica."""
    unit = unit_of(dataset["loss"].to_numpy())
    deviation = floor["deviation"].transpose("v", "u").to_numpy() / unit
    scale = style.Scale.of_deviation(deviation)
    mesh = cell_map(ax, dataset, deviation, scale, style.FLOOR_MAP)
    page.colour_bar(ax, mesh, labelled("numerical floor", page.loss_unit(in_unit(dataset))), scale)
    lost = np.isfinite(dataset["loss"].to_numpy()) & ~np.isfinite(deviation)
    if lost.any():
        label = f"no loss in a replica: {int(lost.sum())} of {page.evaluated(dataset)}"
        look = style.STATUS_LOOKS[Status.ERROR] | {"label": label}
        ax.add_patch(cells_patch(*cell_edges(dataset), lost, **look, zorder=1.5))


def arrow_panel(ax: Axes, dataset: xr.Dataset, scale: style.Scale | None = None) -> None:
    """Draw the negated gradients as arrows, by default on the slice's own scale."""
    plane, asked = plane_of(dataset), with_gradients(dataset)
    rows, columns = (arrows_along(dataset, name) for name in ("v", "u"))
    slope = slopes(dataset)
    size, label = magnitude(slope, plane, page.loss_unit(dataset))
    flat, logarithm = size == 0, _log10(size)
    scale = scale or style.Scale.of_magnitude(logarithm)
    at = np.ix_(rows, columns)
    u, v = np.meshgrid(dataset["u"].to_numpy()[columns], dataset["v"].to_numpy()[rows])
    sides = _sides(plane)
    length = _length(u[0] / sides[0], v[:, 0] / sides[1])
    steps = length * sides * descent(slope[at], plane)
    seen = np.isfinite(logarithm[at])
    quiver = ax.quiver(
        u[seen], v[seen], steps[seen, 0], steps[seen, 1], logarithm[at][seen],
        cmap=style.SLOPE_MAP, norm=scale.norm, pivot="mid", angles="xy", scale_units="xy", scale=1.0, **style.ARROW,
        clip_on=False, in_layout=False,  # one at the border reaches half its length beyond it
    )  # fmt: skip
    bar = page.colour_bar(ax, quiver, label, scale)
    bar.ax.set_visible(bool(seen.any()))  # hidden rather than left out, so that both panels keep their width
    shade(ax, dataset, Status.NO_GRADIENT, page.lost_samples(asked, Status.NO_GRADIENT))
    if flat.any():
        look = page.sheet_of(ax).look(style.FLAT_MARK)
        said = f"gradient exactly zero: {int(flat.sum())} of {page.evaluated(asked)}"
        ax.plot(u[flat[at]], v[flat[at]], **look, zorder=2.5, label=said)


def slopes(dataset: xr.Dataset) -> Grid:
    """Return the gradients along the plane's axes, shape (v, u, 2)."""
    grad = torch.from_numpy(dataset["grad"].transpose("v", "u", "dim").to_numpy())
    found: Grid = plane_of(dataset).slope(grad).numpy()
    return found


def log_magnitude(dataset: xr.Dataset) -> Grid:
    """Return the decimal logarithm of the gradient's norm along the plane; NaN where it is zero or unknown."""
    return _log10(magnitude(slopes(dataset), plane_of(dataset), "")[0])


def _log10(size: Grid) -> Grid:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(size == 0, np.nan, np.log10(size))


def descent(slope: Grid, plane: Plane) -> Grid:
    """Return the direction of steepest descent as unit vectors in fractions of the picture's sides; NaN where flat."""
    scaled = slope
    with np.errstate(divide="ignore", invalid="ignore"):
        for sides in (_sides(plane), 1.0):  # before they count and after: no overflow, no underflow
            scaled = scaled / np.abs(scaled).max(axis=-1, keepdims=True) * sides
        direction: Grid = -scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)
    return direction


def magnitude(slope: Grid, plane: Plane, loss_unit: str) -> tuple[Grid, str]:
    """Return the norm of the gradient along the plane, and its label.

    If both axes have the same unit, it is that of the gradient's projection on the plane. Otherwise the components
    cannot be added, and the norm is per width of the box.
    """
    if len(set(plane.coordinate_units)) == 1:
        with np.errstate(over="ignore", invalid="ignore"):
            along: Grid = slope @ torch.linalg.pinv(plane.basis).T.numpy()
        unit = plane.coordinate_units[0]
        unit = f"{loss_unit or '1'}/({unit})" if "/" in unit else f"{loss_unit or '1'}/{unit}" if unit else loss_unit
    else:
        along = slope * (plane.upper - plane.lower).numpy()
        unit = f"{loss_unit or 'loss'} per width of the box"
    return _lengths(along), labelled("log₁₀ |gradient|", unit)


def _lengths(vectors: Grid) -> Grid:
    """Return the norms of vectors along the last axis, without overflow or underflow of their squares."""
    most = np.abs(vectors).max(axis=-1, keepdims=True)
    with np.errstate(over="ignore", invalid="ignore"):
        plain: Grid = np.linalg.norm(vectors, axis=-1)
        safe: Grid = most[..., 0] * np.linalg.norm(vectors / np.where(most > 0, most, 1.0), axis=-1)
    return np.where(np.isinf(plain) | (plain == 0), safe, plain)


def _limits(plane: Plane, axis: int) -> tuple[float, float]:
    low, high = plane.cell_bounds()
    return float(low[axis]), float(high[axis])


def _sides(plane: Plane) -> Grid:
    return np.diff([_limits(plane, axis) for axis in range(plane.rank)])[:, 0]


def _length(*positions: Grid) -> float:
    """Return an arrow length, in fractions of the sides, at which few arrows at these positions touch."""
    closest = min(float(np.diff(places).min()) for places in positions)
    densest = max(len(places) for places in positions)
    return min(style.LONGEST_ARROW, max(0.86 * closest, 0.45 / densest))


def cell_edges(dataset: xr.Dataset) -> tuple[Grid, Grid]:
    """Return the edges of the cells along u and v, from border to border of the picture."""
    plane = plane_of(dataset)
    u, v = (_edges(dataset[name].to_numpy(), *_limits(plane, axis)) for axis, name in enumerate("uv"))
    return u, v


def _edges(centers: Grid, low: float, high: float) -> Grid:
    return np.concatenate([[low], (centers[1:] + centers[:-1]) / 2, [high]])


def arrows_along(dataset: xr.Dataset, name: str) -> NDArray[np.intp]:
    """Return the samples along an axis that have an arrow, among those with a gradient."""
    refined = bool((dataset["status"] == Status.INTERPOLATED).any()) if "status" in dataset else False
    every = gradient_stride(stored_identity(dataset))
    return every * pick_arrows(-(-dataset.sizes[name] // every), refined=refined)


def pick_arrows(points: int, *, refined: bool = False) -> NDArray[np.intp]:
    """Return the points along an axis that keep their arrow; in a refined slice, those of its lattices."""
    step = -(-points // style.ARROWS)
    if refined:
        return cast("NDArray[np.intp]", np.arange(0, points, 1 << (step - 1).bit_length()))
    return cast("NDArray[np.intp]", np.arange((points - 1) % step // 2, points, step))
