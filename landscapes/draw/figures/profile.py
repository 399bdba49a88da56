"""A line through a landscape as a profile: loss, gradient, and changes of events (matplotlib)."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import torch
import xarray as xr
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray

from ...identity import plane_of
from ...large import LARGEST, in_unit, unit_of
from ...lattice import sampled_line, with_gradients
from ...objective import Status
from ...plane import Plane
from ...space import labelled
from .. import style
from . import contour, page

LOSS, FLOOR, SLOPE = 2.6, 1.4, 2.2  # height of the panels [inch]
ROOM = 1.1  # of the numerical floor, against its largest value
STRIP = 2.7  # height of a strip of event counts, in that of its type


def profile_figure(
    dataset: xr.Dataset,
    *,
    events: Mapping[str, ArrayLike] | None = None,
    floor: xr.Dataset | None = None,
    width: float | None = None,
) -> page.Picture:
    """Draw a slice of rank 1: the loss above, and below it the derivative along the line with central differences.

    `events` maps a name to a whole number per point, for example the number of bounces. Each is a strip on top,
    labelled where labels fit, with a thin line through the panels wherever it changes. Failures are hatched and
    counted. `floor` is the map of the slice's numerical floor, in its own panel between the two.

    Raises ValueError if the slice is a plane, or if the page is too narrow or too wide.
    """
    plane = plane_of(dataset)
    if plane.rank != 1:
        raise ValueError(f"profile_figure draws lines; got a slice of rank {plane.rank}, so use landscape_figure")
    unit, dataset = unit_of(dataset["loss"].to_numpy()), in_unit(dataset)
    counted = {name: _counts(name, values, dataset.sizes["u"]) for name, values in (events or {}).items()}
    places, whole, dataset = dataset["u"].to_numpy(), dataset, sampled_line(dataset)
    sheet = style.Sheet.of(width, pitch=page.LINE_PITCH)
    shown = [LOSS, *[FLOOR] * (floor is not None), *[SLOPE] * ("grad" in dataset)]
    heights = [STRIP * sheet.small / 72] * len(counted) + [max(page.FLATTEST, sheet.zoom) * one for one in shown]
    picture, axes = page.stack(sheet, heights)
    strips, panels = axes[: len(counted)], axes[len(counted) :]
    _draw_loss(panels[0], dataset)
    if floor is not None:
        _draw_floor(panels[1], whole, floor["deviation"].to_numpy() / unit)
    if "grad" in dataset:
        _draw_slope(panels[-1], dataset, plane)
    for ax in panels:
        contour.frame(ax, dataset, plane)
    for strip, (name, counts) in zip(strips, counted.items(), strict=True):
        _draw_strip(strip, panels, places, name, counts)
    page.name_axes(panels[-1], plane.labels[0])
    picture.align_ylabels(panels)
    page.head(picture, axes[0], whole)
    page.finish(picture, page.sampling_key(whole))
    return picture


def _counts(name: str, values: ArrayLike, points: int) -> NDArray[np.int64]:
    counts = np.asarray(values)
    if counts.shape != (points,) or not np.issubdtype(counts.dtype, np.integer):
        raise ValueError(
            f"event {name!r} needs {points} whole numbers, one per point; got {counts.dtype} of shape {counts.shape}"
        )
    return counts.astype(np.int64)


def _draw_loss(ax: Axes, dataset: xr.Dataset) -> None:
    u = dataset["u"].to_numpy()
    ax.plot(u, dataset["loss"], color=style.LOSS_LINE, **page.sheet_of(ax).look(style.stroke(len(u))))
    page.name_axes(ax, y=page.loss_name(dataset))
    contour.lowest_sample(ax, dataset)


def _draw_floor(ax: Axes, dataset: xr.Dataset, deviation: NDArray[np.float64]) -> None:
    """Draw the standard deviation between replicas at every sample, on an axis from 0."""
    u = dataset["u"].to_numpy()
    ax.plot(u, deviation, color=style.INK, **page.sheet_of(ax).look(style.stroke(len(u))))
    most = np.nanmax(deviation, initial=0.0)
    ax.set_ylim(0, ROOM * most if most > 0 else 1)
    page.name_axes(ax, y=labelled("numerical floor", page.loss_unit(dataset)))


def _draw_slope(ax: Axes, dataset: xr.Dataset, plane: Plane) -> None:
    u, loss, asked = dataset["u"].to_numpy(), dataset["loss"].to_numpy(), with_gradients(dataset)
    slopes = plane.slope(torch.from_numpy(asked["grad"].to_numpy())).numpy()[:, 0]
    slope, differences = (np.where(np.abs(one) > LARGEST, np.nan, one) for one in (slopes, _differences(u, loss)))
    low, high = style.span_of_line(slope, differences)
    ax.set_ylim(low, high)
    ax.axhline(0, color=style.FAINT, linewidth=0.8, zorder=0.5)
    said = [
        name + (f" ({off} off scale)" if (off := int(((values < low) | (values > high)).sum())) else "")
        for name, values in (("gradient", slopes), ("central difference of the loss", differences))
    ]
    sheet = page.sheet_of(ax)
    behind, line = sheet.look({"color": style.QUIET, "linewidth": 0.7}), sheet.look(style.stroke(len(slope)))
    ax.plot(u, differences, **behind, label=said[1])
    ax.plot(asked["u"], slope, color=style.SLOPE_LINE, **line, label=said[0])
    page.name_axes(ax, y=_slope_label(plane, page.loss_unit(dataset)))
    contour.shade(ax, dataset, Status.NO_GRADIENT, page.lost_samples(asked, Status.NO_GRADIENT))


def _differences(u: NDArray[np.float64], loss: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the slope of the parabola through each three samples, evenly spaced or not; NaN at the ends."""
    found = np.full_like(u, np.nan)
    before, after = np.diff(u)[:-1], np.diff(u)[1:]
    with np.errstate(over="ignore"):
        rises = np.diff(loss) / np.diff(u)
    found[1:-1] = (rises[:-1] * after + rises[1:] * before) / (before + after)
    return found


def _slope_label(plane: Plane, loss_unit: str) -> str:
    unit = plane.coordinate_units[0]
    per = f"({unit})" if "/" in unit else unit
    named = f"{loss_unit or '1'}/{per}" if unit else loss_unit
    return labelled("slope of the loss", named)


def _draw_strip(strip: Axes, panels: list[Axes], u: NDArray[np.float64], name: str, counts: NDArray[np.int64]) -> None:
    """Shade stretches of equal count, label them where the label fits, and mark their borders."""
    sheet = page.sheet_of(strip)
    meets = np.flatnonzero(np.diff(counts)) + 1
    edges = [u[0], *((u[meets] + u[meets - 1]) / 2).tolist(), u[-1]]
    labels = counts[[0, *meets.tolist()]].tolist()
    for number, ((low, high), label) in enumerate(zip(pairwise(edges), labels, strict=True)):
        strip.axvspan(low, high, color=style.BAND[number % 2], linewidth=0)
        room = (high - low) / (u[-1] - u[0]) * (sheet.width - page.LINE_ROOM * sheet.type)
        if room > page.text_width(str(label), sheet.small) + sheet.small / 72:
            strip.text((low + high) / 2, 0.5, str(label), size=sheet.small, color=style.INK, ha="center", va="center")
    for edge in edges[1:-1]:
        for ax in panels:
            ax.axvline(edge, color=style.FAINT, linewidth=sheet.weight * style.hairline_width(len(meets)), zorder=0.7)
    strip.set_ylim(0, 1)
    strip.set_yticks([])
    strip.tick_params(bottom=False, labelbottom=False)
    strip.spines[:].set_visible(False)
    strip.set_ylabel(name, size=sheet.small, rotation=0, ha="right", va="center", parse_math=False)
