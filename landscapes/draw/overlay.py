"""Runs over a slice: the loss map with their points, and what the map shows against what they found (matplotlib)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ..objective import Status
from ..plane import Plane
from ..store import plane_of
from . import contour, page, style

Runs = Sequence[xr.Dataset]
COLUMNS = 2  # of the legend


def overlay_figure(dataset: xr.Dataset, runs: Runs) -> Figure:
    """Draw runs, as `overlay` lays them, over the loss map of their slice, and their losses against the map's.

    A point is filled with the loss it truly had, on the map's own scale: where it differs from what is around it, the
    plane does not show it. It is smaller, and a descent fainter, the farther it lies off the plane. Points beyond the
    map are hollow and at its border; failed episodes are crosses. On the right every point is held against the sample
    it lies over: it is on the diagonal if the map tells its loss.
    """
    plane = plane_of(dataset)
    scale = joint_scale(dataset, runs)
    reach = farthest(runs)
    entries = [*_run_entries(runs), *_kind_entries(runs), *_distance_entries(runs, reach), *_count_entries(runs)]
    rows = -(-(len(entries) + len(page.failure_key(dataset))) // COLUMNS)
    figure = page.blank_page(2 * style.PANEL + 2.2, style.PANEL + 1.4 + 0.2 * rows)
    over, against = figure.subplots(1, 2)
    contour.loss_map(over, dataset, scale)
    contour.frame(over, dataset, plane)
    over.set_xlabel(plane.labels[0], size=style.LABEL, parse_math=False)
    for run in sorted(runs, key=lambda run: -run.sizes["evaluation"]):
        _draw_run(over, run, plane, scale, reach, _count(runs))
    _draw_against(against, dataset, runs, reach)
    page.head(figure, over, dataset, f"{page.title(dataset)} · {_said(runs)}")
    page.key(figure, [*entries, *page.failure_key(dataset)], columns=COLUMNS)
    return figure


def joint_scale(dataset: xr.Dataset, runs: Runs) -> style.Scale:
    """Return the scale of the losses of a slice and of the runs over it.

    Where losses are positive it ends a decade below the slice's least, so that a run which converged does not take the
    colours away from the map.
    """
    own = dataset["loss"].to_numpy().ravel()
    values = np.concatenate([own, *(run["loss"].to_numpy() for run in runs)])
    floor = float(np.nanmin(own)) / 10 if np.isfinite(own).any() else 0.0
    if floor <= 0 or not (values < floor).any():
        return style.Scale.of_loss(values)
    scale = style.Scale.of_loss(np.maximum(values, floor))
    return style.Scale(scale.norm, "both" if scale.extend in ("max", "both") else "min")


def farthest(runs: Runs) -> float:
    """Return the greatest distance of any point from the plane [half-widths of the box], 0 where it is rounding."""
    most = max((float(run["distance"].max()) for run in runs if run.sizes["evaluation"]), default=0.0)
    return most if most > 1e-9 else 0.0


def _draw_run(ax: Axes, run: xr.Dataset, plane: Plane, scale: style.Scale, reach: float, points: int) -> None:
    color = style.method(run)["color"]
    low, high = (side.numpy() for side in plane.window())
    place = np.clip(np.stack([run["u"], run["v"]], axis=1), low, high)
    loss, distance, outside = (run[name].to_numpy() for name in ("loss", "distance", "outside"))
    ax.add_collection(_trail(run, place, reach))
    areas = style.point_areas(distance, reach, points)
    for name, here in by_kind(run):
        look: dict[str, Any] = {"edgecolors": color, "marker": style.KINDS[name]["marker"]}
        if (some := here & ~outside & np.isfinite(loss)).any():
            u, v = place[some].T
            ax.scatter(u, v, s=areas[some], marker=look["marker"], **style.HALO)
            fill: dict[str, Any] = {"c": loss[some], "cmap": style.LOSS_MAP, "norm": scale.norm}
            ax.scatter(u, v, s=areas[some], gid=name, **look, **fill, **style.OVERLAID)
        if (some := here & outside).any():
            u, v = place[some].T
            ax.scatter(u, v, gid="outside", **look, **style.BORDER)
    failed = (run["status"].to_numpy() != Status.OK) & ~outside
    if failed.any():
        ax.scatter(place[failed, 0], place[failed, 1], **style.BROKEN, gid="failed")
    if np.isfinite(loss).any():
        row = int(np.nanargmin(loss))
        inside = "none" if outside[row] else [style.LOSS_MAP(scale.norm(loss[row]))]
        u, v = place[row]
        ax.scatter([u], [v], facecolors=inside, edgecolors=color, clip_on=False, gid="best", **style.BEST)


def by_kind(run: xr.Dataset) -> list[tuple[str, NDArray[np.bool_]]]:
    """Return, for each kind of point a run has, its name and which rows are of it."""
    about, kind = run["kind"].attrs, run["kind"].to_numpy()
    pairs = zip(about["flag_values"], str(about["flag_meanings"]).split(), strict=True)
    return [(name, kind == code) for code, name in pairs if (kind == code).any()]


def _trail(run: xr.Dataset, place: NDArray[np.float64], reach: float) -> LineCollection:
    rows = np.flatnonzero(run["previous"].to_numpy() >= 0)
    before = run["previous"].to_numpy()[rows]
    distance = run["distance"].to_numpy()
    away = (distance[rows] + distance[before]) / 2 / (reach or 1.0)
    colors = np.tile(to_rgba(style.method(run)["color"]), (len(rows), 1))
    colors[:, 3] = 1 - (1 - style.FAINTEST) * away
    lines = np.stack([place[before], place[rows]], axis=1)
    return LineCollection(list(lines), colors=colors, gid="descents", **style.TRAIL)


def _draw_against(ax: Axes, dataset: xr.Dataset, runs: Runs, reach: float) -> None:
    """Hold every loss against that of the sample beneath."""
    style.dress(ax)
    ax.set_box_aspect(1)
    pairs = [np.stack([run["beneath"], run["loss"]]) for run in runs]
    known = [np.isfinite(pair).all(axis=0) for pair in pairs]
    values = np.concatenate([pair[:, some].ravel() for pair, some in zip(pairs, known, strict=True)])
    low, high = _square(ax, style.Scale.of_loss(values))
    for run, (beneath, loss), some in zip(runs, pairs, known, strict=True):
        areas = style.point_areas(run["distance"].to_numpy(), reach, _count(runs))
        look = {"facecolors": style.method(run)["color"], "edgecolors": "white", **style.OVERLAID}
        for name, here in by_kind(run):
            at = some & here
            ax.scatter(beneath[at], loss[at], s=areas[at], marker=style.KINDS[name]["marker"], gid=name, **look)
    unit = dataset["loss"].attrs.get("units", "")
    per = f" [{unit}]" if unit else ""
    ax.set_xlabel(f"loss of the sample beneath{per}", size=style.LABEL, parse_math=False)
    ax.set_ylabel(f"loss of the point itself{per}", size=style.LABEL, parse_math=False)
    off = int(((values < low) | (values > high)).sum())
    said = f"{len(values) // 2} of {_count(runs)} points have a loss, and so has the sample beneath"
    ax.set_title(said + (f"; {off} values off scale" if off else ""), size=style.SMALL, color=style.QUIET)


def _square(ax: Axes, scale: style.Scale) -> tuple[float, float]:
    """Give both axes the range of a scale, and draw the diagonal."""
    low, high = float(scale.norm.vmin or 0.0), float(scale.norm.vmax or 0.0)
    if scale.logarithmic:
        low, high = low * (low / high) ** 0.03, high * (high / low) ** 0.03
    else:
        low, high = low - 0.03 * (high - low), high + 0.03 * (high - low)
    ax.set(xlim=(low, high), ylim=(low, high))
    for axis in (ax.xaxis, ax.yaxis) if scale.logarithmic else ():
        style.log_axis(axis)
    ax.plot([low, high], [low, high], color=style.FAINT, linewidth=1.0, zorder=1)
    return low, high


def _run_entries(runs: Runs) -> list[Artist]:
    """Return one entry per method, with its best run; per run where there is one of each."""
    entries: list[Artist] = []
    for method in dict.fromkeys(str(run.attrs["method"]) for run in runs):
        own = [run for run in runs if run.attrs["method"] == method]
        name = f"{method}, seed {own[0].attrs['seed']}" if len(own) == 1 else f"{method}, {len(own)} runs"
        look: dict[str, Any] = {
            "color": style.method(own[0])["color"],
            "linewidth": 1.6,
            "marker": "*",
            "markersize": 10,
        }
        entries.append(Line2D([], [], **look, markerfacecolor="white", label=f"{name}: {_best_said(own)}"))
    return entries


def _best_said(runs: Runs) -> str:
    found = [(float(run["best"][-1]), run) for run in runs if run.sizes["evaluation"] and run["best"][-1].notnull()]
    if not found:
        return "no episode succeeded"
    loss, run = min(found, key=lambda pair: pair[0])
    row = int(run["loss"].argmin("evaluation"))
    away = float(run["distance"][row])
    where = f", {style.number(round(away, 3))} off the plane" if away > 1e-9 else ""
    beyond = ", outside the map" if bool(run["outside"][row]) else ""
    return f"best {style.number(loss)}{where}{beyond}"


def _kind_entries(runs: Runs) -> list[Artist]:
    counts: dict[str, int] = {}
    for run in runs:
        for name, here in by_kind(run):
            counts[name] = counts.get(name, 0) + int(here.sum())
    look: dict[str, Any] = {
        "linestyle": "none",
        "markerfacecolor": "white",
        "markeredgecolor": style.INK,
        "markersize": 5.5,
    }
    return [
        Line2D([], [], marker=style.KINDS[name]["marker"], **look, label=f"{name} point: {count}")
        for name, count in counts.items()
    ]


def _distance_entries(runs: Runs, reach: float) -> list[Artist]:
    if not reach:
        return [Line2D([], [], linestyle="none", label="every point lies on the plane")]
    steps = np.array([0.0, reach / 2, reach])
    sizes = np.sqrt(style.point_areas(steps, reach, _count(runs)))
    look: dict[str, Any] = {"linestyle": "none", "marker": "o", "markerfacecolor": style.QUIET, "markeredgewidth": 0.0}
    said = ("on the plane", *(f"{away:.2g} half-widths of the box off it" for away in steps[1:]))
    return [Line2D([], [], markersize=size, **look, label=text) for size, text in zip(sizes, said, strict=True)]


def _count_entries(runs: Runs) -> list[Artist]:
    total = _count(runs)
    outside = sum(int(run["outside"].sum()) for run in runs)
    failed = sum(int((run["status"] != Status.OK).sum()) for run in runs)
    hollow: dict[str, Any] = {"marker": "o", "markersize": 5.5, "markerfacecolor": "none", "markeredgecolor": style.INK}
    cross: dict[str, Any] = {"marker": "x", "markersize": 5.0, "markeredgecolor": style.INK}
    return [
        Line2D([], [], linestyle="none", **look, label=f"{name}: {count} of {total} points")
        for look, name, count in ((hollow, "beyond the map", outside), (cross, "failed episode", failed))
        if count
    ]


def _count(runs: Runs) -> int:
    return sum(run.sizes["evaluation"] for run in runs)


def _said(runs: Runs) -> str:
    return f"{len(runs)} run{'s' if len(runs) != 1 else ''}, {_count(runs)} episodes"
