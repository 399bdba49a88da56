"""The losses of one run by episode, and the best so far (matplotlib)."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from numpy.typing import NDArray

from ...objective import failed
from .. import style
from . import page, panel

PITCH, SHAPE = 7.2, 0.5  # room of the panel on a screen [inch]; its height, against its width
WIDE = 30.0  # ratio of losses from which the axis is logarithmic


def run_figure(table: xr.Dataset, *, width: float | None = None) -> page.Picture:
    """Draw a run's losses, by what each point was evaluated for, and the best so far; failures are marked below."""
    sheet = style.Sheet.of(width, pitch=PITCH)
    picture = page.Picture(sheet, sheet.width)
    ax = picture.subplots()
    panel.dress(ax)
    ax.set_box_aspect(SHAPE)
    loss = table["loss"].to_numpy()
    best = np.fmin.accumulate(loss)
    _scale(ax, loss)
    entries = [*_draw_points(ax, table), _draw_best(ax, table, best), *_draw_failures(ax, table)]
    panel.name_axes(ax, "episodes", page.loss_name(table))
    ax.set_xlim(0, len(loss) + 1)
    page.head(picture, ax, table, _title(table))
    page.finish(picture, entries)
    return picture


def _title(table: xr.Dataset) -> str:
    about = table.attrs
    done, budget = table.sizes["evaluation"], about["budget"]
    episodes = f"{done} episodes" if done == budget else f"{done} of {budget} episodes so far"
    said = [about["env"], about["fidelity"], about["method"], f"seed {about['seed']}", episodes]
    return " · ".join(str(part) for part in said if part)


def _scale(ax: Axes, loss: NDArray[np.float64]) -> None:
    """Show the best and the bulk, without the farthest outliers above."""
    finite = loss[np.isfinite(loss)]
    if not finite.size:
        ax.set_yticks([])
        return
    low, high = float(finite.min()), float(style.Scale.of_loss(finite).norm.vmax or finite.max())
    if low > 0 and high / low >= WIDE:
        style.log_axis(ax.yaxis)
        room = (high / low) ** 0.05
        ax.set_ylim(low / room, high * room)
    else:
        room = 0.05 * (high - low) or 0.5
        ax.set_ylim(low - room, high + room)


def _draw_points(ax: Axes, table: xr.Dataset) -> list[Artist]:
    loss, kind, episodes = (table[name].to_numpy() for name in ("loss", "kind", "episodes"))
    names = str(table["kind"].attrs["flag_meanings"]).split()
    top = ax.get_ylim()[1]
    entries: list[Artist] = []
    for code, name in zip(table["kind"].attrs["flag_values"], names, strict=True):
        here = (kind == code) & np.isfinite(loss)
        if not here.any():
            continue
        above = int((loss[here] > top).sum())
        label = f"{name} points" + (f" ({above} above the picture)" if above else "")
        look = style.POINT_MARKS[name] | {"markersize": 3.0, "markeredgewidth": 0.0, "alpha": 0.55, "linestyle": "none"}
        entries += ax.plot(episodes[here], loss[here], **page.sheet_of(ax).look(look), label=label, gid=name)
    return entries


def _draw_best(ax: Axes, table: xr.Dataset, best: NDArray[np.float64]) -> Artist:
    label = f"best so far: {style.number(best[-1])}" if np.isfinite(best[-1]) else "no episode has succeeded"
    look = page.sheet_of(ax).look({"color": style.INK, "linewidth": 1.4, "zorder": 3})
    (line,) = ax.step(table["episodes"], best, where="post", label=label, gid="best", **look)
    return line


def _draw_failures(ax: Axes, table: xr.Dataset) -> list[Artist]:
    status, episodes = table["status"].to_numpy(), table["episodes"].to_numpy()
    lost = failed(status)
    if not lost.any():
        return []
    label = f"failed: {int(lost.sum())} of {len(lost)}"
    look = page.sheet_of(ax).look({"color": style.QUIET, "marker": "|", "markersize": 7, "linestyle": "none"})
    at = np.full(lost.sum(), 0.02)
    return list(ax.plot(episodes[lost], at, transform=ax.get_xaxis_transform(), label=label, gid="failed", **look))
