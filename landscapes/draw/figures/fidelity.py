"""Accuracy against time: the variants of a study and their Pareto front (matplotlib)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from .. import style
from . import page

if TYPE_CHECKING:
    from ....studies.fidelity import FidelityRecord, MeasuredVariant
    from ....studies.mixed import MixedRecord

PITCH, SHAPE, NARROW = (
    7.2,
    0.58,
    0.9,
)  # width on a screen [inch]; the panel's height against its width, there and narrow
GAPS = (7.0, 12.0, 18.0, 25.0, 34.0, 44.0)  # of a name from its mark, on a screen [pt]
INTERVAL = "interval"
REACH = 1.6  # what the axes reach beyond the outermost variants, as a ratio

Rows = Sequence["MeasuredVariant"]


def mixed_figure(record: MixedRecord, *, width: float | None = None) -> page.Picture:
    """Draw all variants of a search as `fidelity_figure` does, those of today's names and the chosen ones marked."""
    return fidelity_figure(record.measured, width=width, chosen=record.chosen)


def fidelity_figure(
    record: FidelityRecord, *, width: float | None = None, chosen: Mapping[str, str] | None = None
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
        picture, left = _Drawing(record, chosen or {}).draw(sheet, keyed)
        if set(left) <= set(keyed):  # only among dozens of variants in one place a number finds no room
            return picture
        keyed += [name for name in left if name not in keyed]


class _Drawing:
    """What is drawn of a record: its variants but the reference, times in a unit that suits that one, and errors."""

    def __init__(self, record: FidelityRecord, chosen: Mapping[str, str]) -> None:
        self.record, self.chosen = record, chosen
        self.reference = record.variant(record.reference)
        self.rows = [row for row in record.variants if row is not self.reference]
        self.relative = record.spread is not None
        self.factor, self.unit = (1.0, "s") if self.reference.seconds >= 2.0 else (1e3, "ms")
        self.low, self.high = 1e-3, 1.0  # the errors of the lower and the upper edge

    def draw(self, sheet: style.Sheet, keyed: Sequence[str]) -> tuple[page.Picture, list[str]]:
        """Draw the picture, with the `keyed` variants named by number; return it and the names that found no room."""
        record = self.record
        picture = page.Picture(sheet, sheet.width)
        ax = picture.subplots()
        page.dress(ax)
        ax.set_box_aspect(SHAPE if sheet.zoom > 0.75 else NARROW)
        self._limit(ax)
        entries = [*self._draw_front(ax), *self._draw_variants(ax), *self._draw_chosen(ax)]
        entries += [Line2D([], [], **sheet.look(style.INTERVAL_LINE), label="95 % interval"), self._draw_reference(ax)]
        unit = f" [{record.loss_unit}]" if record.loss_unit else ""
        what = "loss error, 95th percentile"
        how = f"{what} [% of the losses' spread]" if self.relative else what + unit
        page.name_axes(ax, f"time of an episode with gradient [{self.unit}]", how)
        self._write_head(picture, ax)
        numbers = {name: str(number) for number, name in enumerate(keyed, start=1)}
        page.finish(picture, [*entries, *self._number_entries(sheet, numbers)], columns=3)
        return picture, self._name(ax, numbers)

    def _time(self, row: MeasuredVariant) -> float:
        return self.factor * row.seconds

    def _ends(self, row: MeasuredVariant) -> list[float | None]:
        """Return the percentile and the ends of its interval, in percent or in the loss's unit."""
        error = row.comparison.loss_error
        found = error.p95_relative.share(0.01) if self.relative else error.p95
        return [found.value, found.low, found.high]

    def _error(self, row: MeasuredVariant) -> float:
        """Return where a variant stands."""
        value = self._ends(row)[0]
        return self.high if value is None else max(value, self.low)

    def _limit(self, ax: Axes) -> None:
        """Span what is drawn, on logarithmic axes."""
        seconds = [self._time(row) for row in self.record.variants]
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
        sheet = page.sheet_of(ax)
        lines = [line for line in ax.lines if line.get_gid()]
        clear, rather = (
            np.concatenate([page.NOTHING, *(_outline(line) for line in lines if (line.get_gid() == INTERVAL) == soft)])
            for soft in (False, True)
        )
        worth = {*self.record.front, *self.chosen.values()}
        rows = [row for row in self.rows if row.changed != "mixed" or row.name in worth]
        rows.sort(key=lambda row: (row.name not in numbers, row.changed != "named"))
        names = [
            page.Label(numbers.get(row.name, short_name(row)), (self._time(row), self._error(row))) for row in rows
        ]
        gaps = [gap * sheet.type for gap in GAPS]
        left = page.place_labels(ax, names, clear, rather=rather, size=sheet.small, gaps=gaps)
        return [rows[number].name for number in left]

    def _write_head(self, picture: page.Picture, ax: Axes) -> None:
        record = self.record
        page.entitle(picture, f"{record.env} · accuracy against time · {record.points} points")
        known = {**record.provenance, **record.identity}
        said = [f"{known[key]}" for key in ("device", "created", "command") if known.get(key)]
        if record.spread is not None:
            said.insert(0, f"spread {style.number(record.spread)} {record.loss_unit}".rstrip())
        page.remark(ax, " · ".join(said))


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
