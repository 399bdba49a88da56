"""The extremes of a scene: loss errors against changes of settings, and maps of pairs of settings (matplotlib)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from ...space import labelled
from .. import style
from . import contour, page

if TYPE_CHECKING:
    from ....studies.extremes import ExtremesRecord, Limit, StabilityMap
    from ....studies.stability import Cell

PITCH, MIN_PANEL = 4.0, 40.0  # room of a panel: on a screen [inch], and at least in print [mm]
LOWEST, HIGHEST = 1e-4, 1e4  # of the error axis [% of the spread]; what is beyond stands on the edge
NAMES = {
    "accurate": "accurate",
    "inaccurate": "finite, but wrong",
    "not judged": "finite, not judged",
    "refused": "refused",
}  # of the outcomes of `studies.stability`
NAMES |= {kind.name: name for kind, name in style.ENDED.items()}
REACH = 1.35  # what the axis of factors reaches beyond the outermost marks, as a ratio

Grid = NDArray[np.float64]


def extremes_figure(found: ExtremesRecord, *, width: float | None = None) -> page.Picture:
    """Draw for each precision the loss errors against the settings, and a map of each pair with its boundary.

    A cell of a map is one setting, coloured by its outcome; nothing is interpolated. A curve breaks where the scene
    fails, and a cross marks the first failure. Errors too large or too small for the axis are on its edges.

    Raises ValueError if the page is too narrow or too wide.
    """
    rows = [[one for one in found.maps if one.precision == precision] for precision in found.precisions]
    columns = 1 + max(map(len, rows))
    sheet = style.Sheet.of(width, pitch=PITCH, columns=columns, least=MIN_PANEL)
    picture, axes = page.panels(sheet, sum(1 + len(maps) for maps in rows))
    panels = iter(axes)
    for precision, maps in zip(found.precisions, rows, strict=True):
        ax = next(panels)
        _draw_errors(ax, [one for one in found.limits if one.precision == precision], found.tolerance)
        page.caption(ax, f"{precision}: errors up to failure")
        for one in maps:
            _draw_map(next(panels), one)
    page.entitle(picture, f"{found.env} · {found.fidelity} · extremes · {found.points} points")
    made = page.made_by(found, "device", "engine", "created")
    page.finish(picture, columns=4, heading=" · ".join([f"compared with {found.reference}", *made, found.command]))
    return picture


def _draw_errors(ax: Axes, limits: Sequence[Limit], tolerance: float) -> None:
    """Draw the error of each setting's stable values against the factor of its change."""
    sheet = page.sheet_of(ax)
    page.dress(ax)
    drawn = [limit for limit in limits if _has_factor(limit)]
    looks = _looks(list(dict.fromkeys(limit.setting for limit in drawn)))
    cross = sheet.look({"marker": "x", "markersize": 6.0, "markeredgewidth": 1.4, "linestyle": "none"})
    for limit in drawn:
        look = {"linewidth": 1.1, **style.VARIANT_MARK, "markersize": 5.0, **looks[limit.setting], "linestyle": "solid"}
        factors = [cell.values[0] / limit.base for cell in limit.scanned]
        errors = [_error(cell) for cell in limit.scanned]
        ax.plot(factors, errors, **sheet.look(look), gid=limit.setting, clip_on=False, label=limit.setting)
        if limit.failed is not None:
            at, top = [limit.failed / limit.base], [HIGHEST]
            ax.plot(at, top, color=looks[limit.setting]["color"], **cross, gid="failed", clip_on=False, zorder=5)
    if any(limit.failed is not None for limit in drawn):
        ax.plot([], [], color=style.INK, **cross, label="first failure, on the edge")
    if drawn:
        reach = [cell.values[0] / limit.base for limit in drawn for cell in limit.scanned]
        ax.set_xlim(min(reach) / REACH, max(reach) * REACH)
    ax.set_ylim(LOWEST, HIGHEST)
    page.log_axis(ax.xaxis, ax.yaxis)
    label = f"accurate below {100 * tolerance:g} %"
    ax.axhline(100 * tolerance, **sheet.look(style.REFERENCE_LINE), label=label)
    ax.axvline(1.0, color=style.FAINT, linewidth=0.8 * sheet.weight, zorder=0)
    ax.set_box_aspect(1)
    page.name_axes(ax, "multiple of the scene's value", "loss error, 95 % of the points [% of the spread]")


def _error(cell: Cell) -> float:
    """Return a stable value's error within the axis [% of the spread], or NaN, where the curve breaks."""
    if not cell.stable or cell.error is None:
        return math.nan
    return float(np.clip(100 * cell.error, LOWEST, HIGHEST))


def _has_factor(limit: Limit) -> bool:
    """Say whether a setting is changed by factors, which one that may be zero is not."""
    return limit.base > 0 and all(cell.values[0] > 0 for cell in limit.scanned)


def _looks(settings: Sequence[str]) -> dict[str, dict[str, object]]:
    """Return a colour and a marker for each setting, the same as in the trade-off if it is there."""
    own = [style.VARIANTS[name] for name in ("stiffness", "engine", "particles", "precision", "device")]
    known = {"dt": style.VARIANTS["dt"], "resolution": style.VARIANTS["resolution"]}
    others = iter(own * len(settings))
    return {name: known[name] if name in known else next(others) for name in settings}


def _draw_map(ax: Axes, found: StabilityMap) -> None:
    """Draw the outcome of each cell, the boundaries and the base."""
    sheet = page.sheet_of(ax)
    outcomes = np.array([cell.outcome for cell in found.cells]).reshape(len(found.ys), len(found.xs))
    edges = _edges(found.xs), _edges(found.ys)
    for outcome, look in style.OUTCOMES.items():
        if (where := outcomes == outcome).any():
            ax.add_patch(contour.cells_patch(*edges, where, **look, gid=outcome, label=NAMES[outcome]))
    lines = {"limit of accuracy, bisected": found.accurate_boundary, "limit of stability, bisected": found.boundary}
    for label, ends in lines.items():
        if ends:
            y, low, high = np.array(sorted(ends)).T
            line = sheet.look(style.BOUNDARIES[ends is found.boundary]) | {"gid": label, "label": label}
            ax.plot(np.sqrt(low * high) if low.min() > 0 else (low + high) / 2, y, **line, clip_on=False)
    star = sheet.look(style.LOWEST_MARK)
    ax.plot(*([one] for one in found.base), **star, gid="base", zorder=4, label="the scene's values")
    page.dress(ax)
    for axis, limits, values in ((ax.xaxis, edges[0], found.xs), (ax.yaxis, edges[1], found.ys)):
        (ax.set_xlim if axis is ax.xaxis else ax.set_ylim)(float(limits[0]), float(limits[-1]))
        if min(values) > 0:
            page.log_axis(axis)
    ax.set_box_aspect(1)
    page.name_axes(ax, *map(labelled, (found.x, found.y), found.units))
    page.caption(ax, f"{found.precision}: {found.x} against {found.y}")


def _edges(values: Sequence[float]) -> Grid:
    """Return the borders of cells around ascending values: geometric means, or arithmetic means if one is zero."""
    ratio = min(values) > 0
    at = np.log(values) if ratio else np.asarray(values, dtype=float)
    half = np.diff(at) / 2 if len(at) > 1 else np.array([0.5])
    found: Grid = np.concatenate([[at[0] - half[0]], at[:-1] + half[: len(at) - 1], [at[-1] + half[-1]]])
    return np.exp(found) if ratio else found
