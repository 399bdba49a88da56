"""Accuracy against time: the variants of a trade-off and their Pareto front (matplotlib)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ...measures.fidelity import pareto_front
from .. import style
from . import labels, page, panel

PITCH, SHAPE, NARROW = 7.2, 0.58, 0.9  # room on a screen [inch]; the panel's height against its width, there and narrow
GAPS = (7.0, 12.0, 18.0, 25.0, 34.0, 44.0)  # of a name from its mark, on a screen [pt]
INTERVAL = "interval"
ROOM = 1.6  # what the axes reach beyond the outermost variants, as a ratio

Rows = Sequence[Mapping[str, Any]]


def tradeoff_figure(
    report: Mapping[str, Any], *, width: float | None = None, chosen: Mapping[str, str] | None = None
) -> page.Picture:
    """Draw the 95th percentile of each variant's loss errors, with its interval, over the time of an episode.

    The reference is a line at its time: its own error is zero by definition. Variants without a finite percentile are
    on the upper edge and counted in the legend; those without any error are on the lower edge. The mark of a variant
    says which option was changed, its name from which fidelity and to what. Where there is little room a line leads to
    the name, or the name is in the legend, by number. Of mixed variants only those on the front have names, and those
    that are `chosen`, by the names of fidelities that should be theirs: these have a ring.

    Raises ValueError where the page is too narrow or too wide.
    """
    sheet = style.Sheet.of(width, pitch=PITCH)
    keyed: list[str] = []
    while True:
        picture, left = _draw(report, sheet, keyed, chosen or {})
        if set(left) <= set(keyed):  # only among dozens of variants in one place a number finds no room
            return picture
        keyed += [name for name in left if name not in keyed]


def _draw(
    report: Mapping[str, Any], sheet: style.Sheet, keyed: Sequence[str], chosen: Mapping[str, str]
) -> tuple[page.Picture, list[str]]:
    """Draw the picture, with the `keyed` variants named by number; return it and the names that found no room."""
    report, time = _add_times(report)
    relative = report["spread"] is not None
    picture = page.Picture(sheet, sheet.width)
    ax = picture.subplots()
    panel.dress(ax)
    ax.set_box_aspect(SHAPE if sheet.zoom > 0.75 else NARROW)
    rows = [row for row in report["rungs"] if row["name"] != report["reference"]]
    low, high = _limits(ax, report, rows, relative)
    entries = _draw_front(ax, report, rows, relative)
    entries += _draw_variants(ax, rows, relative, low, high)
    entries += _draw_chosen(ax, rows, chosen, relative, low, high)
    entries += [
        Line2D([], [], **sheet.look(style.INTERVAL_LINE), label="95 % interval"),
        _draw_reference(ax, report, time),
    ]
    unit = f" [{report['loss_unit']}]" if report["loss_unit"] else ""
    what = "loss error, 95th percentile"
    how = f"{what} [% of the losses' spread]" if relative else what + unit
    panel.name_axes(ax, f"time of an episode with gradient [{time}]", how)
    _write_head(picture, ax, report)
    numbers = {name: str(number) for number, name in enumerate(keyed, start=1)}
    page.finish(picture, [*entries, *_number_entries(sheet, rows, numbers)], columns=3)
    return picture, _name(ax, _worth_naming(report, rows, chosen, relative), numbers, relative, low, high)


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


def _add_times(report: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """Add the `time` of an episode with gradient to each variant, in a unit that suits the reference; return both."""
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


def _draw_variants(ax: Axes, rows: Rows, relative: bool, low: float, high: float) -> list[Artist]:
    entries: list[Artist] = []
    sheet = page.sheet_of(ax)
    for ladder, look in style.VARIANTS.items():
        members = [row for row in rows if row["ladder"] == ladder]
        if not members:
            continue
        seconds = [row["time"] for row in members]
        errors = [_error(row, relative, low, high) for row in members]
        for x, row in zip(seconds, members, strict=True):
            ends = _ends(row, relative)
            if ends["value"] is not None:
                top = high if ends["high"] is None else ends["high"]
                ax.plot(
                    [x, x],
                    [max(ends["low"] or low, low), max(top, low)],
                    gid=INTERVAL,
                    **sheet.look(style.INTERVAL_LINE),
                )
        lost = sum(_ends(row, relative)["value"] is None for row in members)
        label = f"{ladder} ({lost} failed too often: on the edge)" if lost else ladder
        mark = sheet.look(style.VARIANT_MARK | look)
        ax.plot(seconds, errors, **mark, gid=ladder, clip_on=False)
        entries.append(Line2D([], [], **mark, label=label))
    return entries


def _draw_chosen(
    ax: Axes, rows: Rows, chosen: Mapping[str, str], relative: bool, low: float, high: float
) -> list[Artist]:
    """Draw a ring around each variant that a fidelity's name should mean."""
    entries: list[Artist] = []
    sheet = page.sheet_of(ax)
    for name, variant in chosen.items():
        row = next(row for row in rows if row["name"] == variant)
        mark = sheet.look(style.CHOSEN_MARK | style.CHOSEN.get(name, {}))
        ax.plot([row["time"]], [_error(row, relative, low, high)], **mark, gid=f"chosen-{name}", clip_on=False)
        entries.append(Line2D([], [], **mark, label=f"chosen as {name}"))
    return entries


def _worth_naming(report: Mapping[str, Any], rows: Rows, chosen: Mapping[str, str], relative: bool) -> Rows:
    """Return the variants that have a name in the picture: of dozens of mixed ones, the front's and the chosen."""
    front = {rows[k]["name"] for k in _front(report, rows, relative)}
    return [row for row in rows if row["ladder"] != "mixed" or row["name"] in front | set(chosen.values())]


def _front(report: Mapping[str, Any], rows: Rows, relative: bool) -> list[int]:
    """Return the numbers of those quicker than the reference that no other beats, the quickest first."""
    end = _reference(report)["time"]
    errors = [np.inf if (off := _ends(row, relative)["value"]) is None or row["time"] >= end else off for row in rows]
    return pareto_front([row["time"] for row in rows], errors)


def _draw_front(ax: Axes, report: Mapping[str, Any], rows: Rows, relative: bool) -> list[Artist]:
    """Draw the Pareto front as steps: the least error that is to be had for at most so much time."""
    best = [rows[k] for k in _front(report, rows, relative)]
    if not best:
        return []
    bottom = ax.get_ylim()[0]
    x = [*(row["time"] for row in best), _reference(report)["time"]]
    y = [*(_error(row, relative, bottom, bottom) for row in best), bottom]
    look = page.sheet_of(ax).look(style.FRONT)
    return list(ax.step(x, y, where="post", **look, label="front", gid="front"))


def _reference(report: Mapping[str, Any]) -> Mapping[str, Any]:
    (row,) = (row for row in report["rungs"] if row["name"] == report["reference"])
    found: Mapping[str, Any] = row
    return found


def _draw_reference(ax: Axes, report: Mapping[str, Any], unit: str) -> Artist:
    row = _reference(report)
    seconds = row["time"]
    label = f"{row['name']}: {style.number(seconds)} {unit}, error 0 by definition"
    line: Artist = ax.axvline(seconds, **page.sheet_of(ax).look(style.REFERENCE_LINE), label=label)
    return line


def _number_entries(sheet: style.Sheet, rows: Rows, numbers: Mapping[str, str]) -> list[Artist]:
    """Return the legend entries of the variants that are named by number."""
    found = {row["name"]: row for row in rows}
    looks = {name: sheet.look(style.VARIANT_MARK | style.VARIANTS[found[name]["ladder"]]) for name in numbers}
    return [
        Line2D([], [], **looks[name], label=f"{number}: {short_name(found[name])}") for name, number in numbers.items()
    ]


def _name(ax: Axes, rows: Rows, numbers: Mapping[str, str], relative: bool, low: float, high: float) -> list[str]:
    """Name the variants where the name covers no mark, no front and if possible no interval; return those without room.

    Variants whose number is in the legend come first, then the named fidelities.
    """
    sheet = page.sheet_of(ax)
    lines = [line for line in ax.lines if line.get_gid()]
    clear, rather = (
        np.concatenate([labels.NOTHING, *(_outline(line) for line in lines if (line.get_gid() == INTERVAL) == soft)])
        for soft in (False, True)
    )
    rows = sorted(rows, key=lambda row: (row["name"] not in numbers, row["ladder"] != "named"))
    names = [
        labels.Name(numbers.get(row["name"], short_name(row)), (row["time"], _error(row, relative, low, high)))
        for row in rows
    ]
    gaps = [gap * sheet.type for gap in GAPS]
    left = labels.place(ax, names, clear, rather=rather, size=sheet.small, gaps=gaps)
    return [rows[number]["name"] for number in left]


def short_name(row: Mapping[str, Any]) -> str:
    """Return a variant's name without what its mark says: of standard-dt-x0.5, standard \N{MULTIPLICATION SIGN}0.5."""
    base, *turned = str(row["name"]).replace(" on ", "-").split("-")
    if row["ladder"] in ("named", "mixed") or not turned:
        return str(row["name"])
    return f"{base} " + re.sub(r"^x(?=[\d.])", "\N{MULTIPLICATION SIGN}", turned[-1])


def _outline(line: Line2D) -> NDArray[np.float64]:
    """Return points of what a name should not cover: markers, or places along an interval or a line of steps."""
    points = np.asarray(line.get_xydata(), dtype=float)
    if line.get_gid() not in ("front", INTERVAL):
        return points
    corners = np.insert(points, range(1, len(points)), np.column_stack([points[1:, 0], points[:-1, 1]]), axis=0)
    share = np.linspace(0, 1, 64)[:, None, None]
    between: NDArray[np.float64] = np.exp((1 - share) * np.log(corners[:-1]) + share * np.log(corners[1:]))
    return between.reshape(-1, 2)


def _write_head(picture: page.Picture, ax: Axes, report: Mapping[str, Any]) -> None:
    page.entitle(picture, f"{report['env']} · accuracy against time · {report['points']} points")
    known = {**report["provenance"], **report["identity"]}
    said = [f"{known[key]}" for key in ("device", "created", "command") if known.get(key)]
    if report["spread"] is not None:
        said.insert(0, f"spread {style.number(report['spread'])} {report['loss_unit']}".rstrip())
    page.remark(ax, " · ".join(said))
