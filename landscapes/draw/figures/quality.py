"""Gradient quality over a slice: cosines with finite differences by scale, and first against zeroth order."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.patches import Patch

from ...identity import gradient_stride, plane_of, stored_identity
from ...lattice import with_gradients
from ...measures.gradient_quality import GradientQuality, disagreement, find_bias, scale_table
from ...measures.ruggedness import box_slopes
from .. import style
from . import contour, page

PITCH, MIN_PANEL = 4.4, 40.0  # room of a panel: on a screen [inch], and at least in print [mm]
BELOW = 2.0  # room of a panel that has its colour bar under it [inch]
FLAT = 0.3  # height of the line's panel, against its width
LINE, SCALES, ORDERS = "line", "scales", ("narrow", "wide")


def quality_figure(dataset: xr.Dataset, quality: GradientQuality, *, width: float | None = None) -> page.Picture:
    """Draw gradient quality: first over the slice's own samples, then by scale and under smoothing.

    Panels with the same quantity and colours share a colour bar, next to the last of them. On a narrow page the panels
    are in pairs, because six of them in a column would be higher than a printed page.

    Raises ValueError if the page is too narrow or too wide.
    """
    plane, samples = plane_of(dataset), quality.samples
    sheet = style.Sheet.of(width, pitch=PITCH, columns=3, least=MIN_PANEL)
    maps = [str(number) for number in range(samples.sizes["scale"])] if plane.rank == 2 else []
    rows = _rows([*maps, SCALES, *ORDERS], sheet.columns)
    if plane.rank == 1:
        rows = [[LINE] * sheet.columns, *rows]
    picture = page.Picture(sheet, len(rows) * sheet.pitch)
    mosaic: Any = rows
    axes: dict[str, Axes] = picture.subplot_mosaic(mosaic)
    if plane.rank == 1:
        _slope_lines(axes[LINE], dataset)
    for number, name in enumerate(maps):
        _cosine_map(axes[name], dataset, samples.isel(scale=number), last=name == maps[-1])
    _scales(axes[SCALES], quality.steps, samples)
    for number, name in enumerate(ORDERS):
        draw = _disagreement_map if plane.rank == 2 else _two_orders
        draw(axes[name], dataset, quality.smooth, number)
    for kind in (maps, ORDERS):
        _share_names(axes, rows, kind)
    page.entitle(picture, f"{page.title(dataset)}: gradient quality")
    more: list[Artist] = [page.sign(sheet, "first order is significantly biased (p < 0.001)", style.BIASED)]
    if plane.rank == 2:
        more.append(Patch(**style.NO_SLOPE, label="no slope above the noise, or too close to the border"))
    page.finish(picture, more, columns=3, heading=page.provenance(dataset))
    return picture


def _rows(names: Sequence[str], columns: int) -> list[list[str]]:
    """Arrange panels in rows, with blanks after the last one."""
    padded = [*names, *["."] * (-len(names) % columns)]
    return [list(padded[start : start + columns]) for start in range(0, len(padded), columns)]


def _share_names(axes: dict[str, Axes], rows: Sequence[Sequence[str]], kind: Sequence[str]) -> None:
    """Keep the label and numbers of the vertical axis once for panels of a kind side by side."""
    for row in rows:
        for left, name in pairwise(row):
            if left in kind and name in kind and axes[left].get_ylim() == axes[name].get_ylim():
                page.name_axes(axes[name], y="")
                axes[name].tick_params(labelleft=False)


def _cosine_map(ax: Axes, dataset: xr.Dataset, found: xr.Dataset, *, last: bool) -> None:
    """Draw the cosines with differences over one scale, in cells as wide as the spacing of gradients."""
    plane, some, every = plane_of(dataset), with_gradients(dataset), gradient_stride(stored_identity(dataset))
    cosine = found["cosine"].to_numpy()[::every, ::every]
    ax.set_facecolor(style.NO_SLOPE["facecolor"])
    drawn = ax.pcolormesh(*contour.cell_edges(some), np.ma.masked_invalid(cosine), rasterized=True, **style.COSINE)
    contour.frame(ax, dataset, plane)
    page.name_axes(ax, plane.labels[0])
    seen = cosine[np.isfinite(cosine)]
    mean = f"mean cosine {style.number(float(seen.mean()), '.2f')}" if seen.size else "none above the noise"
    page.caption(ax, f"differences over {_percent(found['scale'])} of the box\n{mean}")
    if last:
        _bar(ax, drawn, "cosine of gradient and difference")


def _bar(ax: Axes, drawn: ScalarMappable, label: str) -> None:
    """Put a colour bar next to a panel, or under it if space is short."""
    below: dict[str, Any] = {"location": "bottom", "fraction": 0.06, "pad": 0.04}
    page.colour_bar(ax, drawn, label, **(below if page.sheet_of(ax).pitch < BELOW else {}))


def _slope_lines(ax: Axes, dataset: xr.Dataset) -> None:
    plane, u = plane_of(dataset), dataset["u"].to_numpy()
    slope, loss = box_slopes(dataset)[:, 0], dataset["loss"].to_numpy()
    difference = np.full_like(loss, np.nan)
    difference[1:-1] = (loss[2:] - loss[:-2]) * (len(loss) - 1) / 2
    look = page.sheet_of(ax).look(style.stroke(len(u)))
    ax.plot(u, difference, color=style.LOSS_LINE, **look, label="difference over two samples")
    ax.plot(u, slope, color=style.SLOPE_LINE, **look, label="gradient", alpha=0.8)
    ax.set_box_aspect(FLAT)
    contour.frame(ax, dataset, plane)
    ax.set_ylim(*style.span_of_line(difference, slope))
    page.name_axes(ax, plane.labels[0], _slope_label(dataset))


def _scales(ax: Axes, steps: xr.Dataset, samples: xr.Dataset) -> None:
    """Draw the mean cosine and the share of uphill gradients against the scale of the difference."""
    sheet = page.sheet_of(ax)
    for found, where in ((steps, "new evaluations"), (samples, "the slice's samples")):
        rows = [row for row in scale_table(found) if row.points]
        for name, colour, marker in (("mean cosine", style.LOSS_LINE, "o"), ("uphill", style.SLOPE_LINE, "v")):
            ends = page.ends_of(row.uphill if name == "uphill" else row.cosine for row in rows)
            reach = np.abs(np.nan_to_num(ends[:, 1:] - ends[:, :1])).T
            look: dict[str, Any] = {
                "color": colour,
                "marker": marker,
                "markerfacecolor": colour if found is steps else "white",
            }
            look |= sheet.look({"linewidth": 1.1, "markersize": 4.5, "markeredgewidth": 1.0, "capsize": 2.0})
            ax.errorbar([row.scale for row in rows], ends[:, 0], reach, **look, label=f"{name}, {where}")
    page.dress(ax)
    page.log_axis(ax.xaxis)
    ax.set_ylim(-1.05, 1.05)
    ax.axhline(0, color=style.FAINT, linewidth=0.8 * sheet.weight, zorder=0)
    ax.set_box_aspect(1)
    page.name_axes(ax, "width of the difference / box", "cosine; share pointing uphill")
    page.caption(ax, "gradient against differences,\nby scale")


def _disagreement_map(ax: Axes, dataset: xr.Dataset, smooth: xr.Dataset, number: int) -> None:
    plane, place = plane_of(dataset), smooth["place"].to_numpy()
    side = round(len(place) ** 0.5)
    apart, sure = (of(smooth).isel(width=number).to_numpy() for of in (disagreement, find_bias))
    low, high = plane.lower.tolist(), plane.upper.tolist()
    ax.set_facecolor(style.NO_SLOPE["facecolor"])
    drawn = ax.imshow(
        np.ma.masked_invalid(apart.reshape(side, side)), extent=(low[0], high[0], low[1], high[1]), **style.DISAGREEMENT
    )
    ax.plot(*place[sure].T, **page.sheet_of(ax).look(style.BIASED))
    page.dress(ax, plane)
    ax.set_box_aspect(1)
    page.name_axes(ax, *plane.labels)
    _say_smoothing(ax, smooth, number, sure)
    if number == len(ORDERS) - 1:
        _bar(ax, drawn, "|first \N{MINUS SIGN} zeroth order| / sum of both")


def _two_orders(ax: Axes, dataset: xr.Dataset, smooth: xr.Dataset, number: int) -> None:
    plane, place, found = plane_of(dataset), smooth["place"].to_numpy()[:, 0], smooth.isel(width=number)
    sheet = page.sheet_of(ax)
    for name, colour, marker in (("zeroth", style.LOSS_LINE, "s"), ("first", style.SLOPE_LINE, "o")):
        error = found[f"{name}_error"].to_numpy()[:, 0]
        look = sheet.look({"color": colour, "marker": marker, "markersize": 4.0, "linewidth": 0.9, "capsize": 2.0})
        ax.errorbar(place, found[name].to_numpy()[:, 0], error, **look, label=f"{name} order")
    sure = find_bias(smooth).isel(width=number).to_numpy()
    ax.plot(place[sure], found["first"].to_numpy()[sure, 0], **sheet.look(style.BIASED), zorder=4)
    page.dress(ax, plane)
    ax.set_box_aspect(1)
    page.name_axes(ax, plane.labels[0], _slope_label(dataset))
    _say_smoothing(ax, smooth, number, sure)


def _say_smoothing(ax: Axes, smooth: xr.Dataset, number: int, sure: np.ndarray[Any, Any]) -> None:
    width = _percent(smooth["width"][number])
    page.caption(ax, f"smoothed over {width} of the box\nfirst order biased at {int(sure.sum())} of {len(sure)}")


def _slope_label(dataset: xr.Dataset) -> str:
    return f"slope [{page.loss_unit(dataset) or 'loss'} per side of the box]"


def _percent(share: xr.DataArray) -> str:
    return f"{style.number(100 * float(share), '.2g')}\N{NO-BREAK SPACE}%"
