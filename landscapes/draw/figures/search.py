"""Searches: the losses of a run, a race of methods, and the ranks of a league (matplotlib)."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from ...objective import failed
from ...space import labelled
from .. import style
from . import page
from .overlay import by_kind

PITCH, SHAPE = 7.2, 0.5  # room of the panel on a screen [inch]; its height, against its width
WIDE = 30.0  # ratio of losses from which the axis is logarithmic


def run_figure(table: xr.Dataset, *, width: float | None = None) -> page.Picture:
    """Draw a run's losses by the purpose of each point, and the best so far; failures are marked below."""
    picture, ax = page.panel(style.Sheet.of(width, pitch=PITCH), SHAPE)
    loss = table["loss"].to_numpy()
    _scale(ax, loss)
    _draw_points(ax, table)
    _draw_best(ax, table, np.fmin.accumulate(loss))
    _draw_failures(ax, table)
    page.name_axes(ax, "episodes", page.loss_name(table))
    ax.set_xlim(0, len(loss) + 1)
    page.head(picture, ax, table, _title(table))
    page.finish(picture)
    return picture


def _title(table: xr.Dataset) -> str:
    about = table.attrs
    done, budget = table.sizes["evaluation"], about["budget"]
    episodes = f"{done} episodes" if done == budget else f"{done} of {budget} episodes so far"
    said = [about["env"], about["fidelity"], about["method"], f"seed {about['seed']}", episodes]
    return " · ".join(str(part) for part in said if part)


def _scale(ax: Axes, loss: NDArray[np.float64]) -> None:
    """Fit the axis to the best and most other losses, without the largest outliers."""
    finite = loss[np.isfinite(loss)]
    if not finite.size:
        ax.set_yticks([])
        return
    low, high = float(finite.min()), float(style.Scale.of_loss(finite).norm.vmax or finite.max())
    if low > 0 and high / low >= WIDE:
        room = (high / low) ** 0.05
        ax.set_ylim(low / room, high * room)
        page.log_axis(ax.yaxis)
    else:
        room = 0.05 * (high - low) or 0.5
        ax.set_ylim(low - room, high + room)


def _draw_points(ax: Axes, table: xr.Dataset) -> None:
    loss, episodes = (table[name].to_numpy() for name in ("loss", "episodes"))
    top = ax.get_ylim()[1]
    for name, own in by_kind(table):
        here = own & np.isfinite(loss)
        if not here.any():
            continue
        above = int((loss[here] > top).sum())
        label = f"{name} points" + (f" ({above} above the plot)" if above else "")
        look = style.POINT_MARKS[name] | {"markersize": 3.0, "markeredgewidth": 0.0, "alpha": 0.55, "linestyle": "none"}
        ax.plot(episodes[here], loss[here], **page.sheet_of(ax).look(look), label=label, gid=name)


def _draw_best(ax: Axes, table: xr.Dataset, best: NDArray[np.float64]) -> None:
    label = f"best so far: {style.number(best[-1])}" if np.isfinite(best[-1]) else "no episode has succeeded"
    look = page.sheet_of(ax).look({"color": style.INK, "linewidth": 1.4, "zorder": 3})
    ax.step(table["episodes"], best, where="post", label=label, gid="best", **look)


def _draw_failures(ax: Axes, table: xr.Dataset) -> None:
    lost = failed(table["status"].to_numpy())
    if lost.any():
        label = f"failed: {int(lost.sum())} of {len(lost)}"
        look = page.sheet_of(ax).look({"color": style.QUIET, "marker": "|", "markersize": 7, "linestyle": "none"})
        at = table["episodes"].to_numpy()[lost], np.full(lost.sum(), 0.02)
        ax.plot(*at, transform=ax.get_xaxis_transform(), label=label, gid="failed", **look)


RACE_PITCH, RACE_SHAPE = 4.9, 0.95  # room of a panel on a screen [inch]; its height, against its width
DECADE = 10.0  # an axis is logarithmic where targets are, and span at least this factor
LEAD_WIDTH = 52  # characters of a line that says who leads
MARK_SPACING = 0.3  # between two markers of a line, as a share of the panel's diagonal


def race_figure(dataset: xr.Dataset, *, width: float | None = None) -> page.Picture:
    """Draw a race: mean best loss with its interval over seeds on the left, the ECDF over targets on the right.

    `dataset` contains step functions, one row per method and NaN past its end: `episodes`, `mean`, `low`, `high`, shape
    (method, step), and `hit`, shape (method, pair): the episodes after which each pair of seed and target was reached,
    NaN for never. `unsuccessful`, shape (method,), counts the seeds without a successful episode; a method with such a
    seed has no mean. Attributes: `title`, `budget`, `seeds`, `loss_unit`, `spacing` (log or linear), `targets` (count,
    hardest, easiest), `lead` (the first method, as text), `identity`, `provenance`. A linear loss axis ends as far
    above the easiest target as the hardest is below it, so that a few bad first losses do not flatten the rest.
    """
    sheet = style.Sheet.of(width, pitch=RACE_PITCH, columns=2)
    picture, (losses, shares) = page.panels(sheet, 2)
    for row in range(dataset.sizes["method"]):
        _draw_method(losses, shares, dataset, row)
    for ax in (losses, shares):
        page.dress(ax)
        ax.set_box_aspect(RACE_SHAPE)
        ax.set_xlim(1, dataset.attrs["budget"])
        page.log_axis(ax.xaxis)
        page.name_axes(ax, "episodes")
    _frame_losses(losses, dataset)
    _frame_shares(shares, dataset)
    page.head(picture, losses, dataset, dataset.attrs["title"])
    page.finish(picture, columns=2 if dataset["unsuccessful"].any() else 4)
    return picture


def _draw_method(losses: Axes, shares: Axes, dataset: xr.Dataset, row: int) -> None:
    one = dataset.isel(method=row)
    name = str(one["method"].item())
    look = page.sheet_of(losses).look(style.METHOD_LINE | style.METHODS.get(name, style.OTHER_METHOD))
    look |= {
        "drawstyle": "steps-post",
        "markevery": (MARK_SPACING * (row + 0.5) / dataset.sizes["method"], MARK_SPACING),
    }
    episodes, mean, low, high = (_where_finite(one[key], one["mean"]) for key in ("episodes", "mean", "low", "high"))
    losses.plot(episodes, mean, label=_label(name, one, dataset), **look)
    losses.fill_between(episodes, low, high, step="post", color=look["color"], **style.METHOD_BAND)
    hits = np.sort(_where_finite(one["hit"], one["hit"]))
    share = np.arange(len(hits) + 1) / max(one["hit"].size, 1)
    shares.plot([1, *hits, dataset.attrs["budget"]], [*share, share[-1]], **look)


def _label(name: str, one: xr.Dataset, dataset: xr.Dataset) -> str:
    count, seeds = int(one["unsuccessful"]), dataset.attrs["seeds"]
    return f"{name} (no success with {count} of {seeds} seeds, so no mean)" if count else name


def _where_finite(values: xr.DataArray, where: xr.DataArray) -> NDArray[np.float64]:
    found: NDArray[np.float64] = values.to_numpy()[np.isfinite(where.to_numpy())]
    return found


def _frame_losses(ax: Axes, dataset: xr.Dataset) -> None:
    unit, seeds = dataset.attrs["loss_unit"], dataset.attrs["seeds"]
    page.name_axes(ax, y=labelled("best loss so far", unit))
    count, hardest, easiest = dataset.attrs["targets"]
    said = "one seed: no interval" if seeds == 1 else f"mean of {seeds} seeds and 95 % bootstrap interval"
    if not np.isfinite(dataset["mean"]).any():
        said = "no method succeeded with every seed: no mean"
        ax.set_yticks([])
    elif dataset.attrs["spacing"] == "log" and easiest >= DECADE * hardest:
        page.log_axis(ax.yaxis)
    elif count > 1:
        ax.set_ylim(top=min(ax.get_ylim()[1], 2 * easiest - hardest))
    look: dict[str, Any] = {"size": page.sheet_of(ax).small, "color": style.QUIET, "ha": "right", "va": "top"}
    said = "\n".join([said, *textwrap.wrap(dataset.attrs["lead"], LEAD_WIDTH)])
    ax.text(0.98, 0.98, said, transform=ax.transAxes, **look)


def _frame_shares(ax: Axes, dataset: xr.Dataset) -> None:
    count, hardest, easiest = dataset.attrs["targets"]
    ax.set_ylim(0, 1)
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    page.name_axes(ax, y="pairs of target and seed reached")
    unit = f" {dataset.attrs['loss_unit']}" if dataset.attrs["loss_unit"] else ""
    spaced = "logarithmically" if dataset.attrs["spacing"] == "log" else "evenly"
    ends = f"{style.number(easiest)}{unit} down to {style.number(hardest)}{unit}"
    said = f"{count} targets from {ends}, spaced {spaced}" if count else "no episode succeeded, so there are no targets"
    page.remark(ax, said)


CELL, LABELS, ROW = 0.95, 2.3, 0.44  # room of a method, and of the scenes' names with the bar; height of a row [inch]
NARROW = 0.8  # room of a cell on a screen's scale of type, under which its interval is left out [inch]
LOW = 0.5  # height of a row without intervals, against one with them
SHORT = 8  # letters of a method's name that stands in one line


def league_figure(dataset: xr.Dataset, *, width: float | None = None) -> page.Picture:
    """Draw a league: the mean rank of each method in each scene, with its interval, and over all scenes last.

    `dataset` contains `rank`, `rank_low` and `rank_high`, shape (scene, method), NaN where a method did not run or has
    no interval. `first` says where a method is ahead of every other one after the correction for all pairs; these ranks
    are bold. The last row is over all scenes. Attributes: `title`, `seeds` and `command`, as text. Columns are in the
    order of the methods. A printed picture that is too narrow for intervals leaves them out, and the legend says so.
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
    bar = page.colour_bar(ax, drawn, f"mean rank among {methods} methods, 1 is best", **place)
    if told:
        bar.ax.invert_yaxis()
    page.entitle(picture, dataset.attrs["title"])
    page.finish(picture, _legend(dataset, told=told), columns=1)
    return picture


def _write_cells(ax: Axes, dataset: xr.Dataset, most: float, *, told: bool) -> None:
    """Write each rank into its cell with its interval under it; hatch cells without a rank."""
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
        weight = "bold" if dataset["first"].to_numpy()[row, column] else "normal"
        ax.text(column, row - 0.16 * within, style.number(rank, form), va="center", size=size, weight=weight, **look)
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


def _legend(dataset: xr.Dataset, *, told: bool) -> list[Artist | str]:
    """Return the legend of the cells."""
    below = (
        "below: 95 % bootstrap interval over seeds, and over scenes in the last row"
        if told
        else "intervals are in league.json"
    )
    known = [
        f"mean rank over {_seeds(dataset)}; {below}",
        "bold: first, ahead of every other method by the rank test, corrected for all pairs",
    ]
    missing = [] if np.isfinite(dataset["rank"]).all() else [Patch(**style.NOT_RUN, label="did not run here")]
    return [*known, *missing, dataset.attrs["command"]]


def _in_two(name: str) -> str:
    """Break a long name into two lines at its last dash."""
    first, dash, second = name.rpartition("-")
    return f"{first}{dash}\n{second}" if dash and len(name) > SHORT else name


def _seeds(dataset: xr.Dataset) -> str:
    said = dataset.attrs["seeds"]
    return f"{said} seed" if said == "1" else f"{said} seeds"
