"""Runs over a slice: their points on the loss map, and their losses against the map's (matplotlib)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from ...identity import plane_of
from ...objective import failed
from ...overlay import IMPROVEMENTS_OF, improvements, run_name
from ...plane import Plane
from ...space import labelled
from .. import style
from . import contour, page

Runs = Sequence[xr.Dataset]
PITCH = 5.4  # room of a panel on a screen [inch]
HEADING = "Marker size: distance from the plane; colour: the loss of the point itself"
MAX_NUMBERED = 24  # most improvements that are numbered, over all runs
CROWD = 4  # runs from which on the lines that join them are thinner


def overlay_figure(dataset: xr.Dataset, runs: Runs, *, width: float | None = None) -> page.Picture:
    """Draw runs, as projected by `overlay`, over the loss map of their slice, and their losses against the map's.

    The colour of a marker is the loss of the point itself on the map's scale. Where it differs from the colour around
    it, the plane does not show that loss. Markers get smaller, and descents fainter, with the distance from the plane.
    A white line joins the improvements of a run up to the star at its best point. Numbers give the episodes of the
    improvements where they fit. Points outside the map are hollow and at its border. Failed episodes are crosses. The
    panel on the right, or below on a narrow page, compares each point with the sample beneath it: points on the
    diagonal have the loss that the map shows.

    Raises ValueError if the page is too narrow or too wide.
    """
    plane, reach = plane_of(dataset), farthest_distance(runs)
    sheet = style.Sheet.of(width, pitch=PITCH, columns=2)
    picture, (over, against) = page.panels(sheet, 2)
    scale = joint_scale(dataset, runs)
    contour.loss_map(over, dataset, scale)
    contour.frame(over, dataset, plane)
    page.name_axes(over, plane.labels[0])
    for run in sorted(runs, key=lambda run: -run.sizes["evaluation"]):
        _draw_run(over, run, plane, scale, reach, _count(runs))
        _join_improvements(over, run, plane, len(runs))
    _draw_against(against, dataset, runs, reach)
    page.head(picture, over, dataset, f"{page.title(dataset)} · {_describe_runs(runs)}")
    page.finish(picture, [*_signs(sheet, runs, reach), *page.sampling_key(dataset)], heading=HEADING)
    _number_improvements(over, runs, plane)
    return picture


def joint_scale(dataset: xr.Dataset, runs: Runs) -> style.Scale:
    """Return the common scale of the losses of a slice and of the runs over it.

    The map keeps its colours, because the upper end is that of the slice. The lower end extends to the runs' best
    losses by at most a decade, or by the slice's range if losses are not positive. Losses beyond an end have the colour
    of the end, and the colour bar is open there.
    """
    own = dataset["loss"].to_numpy().ravel()
    values = np.concatenate([own, *(run["loss"].to_numpy() for run in runs)])
    if not np.isfinite(own).any():
        return style.Scale.of_loss(values)
    low, high = style.Scale.of_loss(own).ends
    floor = low / 10 if low > 0 else 2 * low - high
    return style.Scale.of_loss(np.clip(values, floor, high)).over(values)


def farthest_distance(runs: Runs) -> float:
    """Return the largest distance of any point from the plane [half-widths of the box], 0 if it is rounding."""
    most = max((float(run["distance"].max()) for run in runs if run.sizes["evaluation"]), default=0.0)
    return most if most > 1e-9 else 0.0


def _draw_run(ax: Axes, run: xr.Dataset, plane: Plane, scale: style.Scale, reach: float, points: int) -> None:
    color, sheet = style.method(run)["color"], page.sheet_of(ax)
    place = _places(run, plane)
    loss, distance, outside = (run[name].to_numpy() for name in ("loss", "distance", "outside"))
    ax.add_collection(_descent_lines(run, place, reach, sheet))
    areas = sheet.weight**2 * style.point_areas(distance, reach, points)
    for name, here in by_kind(run):
        look: dict[str, Any] = {"edgecolors": color, "marker": style.POINT_MARKS[name]["marker"]}
        if (some := here & ~outside & np.isfinite(loss)).any():
            u, v = place[some].T
            ax.scatter(u, v, s=areas[some], marker=look["marker"], **sheet.look(style.HALO))
            fill: dict[str, Any] = {"c": loss[some], "cmap": style.LOSS_MAP, "norm": scale.norm}
            ax.scatter(u, v, s=areas[some], gid=name, **look, **fill, **sheet.look(style.OVERLAID))
        if (some := here & outside).any():
            u, v = place[some].T
            ax.scatter(u, v, gid="outside", **look, **sheet.look(style.BORDER))
    lost = failed(run["status"].to_numpy()) & ~outside
    if lost.any():
        ax.scatter(place[lost, 0], place[lost, 1], **sheet.look(style.FAILED_MARK), gid="failed")
    if np.isfinite(loss).any():
        row = int(np.nanargmin(loss))
        inside = "none" if outside[row] else [style.LOSS_MAP(scale.norm(loss[row]))]
        u, v = place[row]
        best = sheet.look(style.BEST_MARK)
        ax.scatter([u], [v], facecolors=inside, edgecolors=color, clip_on=False, gid="best", **best)


def _places(run: xr.Dataset, plane: Plane) -> NDArray[np.float64]:
    """Return the drawn positions of a run's points, shape (point, 2), those outside the map at its border."""
    low, high = (side.numpy() for side in plane.cell_bounds())
    found: NDArray[np.float64] = np.clip(np.stack([run["u"], run["v"]], axis=1), low, high)
    return found


def by_kind(run: xr.Dataset) -> list[tuple[str, NDArray[np.bool_]]]:
    """Return the name of each kind of point in a run, and its rows."""
    about, kind = run["kind"].attrs, run["kind"].to_numpy()
    pairs = zip(about["flag_values"], str(about["flag_meanings"]).split(), strict=True)
    return [(name, kind == code) for code, name in pairs if (kind == code).any()]


def _descent_lines(run: xr.Dataset, place: NDArray[np.float64], reach: float, sheet: style.Sheet) -> LineCollection:
    rows = np.flatnonzero(run["previous"].to_numpy() >= 0)
    before = run["previous"].to_numpy()[rows]
    distance = run["distance"].to_numpy()
    away = (distance[rows] + distance[before]) / 2 / (reach or 1.0)
    colors = np.tile(to_rgba(style.method(run)["color"]), (len(rows), 1))
    colors[:, 3] = 1 - (1 - style.FAINTEST) * away
    lines = np.stack([place[before], place[rows]], axis=1)
    return LineCollection(list(lines), colors=colors, gid="descents", **sheet.look(style.DESCENT_LINE))


def _join_improvements(ax: Axes, run: xr.Dataset, plane: Plane, runs: int) -> None:
    thinner = min(1.0, (CROWD / runs) ** 0.5)
    for look in style.IMPROVEMENTS:
        scaled = page.sheet_of(ax).look(look | {"linewidth": thinner * look["linewidth"]})
        ax.plot(*_places(run, plane)[improvements(run)].T, gid="order", **scaled)


def _number_improvements(ax: Axes, runs: Runs, plane: Plane) -> None:
    """Write episode numbers next to improvements where they fit, the last of each run first."""
    places = [_places(run, plane) for run in runs]
    rows = [improvements(run)[::-1] for run in runs]
    turns = range(max(map(len, rows), default=0))
    every = [(number, own[turn]) for turn in turns for number, own in enumerate(rows) if turn < len(own)]
    picked = every[:MAX_NUMBERED]
    names = [page.Label(str(_episode(runs[number], row)), tuple(places[number][row])) for number, row in picked]
    clear = np.concatenate([place[own] for place, own in zip(places, rows, strict=True)])
    size = page.sheet_of(ax).small
    page.place_labels(ax, names, clear, size=size, gaps=(0.7 * size,), gid="episode")


def _episode(run: xr.Dataset, row: int) -> int:
    """Return the episode of a row, which is not consecutive if the run has only its improvements."""
    return int(run["episodes"][row]) if "episodes" in run else row + 1


def _draw_against(ax: Axes, dataset: xr.Dataset, runs: Runs, reach: float) -> None:
    """Draw the loss of every point against the loss of the sample beneath it."""
    page.dress(ax)
    ax.set_box_aspect(1)
    sheet = page.sheet_of(ax)
    pairs = [np.stack([run["beneath"], run["loss"]]) for run in runs]
    known = [np.isfinite(pair).all(axis=0) for pair in pairs]
    values = np.concatenate([pair[:, some].ravel() for pair, some in zip(pairs, known, strict=True)])
    low, high = _square(ax, style.Scale.of_loss(values))
    for run, (beneath, loss), some in zip(runs, pairs, known, strict=True):
        areas = sheet.weight**2 * style.point_areas(run["distance"].to_numpy(), reach, _count(runs))
        look = {"facecolors": style.method(run)["color"], "edgecolors": "white", **sheet.look(style.OVERLAID)}
        for name, here in by_kind(run):
            at = some & here
            ax.scatter(beneath[at], loss[at], s=areas[at], marker=style.POINT_MARKS[name]["marker"], gid=name, **look)
    unit = page.loss_unit(dataset)
    page.name_axes(ax, *(labelled(f"loss of the {what}", unit) for what in ("sample beneath", "point itself")))
    off = int(((values < low) | (values > high)).sum())
    said = f"{len(values) // 2} of {_count(runs)} points: those with both losses"
    page.remark(ax, said + (f"; {off} values off scale" if off else ""))


def _square(ax: Axes, scale: style.Scale) -> tuple[float, float]:
    """Give both axes the range of a scale, and draw the diagonal."""
    low, high = scale.ends
    if scale.logarithmic:
        low, high = low * (low / high) ** 0.03, high * (high / low) ** 0.03
    else:
        low, high = low - 0.03 * (high - low), high + 0.03 * (high - low)
    ax.set(xlim=(low, high), ylim=(low, high))
    if scale.logarithmic:
        page.log_axis(ax.xaxis, ax.yaxis)
    ax.plot([low, high], [low, high], color=style.FAINT, linewidth=page.sheet_of(ax).weight, zorder=1)
    return low, high


def _signs(sheet: style.Sheet, runs: Runs, reach: float) -> list[Artist | str]:
    """Return the legend: methods with their best runs, improvements, kinds of points, distances and failures."""
    signs: list[Artist | str] = []
    for method in dict.fromkeys(str(run.attrs["method"]) for run in runs):
        own = [run for run in runs if run.attrs["method"] == method]
        name = run_name(own[0]) if len(own) == 1 else f"{method}, {len(own)} runs"
        look = {"linewidth": 1.6, "marker": "*", "markersize": 10, "markeredgewidth": 1.0, "markerfacecolor": "white"}
        look["color"] = style.method(own[0])["color"]
        signs.append(page.sign(sheet, f"{name}: {_describe_best(own)}", look))
    if any(len(improvements(run)) > 1 for run in runs):
        edge = withStroke(linewidth=sheet.weight * style.IMPROVEMENTS[0]["linewidth"], foreground=style.INK)
        look = style.IMPROVEMENTS[1] | {"path_effects": [edge]}
        signs.append(page.sign(sheet, "white line: the best loss so far; numbers: episodes", look))
    plain = {"linestyle": "none", "markeredgecolor": style.INK, "markersize": 5.5, "markeredgewidth": 1.0}
    for name in dict.fromkeys(name for run in runs for name, _ in by_kind(run)):
        count = sum(int(here.sum()) for run in runs for kind, here in by_kind(run) if kind == name)
        look = plain | {"markerfacecolor": "white", "marker": style.POINT_MARKS[name]["marker"]}
        signs.append(page.sign(sheet, f"{name} point: {count}", look))
    signs += _distance_signs(sheet, runs, reach)
    total = _count(runs)
    outside = sum(int(run["outside"].sum()) for run in runs)
    lost = sum(int(failed(run["status"]).sum()) for run in runs)
    for marker, name, count in (("o", "outside the map", outside), ("x", "failed episode", lost)):
        if count:
            look = plain | {"marker": marker, "markerfacecolor": "none"}
            signs.append(page.sign(sheet, f"{name}: {count} of {total} points", look))
    return signs


def _describe_best(runs: Runs) -> str:
    found = [(float(run["best"][-1]), run) for run in runs if run.sizes["evaluation"] and run["best"][-1].notnull()]
    if not found:
        return "no episode succeeded"
    loss, run = min(found, key=lambda pair: pair[0])
    row = int(run["loss"].argmin("evaluation"))
    away = float(run["distance"][row])
    where = f", {half_widths(away)} off the plane" if away > 1e-9 else ""
    beyond = ", outside the map" if bool(run["outside"][row]) else ""
    return f"best {style.number(loss)} {page.loss_unit(run)}".rstrip() + where + beyond


def half_widths(distance: float) -> str:
    """Write a distance from the plane with its unit."""
    said = style.number(distance, ".2g") if distance >= 1e-3 else "less than 0.001"
    return f"{said} half-width{'' if said == '1' else 's'} of the box"


def _distance_signs(sheet: style.Sheet, runs: Runs, reach: float) -> list[Artist | str]:
    if not reach:
        return ["every point lies on the plane"]
    steps = np.array([0.0, reach / 2, reach])
    sizes = np.sqrt(style.point_areas(steps, reach, _count(runs)))
    look = {"linestyle": "none", "marker": "o", "markerfacecolor": style.QUIET, "markeredgewidth": 0.0}
    said = ("on the plane", *(f"{half_widths(float(away))} off it" for away in steps[1:]))
    return [page.sign(sheet, text, look | {"markersize": size}) for size, text in zip(sizes, said, strict=True)]


def _count(runs: Runs) -> int:
    return sum(run.sizes["evaluation"] for run in runs)


def _describe_runs(runs: Runs) -> str:
    said = f"{len(runs)} run{'s' if len(runs) != 1 else ''}, "
    if runs and all(run.attrs.get(IMPROVEMENTS_OF) for run in runs):
        return f"{said}{_count(runs)} improvements in {sum(run.attrs[IMPROVEMENTS_OF] for run in runs)} episodes"
    return f"{said}{_count(runs)} episodes"
