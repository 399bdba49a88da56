"""Accuracy against time: variants of settings with their Pareto front, and the contribution of each model part."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import cbook
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.path import Path
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
FRONT = "front"
REACH = 1.6  # what the axes reach beyond the outermost variants, as a ratio
PART_REACH, MARGIN = 2.0, 0.12  # and beyond the outermost parts: as a ratio, and as a share of the width
MIN_SPAN = 4.0  # per cent of an episode that the axis of times saved spans at least, to either side

Ends = tuple[float, float]


@dataclass(frozen=True, eq=False)
class _Mark:
    """The mark of a variant or a model part: its position, its look, and the ends of its intervals, if any."""

    name: str
    said: str
    at: Ends
    look: dict[str, Any]
    up: Ends | None
    across: Ends | None = None
    named: bool = True


def _draw_named(
    width: float | None, marks: Sequence[_Mark], draw: Callable[[Axes], None], *, columns: int
) -> page.Picture:
    """Return a picture of one panel, drawn again until each name fits in it or, by number, in the legend."""
    sheet = style.Sheet.of(width, pitch=PITCH)
    keyed: list[_Mark] = []
    while True:
        picture, ax = page.panel(sheet, SHAPE if sheet.zoom > 0.75 else NARROW)
        draw(ax)
        page.finish(
            picture,
            [page.sign(sheet, f"{number}: {mark.said}", mark.look) for number, mark in enumerate(keyed, start=1)],
            columns=columns,
        )
        left = _name(ax, keyed, [mark for mark in marks if mark.named and mark not in keyed])
        if set(left) <= set(keyed):  # only among dozens in one place a number finds no room
            return picture
        keyed += [mark for mark in left if mark not in keyed]


def _name(ax: Axes, keyed: Sequence[_Mark], others: Sequence[_Mark]) -> list[_Mark]:
    """Write the numbers of some marks and the names of others, and return the marks whose name does not fit.

    The texts cover no mark, no front and, if possible, no other line.
    """
    sheet, marks = page.sheet_of(ax), [*keyed, *others]
    labels = [page.Label(str(number), mark.at) for number, mark in enumerate(keyed, start=1)]
    labels += [page.Label(mark.said, mark.at) for mark in others]
    hard = [line for line in ax.lines if line.get_linestyle() == "None" or line.get_gid() == FRONT]
    soft = [line for line in ax.lines if line not in hard]
    clear, rather = (np.concatenate([page.NOTHING, *(_along(ax, line) for line in lines)]) for lines in (hard, soft))
    gaps = [gap * sheet.type for gap in GAPS]
    left = page.place_labels(ax, labels, clear, rather=rather, size=sheet.small, gaps=gaps)
    return [marks[number] for number in left]


def _along(ax: Axes, line: Line2D) -> NDArray[np.float64]:
    """Return points along a line as it is drawn, in steps or across the whole panel [data]."""
    points = np.asarray(line.get_xydata(), dtype=float)
    if line.get_linestyle() == "None" or not len(points):
        return points
    steps = cbook.STEP_LOOKUP_MAP[line.get_drawstyle()](*points.T)
    path = Path(line.get_transform().transform(np.column_stack(steps))).interpolated(64)
    found: NDArray[np.float64] = ax.transData.inverted().transform(path.vertices)
    return found


def _draw_marks(ax: Axes, marks: Iterable[_Mark], label: str, gid: str) -> None:
    """Draw marks with the same look, and their intervals."""
    drawn, sheet = list(marks), page.sheet_of(ax)
    for mark in drawn:
        x, y = mark.at
        if mark.up:
            page.interval(ax, [x, x], mark.up, label=None)
        if mark.across:
            page.interval(ax, mark.across, [y, y], label=None)
    at = zip(*(mark.at for mark in drawn), strict=True)
    ax.plot(*at, **sheet.look(drawn[0].look), clip_on=False, gid=gid, label=label)


def _write_head(ax: Axes, record: FidelityRecord | ModelRecord, title: str, y: str) -> None:
    """Write the title, how the record was made, the label of the vertical axis, and the meaning of thin lines."""
    page.interval(ax, [], [])
    page.entitle(page.picture_of(ax), title)
    spread = [] if record.spread is None else [f"spread {style.number(record.spread)} {record.loss_unit}".rstrip()]
    page.remark(ax, " · ".join([*spread, *page.made_by(record)]))
    unit = record.loss_unit if record.spread is None else "% of the losses' spread"
    page.name_axes(ax, y=labelled(f"{y}, 95th percentile", unit))


def _percentile(found: Any, record: FidelityRecord | ModelRecord) -> Bootstrap:
    """Return the 95th percentile of a comparison's errors [% of the spread, or loss unit]."""
    error = found.loss_error
    percentile: Bootstrap = error.p95 if record.spread is None else error.p95_relative.share(0.01)
    return percentile


def _height(found: Bootstrap, low: float, high: float) -> tuple[float, Ends | None]:
    """Return the height of a percentile within both edges, the upper one if it is infinite, and its interval."""
    if found.value is None:
        return high, None
    ends = (found.low or low, high if found.high is None else found.high)
    return max(found.value, low), (max(ends[0], low), max(ends[1], low))


def mixed_figure(record: MixedRecord, *, width: float | None = None) -> page.Picture:
    """Draw all variants of a search like `fidelity_figure`, with marks for the present and the chosen ones."""
    return fidelity_figure(record.measured, width=width, chosen=record.chosen)


def fidelity_figure(
    record: FidelityRecord, *, width: float | None = None, chosen: Mapping[str, str] | None = None
) -> page.Picture:
    """Draw the 95th percentile of each variant's loss errors, with its interval, over the time of an episode.

    The reference is a line at its time, because its own error is zero by definition. Variants without a finite
    percentile are on the upper edge and counted in the legend. Those without any error are on the lower edge, and those
    given up are not drawn. The mark of a variant says which option was changed, and its name says from which fidelity
    and to what. Where space is short, a line leads to the name, or the legend has it by number. Of mixed variants, only
    those on the front and the `chosen` ones have names. A chosen variant has a ring; its key in `chosen` is the
    fidelity that should have its settings.

    Raises ValueError if the page is too narrow or too wide.
    """
    chosen, reference = chosen or {}, record.variant(record.reference)
    factor, unit = (1.0, "s") if reference.seconds >= 2.0 else (1e3, "ms")
    rows = [row for row in record.variants if row is not reference and not row.given_up]
    found = [_percentile(row.comparison, record) for row in rows]
    errors = [end for one in found for end in (one.value, one.low, one.high) if end] or [1e-3, 1.0]
    low, high = min(errors) / REACH, max(errors) * REACH
    marks = []
    for row, error in zip(rows, found, strict=True):
        y, ends = _height(error, low, high)
        look = style.VARIANT_MARK | style.VARIANTS[row.changed]
        named = row.changed != "mixed" or row.name in {*record.front, *chosen.values()}
        marks.append(_Mark(row.name, short_name(row), (factor * row.seconds, y), look, ends, named=named))
    end = factor * reference.seconds, low
    seconds = [mark.at[0] for mark in marks] + [end[0]]

    def draw(ax: Axes) -> None:
        ax.set(xlim=(min(seconds) / REACH, max(seconds) * REACH), ylim=(low, high))
        page.log_axis(ax.xaxis, ax.yaxis)
        _draw_variants(ax, record, {mark.name: mark for mark in marks}, chosen, end)
        said = f"{reference.name}: {style.number(end[0])} {unit}, error 0 by definition"
        ax.axvline(end[0], **page.sheet_of(ax).look(style.REFERENCE_LINE), label=said)
        page.name_axes(ax, f"time of an episode with gradient [{unit}]")
        _write_head(ax, record, f"{record.env} · accuracy against time · {record.points} points", "loss error")

    order = sorted(marks, key=lambda mark: record.variant(mark.name).changed != "named")
    return _draw_named(width, order, draw, columns=3)


def _draw_variants(
    ax: Axes, record: FidelityRecord, marks: Mapping[str, _Mark], chosen: Mapping[str, str], end: Ends
) -> None:
    """Draw variants by changed option, rings around the chosen ones, and the front from its shortest time to `end`."""
    sheet = page.sheet_of(ax)
    if record.front:  # the least error that is to be had for at most so much time
        x, y = zip(*(marks[name].at for name in record.front), end, strict=True)
        ax.step(x, y, where="post", **sheet.look(style.FRONT), label=FRONT, gid=FRONT)
    for changed in style.VARIANTS:
        if own := [mark for name, mark in marks.items() if record.variant(name).changed == changed]:
            lost = sum(mark.up is None for mark in own)
            label = f"{changed} ({lost} failed too often: on the edge)" if lost else changed
            _draw_marks(ax, own, label, changed)
    for name, variant in chosen.items():
        ring = sheet.look(style.CHOSEN_MARK | style.CHOSEN.get(name, {}))
        ax.plot(*marks[variant].at, **ring, gid=f"chosen-{name}", clip_on=False, label=f"chosen as {name}")


def short_name(row: MeasuredVariant) -> str:
    """Return a variant's name without what its mark shows: standard-dt-x0.5 is standard \N{MULTIPLICATION SIGN}0.5."""
    base, *turned = row.name.replace(" on ", "-").split("-")
    if row.changed in ("named", "mixed") or not turned:
        return row.name
    return f"{base} " + re.sub(r"^x(?=[\d.])", "\N{MULTIPLICATION SIGN}", turned[-1])


def model_figure(study: ModelRecord, *, width: float | None = None) -> page.Picture:
    """Draw the change of the loss, 95th percentile, against the time saved, for each changed part of a model.

    Both have their intervals. A part of the full model is a filled mark. A missing part, which its options add, is a
    hollow one. Parts that change no loss are on the lower edge, and those that fail too often are on the upper edge.
    Where space is short, a line leads to the name, or the legend has it by number.

    Raises ValueError if the page is too narrow or too wide.
    """
    found = [_percentile(part.comparison, study) for part in study.parts]
    noise = _noise(study)
    known = [end for end in (noise, *(end for one in found for end in (one.value, one.low, one.high))) if end] or [1.0]
    low, high = min(known) / PART_REACH, max(known) * PART_REACH
    marks = [_part_mark(part, one, low, high) for part, one in zip(study.parts, found, strict=True)]
    saved = [end for mark in marks for end in (mark.at[0], *(mark.across or ())) if np.isfinite(end)]
    left, right = min([-MIN_SPAN, *saved]), max([MIN_SPAN, *saved])
    room = MARGIN * (right - left)

    def draw(ax: Axes) -> None:
        ax.set(xlim=(left - room, right + room), ylim=(low, high))
        page.log_axis(ax.yaxis)
        _sign_effects(ax, study)
        for mark in marks:
            _draw_marks(ax, [mark], "", "part")
        sheet = page.sheet_of(ax)
        ax.axvline(0.0, **sheet.look(style.REFERENCE_LINE), label="the full model's time")
        if noise:
            unit = " %" if study.spread else f" {study.loss_unit}".rstrip()
            said = f"noise of the full model: {style.number(noise, '.2g')}{unit}"
            ax.axhline(noise, **sheet.look(style.NOISE_LINE), label=said)
        page.name_axes(ax, "time saved by the change [% of an episode with gradient]")
        title = f"{study.env} · what each part of the model contributes · {study.fidelity}, {study.points} points"
        _write_head(ax, study, title, "change of the loss")

    return _draw_named(width, marks, draw, columns=2)


def _sign_effects(ax: Axes, study: ModelRecord) -> None:
    """Put the effects that occur into the legend, in order."""
    looks = {effect: look for effect, look in style.EFFECTS.items() if any(p.effect == effect for p in study.parts)}
    if study.missing:
        hollow = {"marker": "o", "markeredgecolor": style.INK} | style.MISSING_MARK
        looks["hollow: missing, added by the change"] = hollow
    for label, look in looks.items():
        ax.plot([], [], **page.sheet_of(ax).look(style.VARIANT_MARK | look), label=label)


def _part_mark(part: MeasuredPart, found: Bootstrap, low: float, high: float) -> _Mark:
    """Return the mark of a part at the time that its change saves [%]."""
    ratios = (part.cost.value, part.cost.high, part.cost.low)
    saved, *ends = (np.nan if ratio is None else 100 * (1 - ratio) for ratio in ratios)
    y, up = _height(found, low, high)
    look = style.VARIANT_MARK | style.EFFECTS[part.effect]
    if part.missing:
        look |= style.MISSING_MARK | {"markeredgecolor": look["color"]}
    return _Mark(part.name, part.name, (saved, y), look, up, (ends[0], ends[1]))


def _noise(study: ModelRecord) -> float | None:
    """Return the noise of the full model in the unit of the errors, or None if it fails too often."""
    value = _percentile(study.noise.comparison, study).value
    digit = 100 * study.noise.digit / study.spread if study.spread else study.noise.digit
    return None if value is None else max(value, digit)
