"""Two slices of one plane: both losses on one scale, and the differences of losses and gradients (matplotlib)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from numpy.typing import NDArray

from ...identity import plane_of
from ...measures.ruggedness import box_slopes
from ...objective import has_loss
from ...space import labelled
from .. import style
from . import contour, page

if TYPE_CHECKING:
    from ...measures.slice_comparison import SliceComparison
    from ...statistics import Estimate

PITCH, MIN_PANEL = 4.8, 40.0  # room of a panel: on a screen [inch], and at least in print [mm]
HEIGHT = 2.2  # of a panel over a line [inch]
PLAIN = 3  # digits before or after the point, up to which differences have no power of ten
LISTED = 4  # settings that differ, in the legend
IN_EITHER = " in A or B"


def comparison_figure(found: SliceComparison, *, width: float | None = None) -> page.Picture:
    """Draw the losses of both slices on one scale, their difference, and the cosine of their gradients.

    Each cell, or point of a line, is a sample of both slices; nothing is interpolated. The scale of differences is
    symmetric about zero. Panels of both slices are hatched where a sample failed in one of them. For a line the figure
    shows the gradients themselves, because their cosine is only a sign.

    Raises ValueError if the page is too narrow or too wide.
    """
    draw = _draw_maps if plane_of(found.data[0]).rank == 2 else _draw_lines
    picture = draw(found, width)
    points = " \N{MULTIPLICATION SIGN} ".join(str(count) for count in reversed(found.data[0]["loss"].shape))
    page.entitle(picture, f"A: {found.a} against B: {found.b} · {points} points")
    page.finish(picture, _say(found), heading=_made(found))
    return picture


def _draw_maps(found: SliceComparison, width: float | None) -> page.Picture:
    panels = 4 if found.slopes else 3
    sheet = style.Sheet.of(width, pitch=PITCH, columns=2, least=MIN_PANEL)
    picture, axes = page.panels(sheet, panels, share=True)
    both = _where_either_failed(found)
    _loss_maps(axes, found)
    _difference_map(axes[2], found)
    _farthest(axes[2], found)
    if found.cosine is not None:
        _cosine_map(axes[3], found.data[0], found.cosine)
    for ax, dataset in zip(axes, (*found.data, both, both), strict=False):
        contour.frame(ax, dataset, plane_of(dataset), IN_EITHER if dataset is both else None)
        page.name_outer(ax, *plane_of(dataset).labels)
    return picture


def _loss_maps(axes: list[Axes], found: SliceComparison) -> None:
    """Draw the losses of A and B on one scale."""
    scale = style.Scale.of_loss(np.concatenate([one["loss"].to_numpy().ravel() for one in found.data]))
    for ax, letter, name, dataset in zip(axes, "AB", (found.a, found.b), found.data, strict=False):
        contour.loss_map(ax, dataset, scale)
        contour.lowest_sample(ax, dataset, f"lowest sample of {letter}")
        page.caption(ax, f"{letter}: {name}")


def _difference_map(ax: Axes, found: SliceComparison) -> None:
    values, power = _in_powers(found)
    scale = style.Scale.symmetric(values)
    drawn = contour.cell_map(ax, found.data[0], values, scale, style.DIFFERENCE_MAP)
    page.caption(ax, "difference of losses, B \N{MINUS SIGN} A")
    page.colour_bar(ax, drawn, _name("difference", power, found.loss_unit), scale)


def _in_powers(found: SliceComparison) -> tuple[NDArray[np.float64], str]:
    """Return the differences of losses, with a common power of ten if they are far from 1."""
    values = found.difference.to_numpy()
    most = found.loss.largest.value
    exponent = math.floor(math.log10(most)) if most > 0 else 0
    if -PLAIN <= exponent < PLAIN:
        return values, ""
    return values / 10.0**exponent, style.power(10.0**exponent)


def _name(what: str, power: str, unit: str) -> str:
    """Return the label of an axis, with the power of ten and the unit of its numbers."""
    return labelled(what, f"{power} {unit}".strip())


def _cosine_map(ax: Axes, dataset: xr.Dataset, cosine: xr.DataArray) -> None:
    scale, colours = style.Scale.between(-1.0, 1.0), style.COSINE["cmap"]
    drawn = contour.cell_map(ax, dataset, cosine.to_numpy(), scale, colours)
    page.caption(ax, "gradients of A against B")
    page.colour_bar(ax, drawn, "cosine of gradients", scale)


def _farthest(ax: Axes, found: SliceComparison) -> None:
    if not found.loss.largest.value > 0 or not found.parting:
        return
    look, apart = page.sheet_of(ax).look(style.FARTHEST), found.parting.b - found.parting.a
    at = ([one] for one in found.parting.place.values())
    ax.plot(*at, **look, zorder=4, label=f"largest difference, B \N{MINUS SIGN} A: {style.number(apart)}")


def _draw_lines(found: SliceComparison, width: float | None) -> page.Picture:
    panels, plane, both = 3 if found.slopes else 2, plane_of(found.data[0]), _where_either_failed(found)
    sheet = style.Sheet.of(width, pitch=page.LINE_PITCH)
    picture, axes = page.stack(sheet, [max(page.FLATTEST, sheet.zoom) * HEIGHT] * panels)
    _curves(axes[0], found, [one["loss"].to_numpy() for one in found.data])
    page.name_axes(axes[0], y=page.loss_name(found.data[0]))
    look = sheet.look(style.stroke(found.points))
    values, power = _in_powers(found)
    axes[1].plot(found.difference["u"], values, color=style.INK, **look)
    page.name_axes(axes[1], y=_name("B \N{MINUS SIGN} A", power, found.loss_unit))
    if found.slopes:
        _curves(axes[2], found, [box_slopes(one)[:, 0] for one in found.data])
        page.name_axes(axes[2], y=f"slope [{found.loss_unit or 'loss'} per side]")
    for ax in axes:
        contour.frame(ax, both, plane, IN_EITHER)
    for ax in axes[1:]:
        ax.axhline(0, color=style.FAINT, linewidth=0.8 * sheet.weight, zorder=0.5)
    page.name_axes(axes[-1], plane.labels[0])
    picture.align_ylabels(axes)
    return picture


def _curves(ax: Axes, found: SliceComparison, values: list[Any]) -> None:
    sheet, u = page.sheet_of(ax), found.data[0]["u"].to_numpy()
    for letter, name, curve, look in zip("AB", (found.a, found.b), values, style.PAIR, strict=True):
        ax.plot(u, curve, **sheet.look(style.stroke(len(u)) | look), label=f"{letter}: {name}")


def _where_either_failed(found: SliceComparison) -> xr.Dataset:
    """Return slice A with the status of B where A has a loss, for the hatching in a panel of both."""
    ours, theirs = (one["status"] for one in found.data)
    return found.data[0].assign(status=ours.copy(data=np.where(has_loss(ours), theirs, ours)))


def _say(found: SliceComparison) -> list[str]:
    if not found.compared:
        return ["no point has a loss in both slices"]
    percent = style.number(100 * found.loss.shares["median"].value, ".2g")
    unit = f" {found.loss_unit}" if found.loss_unit else ""
    said = [f"median difference: {style.number(found.loss.median.value)}{unit}, {percent} % of A's range"]
    said.append(f"rank correlation: {_interval(found.spearman)}")
    if found.slopes:
        said.append(f"cosine of gradients, median: {_interval(found.slopes.cosine)}")
        said.append(f"opposing gradients: {style.number(100 * found.slopes.opposing.value, '.2g')} %")
        said.append(f"length of gradients, B to A, median: {_interval(found.slopes.ratio)}")
    if found.statuses:
        said.append(f"ended differently: {sum(one.points for one in found.statuses)} of {found.points}")
    settings = [f"{name}: {a} in A, {b} in B" for name, (a, b) in found.shared.items()]
    rest = len(found.differing) - min(len(settings), LISTED)
    more = [f"and {rest} more settings differ"] if rest else []
    return [*said, *settings[:LISTED], *more]


def _interval(one: Estimate) -> str:
    ends = f" ({style.number(one.low)} to {style.number(one.high)})" if one.low == one.low else ""
    return f"{style.number(one.value)}{ends}"


def _made(found: SliceComparison) -> str:
    a, b = (page.provenance(one).split(" · ")[0] for one in found.data)
    return " · ".join(one for one in (a if a == b else f"{a} and {b}", found.command) if one)
