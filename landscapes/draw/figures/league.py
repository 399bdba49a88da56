"""A league as a map of mean ranks: a row for each scene, a column for each method (matplotlib)."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patches import Patch, Rectangle

from .. import style
from . import page, panel

CELL, LABELS, ROW = 0.95, 2.3, 0.44  # room of a method, and of the scenes' names with the bar; height of a row [inch]
NARROW = 0.8  # room of a cell on a screen's scale of type, under which its interval is left out [inch]
LOW = 0.5  # height of a row without intervals, against one with them
SHORT = 8  # letters of a method's name that stands in one line


def league_figure(dataset: xr.Dataset, *, width: float | None = None) -> page.Picture:
    """Draw a league: the mean rank of each method in each scene, with its interval, and over all scenes last.

    `dataset` holds `rank`, `rank_low` and `rank_high`, shape (scene, method), NaN where a method did not run or there
    is no interval; the last scene stands for all. Attributes: `title`, `seeds` and `command`, as text. Columns stand
    in the order of the methods. In a picture for print that is too narrow for them, intervals are left out, which the
    legend says.
    """
    scenes, methods = dataset.sizes["scene"], dataset.sizes["method"]
    sheet = style.Sheet.of(width, pitch=LABELS + CELL * methods)
    told = CELL * sheet.zoom / sheet.type >= NARROW
    picture = page.Picture(sheet, sheet.type * (ROW * (1 if told else LOW) * scenes + 1.5))
    ax: Axes = picture.subplots()
    most = float(np.nanmax([methods, 2]))
    drawn = ax.imshow(
        np.ma.masked_invalid(dataset["rank"].to_numpy()), cmap=style.RANK_MAP, vmin=1, vmax=most, aspect="auto"
    )
    _write_cells(ax, dataset, most, told=told)
    _frame(ax, dataset, upright=told)
    place: dict[str, Any] = {"aspect": 30} if told else {"location": "bottom", "aspect": 30, "shrink": 0.9}
    bar = panel.colour_bar(ax, drawn, f"mean rank among {methods} methods, 1 is best", **place)
    if told:
        bar.ax.invert_yaxis()
    page.entitle(picture, dataset.attrs["title"])
    page.finish(picture, _legend(dataset, told=told), columns=1)
    return picture


def _write_cells(ax: Axes, dataset: xr.Dataset, most: float, *, told: bool) -> None:
    """Write each rank into its cell, and its interval under it; hatch the cells that have none."""
    sheet = page.sheet_of(ax)
    parts = [dataset[name].to_numpy() for name in ("rank", "rank_low", "rank_high")]
    for row, column in np.ndindex(*parts[0].shape):
        rank, low, high = (float(part[row, column]) for part in parts)
        if not np.isfinite(rank):
            corner = (column - 0.5, row - 0.5)
            ax.add_patch(Rectangle(corner, 1, 1, **style.NOT_RUN))
            continue
        share = (rank - 1) / (most - 1)
        ink = style.text_on(style.RANK_MAP(share), style.TINTED)
        look: dict[str, Any] = {"ha": "center", "color": ink, "parse_math": False}
        within = told and np.isfinite(low)
        form, size = (".2f", sheet.tick) if told else (".2g", sheet.small)
        ax.text(column, row - 0.16 * within, style.number(rank, form), va="center", size=size, **look)
        if within:
            said = f"{style.number(low, '.1f')} to {style.number(high, '.1f')}"
            ax.text(column, row + 0.24, said, va="center", size=sheet.small, **look)


def _frame(ax: Axes, dataset: xr.Dataset, *, upright: bool) -> None:
    sheet = page.sheet_of(ax)
    methods, scenes = (list(map(str, dataset[name].to_numpy())) for name in ("method", "scene"))
    slope: dict[str, Any] = {} if upright else {"rotation": 90}
    ax.set_xticks(range(len(methods)), [_in_two(name) if upright else name for name in methods], **slope)
    ax.set_yticks(range(len(scenes)), scenes)
    ax.tick_params(labelsize=sheet.tick, length=0, labelcolor=style.INK)
    ax.spines[:].set(color=style.QUIET, linewidth=max(0.4, 0.6 * sheet.weight))
    for row in range(1, len(scenes)):
        last = row == len(scenes) - 1
        ax.axhline(row - 0.5, color="white", linewidth=(3.0 if last else 1.0) * sheet.weight)
    for column in range(1, len(methods)):
        ax.axvline(column - 0.5, color="white", linewidth=sheet.weight)


def _legend(dataset: xr.Dataset, *, told: bool) -> list[Patch]:
    """Say what stands in the cells."""
    blank: dict[str, Any] = {"facecolor": "none", "edgecolor": "none"}
    below = (
        "below it the 95 % bootstrap interval, over seeds, and over scenes in the last row"
        if told
        else "intervals are in league.json"
    )
    known = [Patch(**blank, label=f"mean rank over {_seeds(dataset)}; {below}")]
    if not np.isfinite(dataset["rank"]).all():
        known.append(Patch(**style.NOT_RUN, label="did not run here"))
    return [*known, Patch(**blank, label=dataset.attrs["command"])]


def _in_two(name: str) -> str:
    """Return a long name in two lines, broken at its last dash."""
    first, dash, second = name.rpartition("-")
    return f"{first}{dash}\n{second}" if dash and len(name) > SHORT else name


def _seeds(dataset: xr.Dataset) -> str:
    said = dataset.attrs["seeds"]
    return f"{said} seed" if said == "1" else f"{said} seeds"
