"""Accuracy against time: every rung of a trade-off, and the front of those that no other beats (matplotlib)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ..tradeoff import front
from . import page, style

WIDTH, HEIGHT = 7.2, 5.4  # of the page [inch]
ROOM = 1.6  # what the axes reach beyond the outermost rungs, as a ratio

Rows = Sequence[Mapping[str, Any]]


def tradeoff_figure(report: Mapping[str, Any]) -> Figure:
    """Draw the 95th percentile of each rung's loss errors, with its interval, over seconds per episode with gradient.

    The reference is a line at its time: its own error is zero by definition. Rungs without a finite percentile stand on
    the upper edge, counted in the legend, those that are exactly right on the lower one.
    """
    report, time = _timed(report)
    relative = report["spread"] is not None
    figure = page.blank_page(WIDTH, HEIGHT)
    ax = figure.subplots()
    style.dress(ax)
    rows = [row for row in report["rungs"] if row["name"] != report["reference"]]
    low, high = _limits(ax, report, rows, relative)
    entries = _front(ax, report, rows, relative)
    entries += _rungs(ax, rows, relative, low, high)
    entries += [Line2D([], [], **style.WHISKER, label="95 % interval"), _against(ax, report, time)]
    unit = f" [{report['loss_unit']}]" if report["loss_unit"] else ""
    ax.set_xlabel(f"time of an episode with gradient [{time}]", size=style.LABEL)
    what = "loss error, 95th percentile"
    ax.set_ylabel(f"{what} [% of the losses' spread]" if relative else what + unit, size=style.LABEL, parse_math=False)
    _head(figure, ax, report)
    page.key(figure, entries, columns=3)
    _label(figure, ax, [row for row in rows if row["ladder"] == "named"], relative, low, high)
    return figure


def _limits(ax: Axes, report: Mapping[str, Any], rows: Rows, relative: bool) -> tuple[float, float]:
    """Span what is drawn, on logarithmic axes; return the errors of the lower and the upper edge."""
    seconds = [row["time"] for row in report["rungs"]]
    errors = [end for row in rows for end in _ends(row, relative).values() if end]
    low, high = (min(errors), max(errors)) if errors else (1e-3, 1.0)
    ax.set_xlim(min(seconds) / ROOM, max(seconds) * ROOM)
    ax.set_ylim(low / ROOM, high * ROOM)
    for axis in (ax.xaxis, ax.yaxis):
        style.log_axis(axis)
    return low / ROOM, high * ROOM


def _timed(report: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """Give each rung the `time` of an episode with gradient, in a unit that suits the reference; return that too."""
    long = _reference(report)["seconds"]["with_gradient"] >= 2.0
    factor, unit = (1.0, "s") if long else (1e3, "ms")
    rungs = [{**row, "time": factor * row["seconds"]["with_gradient"]} for row in report["rungs"]]
    return {**report, "rungs": rungs}, unit


def _ends(row: Mapping[str, Any], relative: bool) -> dict[str, float | None]:
    """Return the percentile and the ends of its interval, in percent or in the loss's unit."""
    found = row["loss_error"]["p95_relative" if relative else "p95"]
    return {end: None if value is None else (100 if relative else 1) * value for end, value in found.items()}


def _error(row: Mapping[str, Any], relative: bool, low: float, high: float) -> float:
    value = _ends(row, relative)["value"]
    return high if value is None else max(value, low)


def _rungs(ax: Axes, rows: Rows, relative: bool, low: float, high: float) -> list[Artist]:
    entries: list[Artist] = []
    for ladder, look in style.LADDERS.items():
        members = [row for row in rows if row["ladder"] == ladder]
        if not members:
            continue
        seconds = [row["time"] for row in members]
        errors = [_error(row, relative, low, high) for row in members]
        for x, row in zip(seconds, members, strict=True):
            ends = _ends(row, relative)
            if ends["value"] is not None:
                top = high if ends["high"] is None else ends["high"]
                ax.plot([x, x], [max(ends["low"] or low, low), max(top, low)], **style.WHISKER)
        lost = sum(_ends(row, relative)["value"] is None for row in members)
        label = f"{ladder} ({lost} failed too often: on the edge)" if lost else ladder
        ax.plot(seconds, errors, **style.RUNG | look, gid=ladder, clip_on=False)
        entries.append(Line2D([], [], **style.RUNG | look, label=label))
    return entries


def _front(ax: Axes, report: Mapping[str, Any], rows: Rows, relative: bool) -> list[Artist]:
    """Draw the front as steps: at any time, the least error that so much time buys, until it buys the reference."""
    end = _reference(report)["time"]
    seconds = [row["time"] for row in rows]
    errors = [
        np.inf if (off := _ends(row, relative)["value"]) is None or time >= end else off
        for time, row in zip(seconds, rows, strict=True)
    ]
    best = front(seconds, errors)
    if not best:
        return []
    bottom = ax.get_ylim()[0]
    x, y = [*(seconds[k] for k in best), end], [*(max(errors[k], bottom) for k in best), bottom]
    return list(ax.step(x, y, where="post", **style.FRONT, label="front", gid="front"))


def _reference(report: Mapping[str, Any]) -> Mapping[str, Any]:
    (row,) = (row for row in report["rungs"] if row["name"] == report["reference"])
    found: Mapping[str, Any] = row
    return found


def _against(ax: Axes, report: Mapping[str, Any], unit: str) -> Artist:
    row = _reference(report)
    seconds = row["time"]
    label = f"{row['name']}: {style.number(seconds)} {unit}, error 0 by definition"
    line: Artist = ax.axvline(seconds, **style.AGAINST, label=label)
    return line


def _label(figure: Figure, ax: Axes, rows: Rows, relative: bool, low: float, high: float) -> None:
    """Name the named fidelities, where the name covers no marker: right, left, above or below of its own."""
    figure.draw_without_rendering()
    markers = np.concatenate([ax.transData.transform(_outline(line)) for line in ax.lines if line.get_gid()])
    taken: list[Any] = []
    frame = ax.get_window_extent()
    for row in rows:
        at = (row["time"], _error(row, relative, low, high))
        for place, (dx, dy), aligned in style.BESIDE:
            text = ax.annotate(
                row["name"], at, (dx, dy), textcoords="offset points", **aligned, **style.NAME, gid=f"name {place}"
            )
            box = text.get_window_extent().expanded(1.05, 1.1)
            inside = frame.x0 < box.x0 and box.x1 < frame.x1 and frame.y0 < box.y0 and box.y1 < frame.y1
            if (
                inside
                and not any(box.contains(*point) for point in markers)
                and not any(box.overlaps(b) for b in taken)
            ):
                taken.append(box)
                break
            text.remove()
        else:
            ax.annotate(
                row["name"], at, style.BESIDE[0][1], textcoords="offset points", **style.BESIDE[0][2], **style.NAME
            )


def _outline(line: Line2D) -> NDArray[np.float64]:
    """Return points of what a name must not cover: markers, or places along a line of steps."""
    points = np.asarray(line.get_xydata(), dtype=float)
    if line.get_gid() != "front":
        return points
    corners = np.insert(points, range(1, len(points)), np.column_stack([points[1:, 0], points[:-1, 1]]), axis=0)
    share = np.linspace(0, 1, 64)[:, None, None]
    between: NDArray[np.float64] = np.exp((1 - share) * np.log(corners[:-1]) + share * np.log(corners[1:]))
    return between.reshape(-1, 2)


def _head(figure: Figure, ax: Axes, report: Mapping[str, Any]) -> None:
    title = f"{report['env']} · accuracy against time · {report['points']} points"
    figure.suptitle(title, size=style.TITLE, color=style.INK, parse_math=False)
    known = {**report["provenance"], **report["identity"]}
    said = [f"{known[key]}" for key in ("device", "created", "command") if known.get(key)]
    if report["spread"] is not None:
        said.insert(0, f"spread {style.number(report['spread'])} {report['loss_unit']}".rstrip())
    ax.set_title(page.wrapped(" · ".join(said), 100), size=style.SMALL, color=style.QUIET, parse_math=False)
