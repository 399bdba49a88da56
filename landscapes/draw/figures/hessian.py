"""The spectrum of a Hessian: eigenvalues with their errors on a symmetric logarithmic axis, and their density."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from .. import style
from . import page

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ...measures.hessian import Hessian

PITCH = 7.2  # width on a screen [inch]
ROW, LEAST_ROWS, MOST_ROWS = 0.045, 5, 18  # height of an eigenvalue's row, by the width; rows that a panel has room for
DENSITY = 0.28  # height of the density's panel, by the width
BINS = 48  # of the density
DECADES = 12  # that the axis spans on each side, at most
NARROWEST = 0.09  # half the linear part, by all decades: its ends have names
TICKS = 4  # on each side
WITHIN = "bound on the error"
REACH = 3.0  # what the axis reaches beyond the marks, as a ratio


def hessian_figure(found: Hessian, *, width: float | None = None) -> page.Picture:
    """Draw eigenvalues in order with bounds on their errors, and the density of all of them if it was sampled.

    Hollow marks are eigenvalues with an undetermined sign. Around zero the axis is linear, up to the dotted lines.

    Raises ValueError if the page is too narrow or too wide.
    """
    sheet = style.Sheet.of(width, pitch=PITCH)
    picture = page.Picture(sheet, sheet.width)
    rows = ROW * min(MOST_ROWS, max(LEAST_ROWS, len(_drawn(found)))) + 0.08
    sampled = found.nodes.size > 0
    parts = picture.add_gridspec(1 + sampled, 1, height_ratios=(rows, DENSITY)[: 1 + sampled])
    axes = [picture.add_subplot(parts[row]) for row in range(1 + sampled)]
    linear, end = _scale(found)
    for ax, height in zip(axes, (rows, DENSITY), strict=False):
        page.dress(ax)
        ax.set_box_aspect(height)
        below = end if _reaches_below(found, linear) else linear
        decades = math.log10(end / linear) + math.log10(below / linear)
        ax.set_xscale("symlog", linthresh=linear, linscale=max(0.6, NARROWEST * decades))
        ax.set_xlim(-below, end)
        _mark(ax, linear, end)
    _draw_eigenvalues(axes[0], found)
    if sampled:
        _draw_density(axes[1], found, linear, end)
    unit = f"loss unit{f', {found.loss_unit}' if found.loss_unit else ''}"
    page.name_axes(axes[-1], f"eigenvalue [{unit}; the box is 1 wide along every parameter]")
    page.entitle(picture, f"{found.env} · {found.fidelity} · Hessian at {found.through}: {found.kind}")
    page.remark(axes[0], _remark(found))
    page.finish(picture, heading=" · ".join(page.made_by(found)))
    return picture


def _drawn(found: Hessian) -> NDArray[np.int64]:
    """Return the indices of the known eigenvalues, from 1."""
    known, dim = len(found.values), found.dim
    ends = np.r_[1 : known // 2 + 1, dim - (known - known // 2) + 1 : dim + 1]
    return np.arange(1, dim + 1) if known == dim else ends


def _scale(found: Hessian) -> tuple[float, float]:
    """Return the ends of the linear part and of the axis: powers of ten around the determined eigenvalues."""
    size, error = np.abs(found.values), found.errors
    most = float((size + np.where(np.isfinite(error), error, 0)).max()) or 1.0
    told = size[size > error]
    least = float(told.min()) if len(told) else most
    linear = 10.0 ** math.floor(math.log10(max(least, most * 10.0**-DECADES)) - 1e-9)
    return linear, most * REACH


def _reaches_below(found: Hessian, linear: float) -> bool:
    return bool((found.values - found.errors < -linear).any() or (found.nodes < -linear).any())


def _mark(ax: Axes, linear: float, end: float) -> None:
    """Mark zero, both ends of the linear part, and a few decades."""
    low, high = math.log10(linear), math.log10(end)
    every = max(1, math.ceil((high - low) / TICKS))
    tens = [10.0**at for at in range(math.ceil(low), math.floor(high) + 1, every)]
    left = -ax.get_xlim()[0]
    ax.xaxis.set_major_locator(FixedLocator([*(-one for one in reversed(tens) if one <= left), 0.0, *tens]))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _write(value)))
    look = page.sheet_of(ax).look(style.STEP_LINE)
    ax.axvline(0.0, **look | {"linestyle": "solid", "color": style.FAINT})
    for at in (-linear, linear):
        ax.axvline(at, **look)


def _write(value: float) -> str:
    if value == 0:
        return "0"
    return ("\N{MINUS SIGN}" if value < 0 else "") + style.power(abs(value), style.PLAIN)


def _draw_eigenvalues(ax: Axes, found: Hessian) -> None:
    places, value, error = _drawn(found), found.values, found.errors
    rows, ends = np.arange(len(places)), np.stack([value, value - error, value + error], axis=1)
    told = np.abs(value) > error
    for sign, where in {"positive": told & (value > 0), "negative": told & (value < 0), "cannot tell": ~told}.items():
        look, name = style.EIGENVALUES[sign], style.EIGENVALUE_NAMES[sign]
        page.draw_rows(ax, np.where(where[:, None], ends, np.nan), look, name, gid="eigenvalue", within=WITHIN)
    shown = [row for row in rows if len(rows) <= MOST_ROWS or row % math.ceil(len(rows) / MOST_ROWS) == 0]
    ax.set_yticks(shown, [str(places[row]) for row in shown])
    ax.set_ylim(len(places) - 0.3, -0.7)
    page.name_axes(ax, "", "index")
    if len(places) < found.dim:
        ax.axhline(len(places) // 2 - 0.5, **page.sheet_of(ax).look(style.STEP_LINE), gid="gap")


def _draw_density(ax: Axes, found: Hessian, linear: float, end: float) -> None:
    """Draw the share of all eigenvalues in bins of equal width on the axis."""
    transform = ax.transData + ax.transAxes.inverted()
    low, high = ax.get_xlim()
    shares = np.linspace(0, 1, BINS + 1)
    edges = transform.inverted().transform(np.column_stack([shares, shares]))[:, 0]
    edges[0], edges[-1] = low, high
    weights = np.histogram(found.nodes.ravel(), edges, weights=found.weights.ravel())[0] / len(found.nodes)
    ax.bar(edges[:-1], weights, np.diff(edges), align="edge", color=style.LOSS_LINE, linewidth=0, gid="density")
    ax.set_ylim(0, 1.08 * max(weights.max(), 1e-3))
    page.name_axes(ax, "", "share of all eigenvalues")


def _remark(found: Hessian) -> str:
    """Return trace, condition number and share of negative curvature as text."""
    trace, condition, negative = found.trace, found.condition, found.negative
    bounds = f"trace {trace.value:.3g} ({trace.low:.3g} to {trace.high:.3g})"
    at_least = f"at least {condition.low:.2g}" if math.isfinite(condition.low) else "not determined"
    size = "condition " + (f"{condition.value:.4g}" if math.isfinite(condition.value) else at_least)
    said = [bounds, size, f"negative {negative.value:.0%} ({negative.low:.0%} to {negative.high:.0%})"]
    doubt = "" if found.symmetric else f"not symmetric: {found.asymmetry:.2g}"
    return " · ".join(filter(None, (*said, doubt, f"step {found.step:.2g} of the box, differences of {found.source}")))
