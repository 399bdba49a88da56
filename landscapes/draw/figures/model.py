"""What each part of a model is for: the time that changing it saves against how far it moves losses (matplotlib)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from .. import style
from . import page

if TYPE_CHECKING:
    from ....studies.model import MeasuredPart, ModelRecord
    from ....studies.samples import Bootstrap

PITCH, SHAPE, NARROW = 7.2, 0.58, 0.9  # room on a screen [inch]; the panel's height against its width, there and narrow
GAPS = (7.0, 12.0, 18.0, 25.0, 34.0, 44.0)  # of a name from its mark, on a screen [pt]
REACH, MARGIN = 2.0, 0.12  # what the axes reach beyond the outermost marks: as a ratio, and as a share of the width
MIN_SPAN = 4.0  # per cent of an episode that the axis of times spans at least, to either side


def model_figure(study: ModelRecord, *, width: float | None = None) -> page.Picture:
    """Draw how far changing each part moves losses, the 95th percentile, over the time of an episode that it saves.

    Both have their intervals. A part that the full model has is a filled mark; one that is missing, which its options
    put in, a hollow one. What moves no loss is on the lower edge, what fails too often on the upper. Where there is
    little room a line leads to the name, or the name is in the legend, by number.

    Raises ValueError where the page is too narrow or too wide.
    """
    sheet = style.Sheet.of(width, pitch=PITCH)
    keyed: list[str] = []
    while True:
        picture, left = _draw(study, sheet, keyed)
        if set(left) <= set(keyed):
            return picture
        keyed += [name for name in left if name not in keyed]


def _draw(study: ModelRecord, sheet: style.Sheet, keyed: Sequence[str]) -> tuple[page.Picture, list[str]]:
    """Draw the picture, with the `keyed` parts named by number; return it and the names that found no room."""
    picture = page.Picture(sheet, sheet.width)
    ax = picture.subplots()
    page.dress(ax)
    ax.set_box_aspect(SHAPE if sheet.zoom > 0.75 else NARROW)
    places = _limits(ax, study)
    entries = [*_draw_parts(ax, study, places), *_draw_lines(ax, study)]
    unit = "% of the losses' spread" if study.spread else study.loss_unit
    page.name_axes(
        ax,
        "time saved by the change [% of an episode with gradient]",
        "change of the loss, 95th percentile" + (f" [{unit}]" if unit else ""),
    )
    _write_head(picture, ax, study)
    numbers = {name: str(number) for number, name in enumerate(keyed, start=1)}
    page.finish(picture, [*entries, *_number_entries(sheet, study, numbers)], columns=2)
    return picture, _name(ax, study, numbers, places)


def _saved(part: MeasuredPart) -> NDArray[np.float64]:
    """Return the time that changing a part saves and the ends of its interval [%]."""
    ratios = (part.cost.value, part.cost.high, part.cost.low)
    return np.array([np.nan if ratio is None else 100 * (1 - ratio) for ratio in ratios])


def _error(found: Any, relative: bool) -> Bootstrap:
    """Return the percentile of a comparison's errors [% of the spread, or loss unit]."""
    error: Bootstrap = found.loss_error.p95_relative.share(0.01) if relative else found.loss_error.p95
    return error


def _floor(study: ModelRecord) -> float | None:
    """Return the noise of the full model as the errors are measured, None where it fails too often to have one."""
    relative = study.spread is not None
    value = _error(study.noise.comparison, relative).value
    digit = 100 * study.noise.digit / study.spread if study.spread else study.noise.digit
    return None if value is None else max(value, digit)


def _limits(ax: Axes, study: ModelRecord) -> dict[str, tuple[float, float]]:
    """Span what is drawn, with no time saved in sight; return where each part's mark is."""
    relative = study.spread is not None
    found = {part.name: _error(part.comparison, relative) for part in study.parts}
    sizes = [_floor(study), *(end for one in found.values() for end in (one.value, one.low, one.high))]
    known = [size for size in sizes if size] or [1.0]
    low, high = min(known) / REACH, max(known) * REACH
    saved = np.array([_saved(part) for part in study.parts]).reshape(-1, 3)
    ends = np.append(saved[np.isfinite(saved)], (-MIN_SPAN, MIN_SPAN))
    margin = MARGIN * np.ptp(ends)
    ax.set_xlim(float(ends.min() - margin), float(ends.max() + margin))
    ax.set_ylim(low, high)
    style.log_axis(ax.yaxis)
    heights = {name: high if one.value is None else max(one.value, low) for name, one in found.items()}
    return {part.name: (float(_saved(part)[0]), heights[part.name]) for part in study.parts}


def _draw_parts(ax: Axes, study: ModelRecord, places: dict[str, tuple[float, float]]) -> list[Artist]:
    """Draw a mark for each part with its intervals; return the entries of the legend."""
    sheet = page.sheet_of(ax)
    how, (bottom, top) = sheet.look(style.INTERVAL_LINE), ax.get_ylim()
    for part in study.parts:
        (x, y), (_, left, right) = places[part.name], _saved(part)
        error = _error(part.comparison, study.spread is not None)
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


def _number_entries(sheet: style.Sheet, study: ModelRecord, numbers: dict[str, str]) -> list[Artist]:
    """Return the legend entries of the parts that are named by number."""
    parts = {part.name: part for part in study.parts}
    return [Line2D([], [], **_look(sheet, parts[name]), label=f"{number}: {name}") for name, number in numbers.items()]


def _name(ax: Axes, study: ModelRecord, numbers: dict[str, str], places: dict[str, tuple[float, float]]) -> list[str]:
    """Name the parts where the name covers no mark and if possible no line; return those without room.

    Parts whose number is in the legend come first.
    """
    sheet = page.sheet_of(ax)
    clear = np.array(list(places.values())).reshape(-1, 2)
    rather = np.concatenate([page.NOTHING, *(_along(ax, line) for line in ax.lines)])
    parts = sorted(study.parts, key=lambda part: part.name not in numbers)
    names = [page.Label(numbers.get(part.name, part.name), places[part.name]) for part in parts]
    gaps = [gap * sheet.type for gap in GAPS]
    left = page.place_labels(ax, names, clear, rather=rather, size=sheet.small, gaps=gaps)
    return [parts[number].name for number in left]


def _along(ax: Axes, line: Line2D) -> NDArray[np.float64]:
    """Return points along a straight line [data]; one across the panel ends at its edges."""
    ends = line.get_transform().transform(np.asarray(line.get_xydata(), dtype=float))
    between = ends[0] + np.linspace(0, 1, 64)[:, None] * (ends[-1] - ends[0])
    found: NDArray[np.float64] = ax.transData.inverted().transform(between)
    return found


def _write_head(picture: page.Picture, ax: Axes, study: ModelRecord) -> None:
    page.entitle(picture, f"{study.env} · what each part of the model is for · {study.fidelity}, {study.points} points")
    known = {**study.provenance, **study.identity}
    said = [f"{known[key]}" for key in ("device", "created", "command") if known.get(key)]
    if study.spread is not None:
        said.insert(0, f"spread {style.number(study.spread)} {study.loss_unit}".rstrip())
    page.remark(ax, " · ".join(said))
