"""A race of optimisers: best loss against episodes, and the share of targets reached (matplotlib)."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from .. import style
from . import page, panel

PITCH, SHAPE = 4.9, 0.95  # room of a panel on a screen [inch]; its height, against its width
DECADE = 10.0  # an axis is logarithmic where targets are, and span at least this factor
MARK_SPACING = 0.3  # between two markers of a line, as a share of the panel's diagonal


def race_figure(dataset: xr.Dataset, *, width: float | None = None) -> page.Picture:
    """Draw a race: mean best loss with its interval over seeds on the left, the ECDF over targets on the right.

    `dataset` holds step functions, one row per method and NaN past its end: `episodes`, `mean`, `low`, `high`, shape
    (method, step), and `hit`, shape (method, pair), the episodes after which each pair of seed and target was reached,
    NaN where never. `unsuccessful`, shape (method,), counts the seeds without a successful episode; their methods have
    no mean. Attributes: `title`, `budget`, `seeds`, `loss_unit`, `spacing` (log or linear), `targets` (count, hardest,
    easiest), `identity`, `provenance`. A linear loss axis ends as far above the easiest target as the hardest is below
    it, so that a few bad first losses do not flatten the rest.
    """
    sheet = style.Sheet.of(width, pitch=PITCH, columns=2)
    picture = page.Picture(sheet, 2 / sheet.columns * sheet.pitch)
    losses, shares = panel.grid(picture, 2)
    entries: list[Artist] = [_draw_method(losses, shares, dataset, row) for row in range(dataset.sizes["method"])]
    for ax in (losses, shares):
        panel.dress(ax)
        ax.set_box_aspect(SHAPE)
        style.log_axis(ax.xaxis)
        ax.set_xlim(1, dataset.attrs["budget"])
        panel.name_axes(ax, "episodes")
    _frame_losses(losses, dataset)
    _frame_shares(shares, dataset)
    page.head(picture, losses, dataset, dataset.attrs["title"])
    page.finish(picture, entries, columns=2 if dataset["unsuccessful"].any() else 4)
    return picture


def _draw_method(losses: Axes, shares: Axes, dataset: xr.Dataset, row: int) -> Artist:
    one = dataset.isel(method=row)
    name = str(one["method"].item())
    look = page.sheet_of(losses).look(style.METHOD_LINE | style.METHODS.get(name, style.OTHER_METHOD))
    look |= {
        "drawstyle": "steps-post",
        "markevery": (MARK_SPACING * (row + 0.5) / dataset.sizes["method"], MARK_SPACING),
    }
    episodes, mean, low, high = (_where_finite(one[key], one["mean"]) for key in ("episodes", "mean", "low", "high"))
    (line,) = losses.plot(episodes, mean, label=_label(name, one, dataset), **look)
    losses.fill_between(episodes, low, high, step="post", color=look["color"], **style.METHOD_BAND)
    hits = np.sort(_where_finite(one["hit"], one["hit"]))
    share = np.arange(len(hits) + 1) / max(one["hit"].size, 1)
    shares.plot([1, *hits, dataset.attrs["budget"]], [*share, share[-1]], **look)
    return line


def _label(name: str, one: xr.Dataset, dataset: xr.Dataset) -> str:
    count, seeds = int(one["unsuccessful"]), dataset.attrs["seeds"]
    return f"{name} (no success with {count} of {seeds} seeds, so no mean)" if count else name


def _where_finite(values: xr.DataArray, where: xr.DataArray) -> NDArray[np.float64]:
    found: NDArray[np.float64] = values.to_numpy()[np.isfinite(where.to_numpy())]
    return found


def _frame_losses(ax: Axes, dataset: xr.Dataset) -> None:
    unit, seeds = dataset.attrs["loss_unit"], dataset.attrs["seeds"]
    panel.name_axes(ax, y=f"best loss so far [{unit}]" if unit else "best loss so far")
    count, hardest, easiest = dataset.attrs["targets"]
    said = "one seed: no interval" if seeds == 1 else f"mean of {seeds} seeds and 95 % bootstrap interval"
    if not np.isfinite(dataset["mean"]).any():
        said = "no method succeeded with every seed: no mean"
        ax.set_yticks([])
    elif dataset.attrs["spacing"] == "log" and easiest >= DECADE * hardest:
        style.log_axis(ax.yaxis)
    elif count > 1:
        ax.set_ylim(top=min(ax.get_ylim()[1], 2 * easiest - hardest))
    look: dict[str, Any] = {"size": page.sheet_of(ax).small, "color": style.QUIET, "ha": "right", "va": "top"}
    ax.text(0.98, 0.98, said, transform=ax.transAxes, **look)


def _frame_shares(ax: Axes, dataset: xr.Dataset) -> None:
    count, hardest, easiest = dataset.attrs["targets"]
    ax.set_ylim(0, 1)
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    panel.name_axes(ax, y="pairs of target and seed reached")
    unit = f" {dataset.attrs['loss_unit']}" if dataset.attrs["loss_unit"] else ""
    spaced = "logarithmically" if dataset.attrs["spacing"] == "log" else "evenly"
    ends = f"{style.number(easiest)}{unit} down to {style.number(hardest)}{unit}"
    said = f"{count} targets from {ends}, spaced {spaced}" if count else "no episode succeeded, so there are no targets"
    page.remark(ax, said)
