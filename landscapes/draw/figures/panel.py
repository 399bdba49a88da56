"""Parts that panels share: ticks, frame, axis labels, a caption and a colour bar, in the sizes of the page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from ...plane import Plane
from ...space import LOG10
from .. import style
from ..figure import Picture
from ..style import mark_decades
from .page import picture_of, sheet_of, write_over
from .typesetting import side_room, title_room

NARROW = 1.8  # room of a panel that has fewer ticks [inch]
FEW = 1.0, 1.5  # decades of a logarithmic axis that has more ticks than one in each, in a narrow panel and in another
DECADES = 3, 6  # of one that has a tick in each


def grid(picture: Picture, panels: int, *, share: bool = False) -> list[Axes]:
    """Return so many panels, as many side by side as the sheet has columns; they may share their window."""
    columns = min(panels, picture.sheet.columns)
    rows = -(-panels // columns)
    every = list(picture.subplots(rows, columns, sharex=share, sharey=share, squeeze=False).flat)
    for empty in every[panels:]:
        empty.remove()
    return every[:panels]


def dress(ax: Axes, plane: Plane | None = None) -> None:
    """Give a panel its ticks and frame; over a plane, or a line, logarithmic parameters have decades."""
    sheet = sheet_of(ax)
    ax.tick_params(which="both", **_ticks(sheet))
    ax.tick_params(which="minor", length=2 * sheet.type)
    ax.spines[:].set(color=style.QUIET, linewidth=max(0.4, 0.6 * sheet.weight))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(5 if sheet.pitch > NARROW else 3))
    for number, scale in enumerate(plane.scales if plane else ()):
        if scale == LOG10:
            mark_decades((ax.xaxis, ax.yaxis)[number], DECADES[sheet.pitch > NARROW])


def log_axis(axis: Axis) -> None:
    """Make an axis logarithmic, with decades alone where a panel has no room for more."""
    style.log_axis(axis)
    low, high = sorted(axis.get_view_interval())
    decades, wide = math.log10(high / low), sheet_of(axis.axes).pitch > NARROW
    if decades > FEW[wide]:
        every = math.ceil(decades / DECADES[wide])
        powers = range(math.ceil(math.log10(low)), math.floor(math.log10(high)) + 1)
        axis.set_major_locator(FixedLocator([10.0**power for power in powers if power % every == 0]))
        axis.set_major_formatter(FuncFormatter(lambda value, _: style.power(value, 3)))
    elif not wide:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=9))


def name_axes(ax: Axes, x: str | None = None, y: str | None = None) -> None:
    """Label the axes."""
    for axis, said in ((ax.xaxis, x), (ax.yaxis, y)):
        if said is not None:
            _name(ax, axis, said, (lambda: title_room(ax)) if axis is ax.xaxis else (lambda: side_room(ax)))


def name_outer(ax: Axes, x: str, y: str) -> None:
    """Label the axes of one of several panels over the same plane, once for a row and once for a column."""
    spec = ax.get_subplotspec()
    assert spec is not None  # as `grid` made it
    ax.label_outer()
    name_axes(ax, x if spec.is_last_row() else "", y if spec.is_first_col() else "")


def _name(ax: Axes, axis: Axis, said: str, room: Callable[[], float]) -> None:
    axis.set_label_text(said, size=sheet_of(ax).label, color=style.INK, parse_math=False)
    picture_of(ax).fitted[axis.label] = said, room


def caption(ax: Axes, text: str) -> None:
    """Write what a panel shows over it."""
    write_over(ax, text, size=sheet_of(ax).label, color=style.INK)


def colour_bar(
    ax: Axes,
    drawn: ScalarMappable,
    label: str,
    scale: style.Scale | None = None,
    *,
    beside: Sequence[Axes] = (),
    **how: Any,
) -> Colorbar:
    """Put a colour bar beside a panel, or several, with plain numbers where the scale is logarithmic."""
    sheet = sheet_of(ax)
    place: dict[str, Any] = {
        "fraction": 0.05, "pad": 0.02, "extend": scale.extend if scale else "neither",
        "use_gridspec": False,  # the panel keeps its place in the grid, from which the page is laid out
    }  # fmt: skip
    bar = ax.figure.colorbar(drawn, ax=[*beside] or ax, **place | how)
    lying = bar.orientation == "horizontal"
    _name(ax, bar.long_axis, label, (lambda: title_room(ax)) if lying else (lambda: side_room(ax)))
    bar.ax.tick_params(which="both", **_ticks(sheet))
    bar.ax.tick_params(which="minor", length=2 * sheet.type)
    bar.outline.set(edgecolor=style.QUIET, linewidth=max(0.4, 0.6 * sheet.weight))
    if scale and scale.logarithmic:
        bar.long_axis.set_major_locator(FixedLocator(scale.ticks()))
        bar.long_axis.set_major_formatter(FuncFormatter(lambda value, _: style.power(value)))
        bar.long_axis.set_minor_formatter(NullFormatter())
    return bar


def _ticks(sheet: style.Sheet) -> dict[str, Any]:
    return {
        "labelsize": sheet.tick, "color": style.QUIET, "labelcolor": style.INK, "length": 3 * sheet.type,
        "width": max(0.4, 0.8 * sheet.weight), "pad": 3.5 * sheet.type,
    }  # fmt: skip
