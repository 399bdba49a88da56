"""Accuracy against time: variants of settings with their Pareto front, and what each part of a model is for."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ...space import labelled
from .. import style
from . import page

if TYPE_CHECKING:
    from ....studies.fidelity import FidelityRecord, MeasuredVariant
    from ....studies.mixed import MixedRecord
    from ....studies.model import MeasuredPart, ModelRecord
    from ....studies.samples import Bootstrap

PITCH, SHAPE, NARROW = 7.2, 0.58, 0.9  # room on a screen [inch]; the panel's height against its width, there and narrow
GAPS = (7.0, 12.0, 18.0, 25.0, 34.0, 44.0)  # of a name from its mark, on a screen [pt]
INTERVAL = "interval"
REACH = 1.6  # what the axes reach beyond the outermost variants, as a ratio
PART_REACH, MARGIN = 2.0, 0.12  # and beyond the outermost parts: as a ratio, and as a share of the width
MIN_SPAN = 4.0  # per cent of an episode that the axis of times saved spans at least, to either side

Place = tuple[float, float]


def _draw_named(sheet: style.Sheet, draw: Callable[[page.Picture, Axes, Mapping[str, str]], list[str]]) -> page.Picture:
    """Return a picture of one panel, drawn again until each name has room in it or in the legend, by its number.

    `draw` gets the numbers of those that are named in the legend, and returns the names that found no room.
    """
    keyed: list[str] = []
    while True:
        picture = page.Picture(sheet, sheet.width)
        ax = picture.subplots()
        page.dress(ax)
        ax.set_box_aspect(SHAPE if sheet.zoom > 0.75 else NARROW)
        left = draw(picture, ax, {name: str(number) for number, name in enumerate(keyed, start=1)})
        if set(left) <= set(keyed):  # only among dozens in one place a number finds no room
            return picture
        keyed += [name for name in left if name not in keyed]


def _place_names(
    ax: Axes, names: Mapping[str, str], places: Mapping[str, Place], *, clear: page.Grid, rather: page.Grid
) -> list[str]:
    """Write what stands for each name next to its place; return those that have no room."""
    sheet = page.sheet_of(ax)
    labels = [page.Label(said, places[name]) for name, said in names.items()]
    gaps = [gap * sheet.type for gap in GAPS]
    left = page.place_labels(ax, labels, clear, rather=rather, size=sheet.small, gaps=gaps)
    return [[*names][number] for number in left]


def _write_head(picture: page.Picture, ax: Axes, record: FidelityRecord | ModelRecord, title: str) -> None:
    page.entitle(picture, title)
    spread = [] if record.spread is None else [f"spread {style.number(record.spread)} {record.loss_unit}".rstrip()]
    page.remark(ax, " · ".join([*spread, *page.made_by(record)]))


def _percentile(found: Any, relative: bool) -> Bootstrap:
    """Return the 95th percentile of a comparison's errors [% of the spread, or loss unit]."""
    error: Bootstrap = found.loss_error.p95_relative.share(0.01) if relative else found.loss_error.p95
    return error


def mixed_figure(record: MixedRecord, *, width: float | None = None) -> page.Picture:
    """Draw all variants of a search as `fidelity_figure` does, those of today's names and the chosen ones marked."""
    return fidelity_figure(record.measured, width=width, chosen=record.chosen)


def fidelity_figure(
    record: FidelityRecord, *, width: float | None = None, chosen: Mapping[str, str] | None = None
) -> page.Picture:
    """Draw the 95th percentile of each variant's loss errors, with its interval, over the time of an episode.

    The reference is a line at its time: its own error is zero by definition. Variants without a finite percentile are
    on the upper edge and counted in the legend; those without any error are on the lower edge, and those given up
    nowhere. The mark of a variant
    says which option was changed, its name from which fidelity and to what. Where there is little room a line leads to
    the name, or the name is in the legend, by number. Of mixed variants only those on the front have names, and those
    that are `chosen`, by the names of fidelities that should be theirs: these have a ring.

    Raises ValueError where the page is too narrow or too wide.
    """
    return _draw_named(style.Sheet.of(width, pitch=PITCH), _Drawing(record, chosen or {}).draw)


class _Drawing:
    """What is drawn of a record: its variants but the reference, times in a unit that suits that one, and errors."""

    def __init__(self, record: FidelityRecord, chosen: Mapping[str, str]) -> None:
        self.record, self.chosen = record, chosen
        self.reference = record.variant(record.reference)
        self.rows = [row for row in record.variants if row is not self.reference and not row.given_up]
        self.relative = record.spread is not None
        self.factor, self.unit = (1.0, "s") if self.reference.seconds >= 2.0 else (1e3, "ms")
        self.low, self.high = 1e-3, 1.0  # the errors of the lower and the upper edge

    def draw(self, picture: page.Picture, ax: Axes, numbers: Mapping[str, str]) -> list[str]:
        """Draw the panel, variants with one of the `numbers` named by it; return the names that found no room."""
        record, sheet = self.record, picture.sheet
        self._limit(ax)
        entries = [*self._draw_front(ax), *self._draw_variants(ax), *self._draw_chosen(ax)]
        entries += [Line2D([], [], **sheet.look(style.INTERVAL_LINE), label="95 % interval"), self._draw_reference(ax)]
        unit = "% of the losses' spread" if self.relative else record.loss_unit
        error = labelled("loss error, 95th percentile", unit)
        page.name_axes(ax, f"time of an episode with gradient [{self.unit}]", error)
        _write_head(picture, ax, record, f"{record.env} · accuracy against time · {record.points} points")
        page.finish(picture, [*entries, *self._number_entries(sheet, numbers)], columns=3)
        return self._name(ax, numbers)

    def _time(self, row: MeasuredVariant) -> float:
        return self.factor * row.seconds

    def _ends(self, row: MeasuredVariant) -> list[float | None]:
        """Return the percentile and the ends of its interval, in percent or in the loss's unit."""
        found = _percentile(row.comparison, self.relative)
        return [found.value, found.low, found.high]

    def _error(self, row: MeasuredVariant) -> float:
        """Return where a variant stands."""
        value = self._ends(row)[0]
        return self.high if value is None else max(value, self.low)

    def _limit(self, ax: Axes) -> None:
        """Span what is drawn, on logarithmic axes."""
        seconds = [self._time(row) for row in (self.reference, *self.rows)]
        errors = [end for row in self.rows for end in self._ends(row) if end]
        low, high = (min(errors), max(errors)) if errors else (self.low, self.high)
        self.low, self.high = low / REACH, high * REACH
        ax.set_xlim(min(seconds) / REACH, max(seconds) * REACH)
        ax.set_ylim(self.low, self.high)
        for axis in (ax.xaxis, ax.yaxis):
            style.log_axis(axis)

    def _draw_variants(self, ax: Axes) -> list[Artist]:
        entries: list[Artist] = []
        sheet = page.sheet_of(ax)
        for changed, look in style.VARIANTS.items():
            members = [row for row in self.rows if row.changed == changed]
            if not members:
                continue
            for row in members:
                value, low, high = self._ends(row)
                if value is not None:
                    ends = [max(low or self.low, self.low), max(self.high if high is None else high, self.low)]
                    ax.plot([self._time(row)] * 2, ends, gid=INTERVAL, **sheet.look(style.INTERVAL_LINE))
            lost = sum(self._ends(row)[0] is None for row in members)
            label = f"{changed} ({lost} failed too often: on the edge)" if lost else changed
            mark = sheet.look(style.VARIANT_MARK | look)
            ax.plot(list(map(self._time, members)), list(map(self._error, members)), **mark, gid=changed, clip_on=False)
            entries.append(Line2D([], [], **mark, label=label))
        return entries

    def _draw_chosen(self, ax: Axes) -> list[Artist]:
        """Draw a ring around each variant that a fidelity's name should mean."""
        entries: list[Artist] = []
        sheet = page.sheet_of(ax)
        for name, variant in self.chosen.items():
            row = self.record.variant(variant)
            mark = sheet.look(style.CHOSEN_MARK | style.CHOSEN.get(name, {}))
            ax.plot([self._time(row)], [self._error(row)], **mark, gid=f"chosen-{name}", clip_on=False)
            entries.append(Line2D([], [], **mark, label=f"chosen as {name}"))
        return entries

    def _draw_front(self, ax: Axes) -> list[Artist]:
        """Draw the Pareto front as steps: the least error that is to be had for at most so much time."""
        best = [self.record.variant(name) for name in self.record.front]
        if not best:
            return []
        x = [*map(self._time, best), self._time(self.reference)]
        y = [*map(self._error, best), self.low]
        look = page.sheet_of(ax).look(style.FRONT)
        return list(ax.step(x, y, where="post", **look, label="front", gid="front"))

    def _draw_reference(self, ax: Axes) -> Artist:
        seconds = self._time(self.reference)
        label = f"{self.reference.name}: {style.number(seconds)} {self.unit}, error 0 by definition"
        line: Artist = ax.axvline(seconds, **page.sheet_of(ax).look(style.REFERENCE_LINE), label=label)
        return line

    def _number_entries(self, sheet: style.Sheet, numbers: Mapping[str, str]) -> list[Artist]:
        """Return the legend entries of the variants that are named by number."""
        found = {name: self.record.variant(name) for name in numbers}
        looks = {name: sheet.look(style.VARIANT_MARK | style.VARIANTS[row.changed]) for name, row in found.items()}
        return [
            Line2D([], [], **looks[name], label=f"{number}: {short_name(found[name])}")
            for name, number in numbers.items()
        ]

    def _name(self, ax: Axes, numbers: Mapping[str, str]) -> list[str]:
        """Name variants where a name covers no mark, no front and if possible no interval; return those without room.

        Variants whose number is in the legend come first, then the named fidelities. Of dozens of mixed ones only the
        front's and the chosen have a name.
        """
        lines = [line for line in ax.lines if line.get_gid()]
        clear, rather = (
            np.concatenate([page.NOTHING, *(_outline(line) for line in lines if (line.get_gid() == INTERVAL) == soft)])
            for soft in (False, True)
        )
        worth = {*self.record.front, *self.chosen.values()}
        rows = [row for row in self.rows if row.changed != "mixed" or row.name in worth]
        rows.sort(key=lambda row: (row.name not in numbers, row.changed != "named"))
        names = {row.name: numbers.get(row.name, short_name(row)) for row in rows}
        places = {row.name: (self._time(row), self._error(row)) for row in rows}
        return _place_names(ax, names, places, clear=clear, rather=rather)


def short_name(row: MeasuredVariant) -> str:
    """Return a variant's name without what its mark says: of standard-dt-x0.5, standard \N{MULTIPLICATION SIGN}0.5."""
    base, *turned = row.name.replace(" on ", "-").split("-")
    if row.changed in ("named", "mixed") or not turned:
        return row.name
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


def model_figure(study: ModelRecord, *, width: float | None = None) -> page.Picture:
    """Draw how far changing each part moves losses, the 95th percentile, over the time of an episode that it saves.

    Both have their intervals. A part that the full model has is a filled mark; one that is missing, which its options
    put in, a hollow one. What moves no loss is on the lower edge, what fails too often on the upper. Where there is
    little room a line leads to the name, or the name is in the legend, by number.

    Raises ValueError where the page is too narrow or too wide.
    """
    return _draw_named(style.Sheet.of(width, pitch=PITCH), partial(_draw_model, study))


def _draw_model(study: ModelRecord, picture: page.Picture, ax: Axes, numbers: Mapping[str, str]) -> list[str]:
    """Draw the panel, parts with one of the `numbers` named by it; return the names that found no room."""
    places = _limits(ax, study)
    entries = [*_draw_parts(ax, study, places), *_draw_lines(ax, study)]
    unit = "% of the losses' spread" if study.spread else study.loss_unit
    change = labelled("change of the loss, 95th percentile", unit)
    page.name_axes(ax, "time saved by the change [% of an episode with gradient]", change)
    title = f"{study.env} · what each part of the model is for · {study.fidelity}, {study.points} points"
    _write_head(picture, ax, study, title)
    page.finish(picture, [*entries, *_number_entries(picture.sheet, study, numbers)], columns=2)
    return _name(ax, study, numbers, places)


def _saved(part: MeasuredPart) -> NDArray[np.float64]:
    """Return the time that changing a part saves and the ends of its interval [%]."""
    ratios = (part.cost.value, part.cost.high, part.cost.low)
    return np.array([np.nan if ratio is None else 100 * (1 - ratio) for ratio in ratios])


def _floor(study: ModelRecord) -> float | None:
    """Return the noise of the full model as the errors are measured, None where it fails too often to have one."""
    relative = study.spread is not None
    value = _percentile(study.noise.comparison, relative).value
    digit = 100 * study.noise.digit / study.spread if study.spread else study.noise.digit
    return None if value is None else max(value, digit)


def _limits(ax: Axes, study: ModelRecord) -> dict[str, Place]:
    """Span what is drawn, with no time saved in sight; return where each part's mark is."""
    relative = study.spread is not None
    found = {part.name: _percentile(part.comparison, relative) for part in study.parts}
    sizes = [_floor(study), *(end for one in found.values() for end in (one.value, one.low, one.high))]
    known = [size for size in sizes if size] or [1.0]
    low, high = min(known) / PART_REACH, max(known) * PART_REACH
    saved = np.array([_saved(part) for part in study.parts]).reshape(-1, 3)
    ends = np.append(saved[np.isfinite(saved)], (-MIN_SPAN, MIN_SPAN))
    margin = MARGIN * np.ptp(ends)
    ax.set_xlim(float(ends.min() - margin), float(ends.max() + margin))
    ax.set_ylim(low, high)
    style.log_axis(ax.yaxis)
    heights = {name: high if one.value is None else max(one.value, low) for name, one in found.items()}
    return {part.name: (float(_saved(part)[0]), heights[part.name]) for part in study.parts}


def _draw_parts(ax: Axes, study: ModelRecord, places: dict[str, Place]) -> list[Artist]:
    """Draw a mark for each part with its intervals; return the entries of the legend."""
    sheet = page.sheet_of(ax)
    how, (bottom, top) = sheet.look(style.INTERVAL_LINE), ax.get_ylim()
    for part in study.parts:
        (x, y), (_, left, right) = places[part.name], _saved(part)
        error = _percentile(part.comparison, study.spread is not None)
        if error.value is not None:
            ends = (error.low or 0.0, top if error.high is None else error.high)
            ax.plot([x, x], [max(end, bottom) for end in ends], **how)
        ax.plot([left, right], [y, y], **how)
        ax.plot([x], [y], **_look(sheet, part), clip_on=False)
    shown = [effect for effect in style.EFFECTS if any(part.effect == effect for part in study.parts)]
    looks = {effect: style.VARIANT_MARK | style.EFFECTS[effect] for effect in shown}
    if study.missing:
        hollow = style.VARIANT_MARK | {"marker": "o", "markeredgecolor": style.INK} | style.MISSING_MARK
        looks["hollow: missing, put in by the change"] = hollow
    entries: list[Artist] = [Line2D([], [], **sheet.look(look), label=label) for label, look in looks.items()]
    return [*entries, Line2D([], [], **sheet.look(style.INTERVAL_LINE), label="95 % interval")]


def _look(sheet: style.Sheet, part: MeasuredPart) -> dict[str, Any]:
    look = style.VARIANT_MARK | style.EFFECTS[part.effect]
    if part.missing:
        look |= style.MISSING_MARK | {"markeredgecolor": look["color"]}
    return sheet.look(look)


def _draw_lines(ax: Axes, study: ModelRecord) -> list[Artist]:
    """Draw where no time is saved, and how far noise alone moves the losses."""
    sheet, floor = page.sheet_of(ax), _floor(study)
    entries: list[Artist] = [ax.axvline(0.0, **sheet.look(style.REFERENCE_LINE), label="the full model's time")]
    if floor:
        unit = " %" if study.spread else f" {study.loss_unit}".rstrip()
        label = f"noise of the full model: {style.number(floor, '.2g')}{unit}"
        entries.append(ax.axhline(floor, **sheet.look(style.NOISE_LINE), label=label))
    return entries


def _number_entries(sheet: style.Sheet, study: ModelRecord, numbers: Mapping[str, str]) -> list[Artist]:
    """Return the legend entries of the parts that are named by number."""
    parts = {part.name: part for part in study.parts}
    return [Line2D([], [], **_look(sheet, parts[name]), label=f"{number}: {name}") for name, number in numbers.items()]


def _name(ax: Axes, study: ModelRecord, numbers: Mapping[str, str], places: Mapping[str, Place]) -> list[str]:
    """Name the parts where the name covers no mark and if possible no line; return those without room.

    Parts whose number is in the legend come first.
    """
    clear = np.array(list(places.values())).reshape(-1, 2)
    rather = np.concatenate([page.NOTHING, *(_along(ax, line) for line in ax.lines)])
    parts = sorted((part.name for part in study.parts), key=lambda name: name not in numbers)
    return _place_names(ax, {name: numbers.get(name, name) for name in parts}, places, clear=clear, rather=rather)


def _along(ax: Axes, line: Line2D) -> NDArray[np.float64]:
    """Return points along a straight line [data]; one across the panel ends at its edges."""
    ends = line.get_transform().transform(np.asarray(line.get_xydata(), dtype=float))
    between = ends[0] + np.linspace(0, 1, 64)[:, None] * (ends[-1] - ends[0])
    found: NDArray[np.float64] = ax.transData.inverted().transform(between)
    return found
