"""How far gradients hold: against what losses do over steps of many lengths, and what kinds of points there are."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MultipleLocator

from ...checks.examination import percent
from ...checks.slopes import BAD, STEPS, Kind
from ...checks.usefulness import LONGEST, OPTIMISER_STEPS, SHORTEST, Usefulness
from ...statistics import Estimate
from .. import style
from . import page

if TYPE_CHECKING:
    from ....jobs.check import CheckReport

PITCH, SHAPE = 8.6, 0.66  # width on a screen [inch]; height of the curves' panel, against its width
PARTS, CURVES = 10, 7  # columns of a wide page, and those of them that the curves have
NARROWEST_PAIR = 130.0  # width of a page with both panels side by side [mm]
BARS = 0.62  # height of the panel of kinds below the curves on a narrow page, against its width
REACH = 1.6  # what the axis of steps reaches beyond both ends, as a ratio
LOWEST, HIGHEST = -1.05, 1.55  # of the axis of shares: what lies beyond is drawn on the edge, with its value
PAD = 0.06  # between a curve and the edge of its panel
TICKS, WIDE_TICKS, WIDE = 0.25, 0.5, 1.4  # of the axis of shares, and those where it spans more than so much
EDGE_MARKS = {"beyond": ("v", "^"), "within": ("_", "_")}  # at both ends of an interval
NAMED = 3  # parameters, at most
NOTHING = "no slope to compare:\nlosses are flat,\nlost in noise, or failed"
LABELS = {
    "cosine": "cosine of gradients and differences over the step",
    "sign": "share of slopes whose sign is right",
    "smoothed": "mean gradient within the step, as a share of the slope of the smoothed loss (1: unbiased)",
}


def check_figure(found: CheckReport, *, width: float | None = None) -> page.Picture:
    """Draw cosine, signs and bias of gradients over the length of a step, with 95 % intervals, and kinds of points.

    All three are 1 where a gradient foretells what the loss does. Where too few changes are clear of the noise the
    ground is grey. What optimisers step at first is dotted.

    Raises ValueError where the page is too narrow or too wide.
    """
    pair = width is None or width >= NARROWEST_PAIR
    sheet = style.Sheet.of(width, pitch=PITCH)
    picture = page.Picture(sheet, sheet.width)
    if pair:
        parts = picture.add_gridspec(1, PARTS)
        curves, bars = picture.add_subplot(parts[0, :CURVES]), picture.add_subplot(parts[0, CURVES:])
    else:
        rows = picture.add_gridspec(2, 1, height_ratios=(SHAPE, BARS))
        curves, bars = picture.add_subplot(rows[0]), picture.add_subplot(rows[1])
        bars.set_box_aspect(BARS)
    curves.set_box_aspect(SHAPE)
    entries = _draw_curves(curves, found.usefulness)
    _draw_kinds(bars, found.kinds)
    page.entitle(picture, f"{found.env} · {found.fidelity} · {_verdict(found)}")
    page.remark(curves, _causes(found))
    heading = " · ".join(filter(None, (found.device, found.engine, found.command)))
    page.finish(picture, entries, columns=2, heading=heading)
    return picture


def _verdict(found: CheckReport) -> str:
    """Say in a sentence what the check says of gradients, with its interval."""
    share, ends = found.share, "check passes" if found.passed else "check fails"
    if share is None:
        return f"{ends}: there is no gradient to compare"
    if not share.judged:
        return f"{ends}: none of {share.points} points could be judged"
    though = "" if found.passed or share.wrong else ", though"
    bad = " or ".join(str(kind) for kind in BAD if found.kinds.get(kind)) or "wrong"
    return f"{ends}{though or ':'} gradients are {bad} at {share.describe()}"


def _causes(found: CheckReport) -> str:
    """Name the causes, by which parameters and where; of a gradient that is right, say what may have been missed."""
    said = []
    for one in found.diagnoses:
        more = " and others" if len(one.parameters) > NAMED else ""
        by = f" by {', '.join(one.parameters[:NAMED])}{more}" if one.parameters and one.region is None else ""
        where = f", with {one.region.rule}" if one.region else ""
        said.append(f"{one.cause or 'no known cause'} ({one.certainty}){by}{where}")
    if found.share and found.share.judged and not found.share.wrong:
        said.append(f"a defect in less than {percent(found.share.missed)} of the box may be missed")
    return "; ".join(said)


@dataclass(frozen=True)
class _Curve:
    """One quantity over steps: a point for each step of the ladder, None where nothing could be compared."""

    name: str
    points: Sequence[tuple[float, Estimate | None]]
    compared: bool

    @classmethod
    def of(cls, name: str, curve: Sequence[Usefulness]) -> _Curve:
        """Return one of `cosine` and `sign`."""
        known = {one.step: getattr(one, name) for one in curve if one.compared}
        steps = sorted({*known, *(step for step in STEPS if SHORTEST <= step <= LONGEST)})
        found = [(step, known.get(step)) for step in steps]
        points = [(step, one if one and math.isfinite(one.value) else None) for step, one in found]
        return cls(name, points, bool(known))

    def runs(self) -> Iterator[list[tuple[float, Estimate]]]:
        """Yield the parts of it without gaps."""
        run: list[tuple[float, Estimate]] = []
        for step, one in self.points:
            if one is not None:
                run.append((step, one))
            elif run:
                yield run
                run = []
        if run:
            yield run


def _draw_curves(ax: Axes, curve: Sequence[Usefulness]) -> list[Artist]:
    """Draw all curves; return the entries of the legend."""
    page.dress(ax)
    ax.set_xlim(SHORTEST / REACH, LONGEST * REACH)
    cosine, sign = (_Curve.of(name, curve) for name in ("cosine", "sign"))
    smoothed = [(one.step, _kept(one.bias)) for one in curve if math.isfinite(one.bias.value)]
    known = [one for _, one in (*cosine.points, *sign.points, *smoothed) if one is not None]
    ends = [end for one in known for end in (one.value, one.low, one.high) if math.isfinite(end)]
    low, high = max(LOWEST, min([-PAD, *(end - PAD for end in ends)])), min(HIGHEST, max([1.0, *ends]) + PAD)
    ax.set_ylim(low, high)
    ax.yaxis.set_major_locator(MultipleLocator(WIDE_TICKS if high - low > WIDE else TICKS))
    _draw_levels(ax)
    entries = [entry for one in (cosine, sign) for entry in _draw_curve(ax, one)] + _draw_smoothed(ax, smoothed)
    entries += [Patch(facecolor=style.FAINT, linewidth=0.0, label="bands and bars: 95 % intervals")] if known else []
    entries += [*_draw_gaps(ax, sign), *_draw_steps(ax)]
    page.log_axis(ax.xaxis)
    page.name_axes(ax, "length of a step [share of the box]", "gradient against the loss: 1 is right")
    if not known:
        size = page.sheet_of(ax).label
        ax.text(0.32, 0.5, NOTHING, transform=ax.transAxes, size=size, ha="center", va="center", **style.NAME_TEXT)
    return entries


def _kept(bias: Estimate) -> Estimate:
    """Return the share of the smoothed slope that means of gradients have, from that which they lack."""
    return Estimate(1 - bias.value, 1 - bias.high, 1 - bias.low)


def _draw_curve(ax: Axes, curve: _Curve) -> list[Artist]:
    sheet, look = page.sheet_of(ax), style.CHECKED[curve.name]
    drawn = False
    for run in curve.runs():
        steps = [step for step, _ in run]
        low, high = [one.low for _, one in run], [one.high for _, one in run]
        if len(run) > 1:
            ax.fill_between(steps, low, high, color=look["color"], **style.CHECKED_BAND, gid=f"{curve.name}-interval")
        else:
            ax.plot(steps * 2, [low[0], high[0]], color=look["color"], alpha=0.4, gid=f"{curve.name}-interval")
        ax.plot(steps, [one.value for _, one in run], **sheet.look(look), clip_on=False, gid=curve.name)
        drawn = True
    if drawn or curve.name == "sign":
        return [Line2D([], [], **sheet.look(look), label=LABELS[curve.name])] if drawn else []
    return [Patch(visible=False, label="no cosine: all gradients, or all slopes, are 0")] if curve.compared else []


def _draw_smoothed(ax: Axes, points: Sequence[tuple[float, Estimate]]) -> list[Artist]:
    """Draw what means of gradients have of the smoothed slope; an arrow says that it goes on beyond the panel."""
    sheet = page.sheet_of(ax)
    look, (low, high) = sheet.look(style.CHECKED["smoothed"]), ax.get_ylim()
    line = look | {"marker": "", "linestyle": "solid"}
    for step, one in points:
        ends = [min(max(end, low), high) for end in (one.low, one.high)]
        ax.plot([step, step], ends, **line, gid="smoothed-interval")
        for side, (end, whole) in enumerate(zip(ends, (one.low, one.high), strict=True)):
            mark = EDGE_MARKS["within" if end == whole else "beyond"][side]
            ax.plot([step], [end], **look | {"marker": mark, "markerfacecolor": look["color"]}, clip_on=False)
        if low <= one.value <= high:
            ax.plot([step], [one.value], **look, clip_on=False, gid="smoothed")
    beyond = [f"{style.number(one.value, '.2g')} at {step:g}" for step, one in points if not low <= one.value <= high]
    said = LABELS["smoothed"] + (f"; beyond the panel: {', '.join(beyond)}" if beyond else "")
    return [Line2D([], [], **look, label=said)] if points else []


def _draw_gaps(ax: Axes, curve: _Curve) -> list[Artist]:
    """Shade the steps over which too few changes are clear of the noise, halfway to their neighbours."""
    low, high = ax.get_xlim()
    steps = [step for step, _ in curve.points]
    edges = [low, *(math.sqrt(one * other) for one, other in pairwise(steps)), high]
    lost = [ends for ends, (_, one) in zip(pairwise(edges), curve.points, strict=True) if one is None]
    for start, end in lost:
        ax.axvspan(start, end, **style.NO_SLOPE, zorder=0, gid="gap")
    return [Patch(**style.NO_SLOPE, label="too few changes of the loss are clear of its noise")] if lost else []


def _draw_levels(ax: Axes) -> None:
    """Draw where a gradient is right, and where it says nothing."""
    look = page.sheet_of(ax).look(style.REFERENCE_LINE)
    ax.axhline(1.0, **look)
    ax.axhline(0.0, **look | {"linestyle": "solid", "color": style.FAINT})


def _draw_steps(ax: Axes) -> list[Artist]:
    sheet = page.sheet_of(ax)
    look = sheet.look(style.STEP_LINE)
    for name, step in OPTIMISER_STEPS.items():
        ax.axvline(step, **look, gid="optimiser")
        ax.annotate(
            name, (step, 0.0), (-4 * sheet.type, 4 * sheet.type), xycoords=("data", "axes fraction"),
            textcoords="offset points", rotation=90, size=sheet.small, ha="right", va="bottom", **style.NAME_TEXT,
        )  # fmt: skip
    return [Line2D([], [], **look, label="first step of an optimiser (at most, of gradient descent)")]


def _draw_kinds(ax: Axes, kinds: Mapping[Kind, int]) -> None:
    """Draw a bar for each kind of points, with their number."""
    page.dress(ax)
    sheet, total = page.sheet_of(ax), sum(kinds.values())
    for row, kind in enumerate(Kind):
        count = kinds.get(kind, 0)
        ax.barh(row, count, height=0.66, **style.POINT_KINDS[kind], gid="kind")
        ax.annotate(
            str(count), (count, row), (3 * sheet.type, 0), textcoords="offset points", size=sheet.tick, va="center",
            color=style.INK if count else style.QUIET,
        )  # fmt: skip
    ax.set_yticks(range(len(Kind)), [str(kind) for kind in Kind])
    ax.set_ylim(len(Kind) - 0.4, -0.6)
    ax.set_xlim(0, 1.22 * max([1, *kinds.values()]))
    page.name_axes(ax, "number of points")
    page.caption(ax, f"{total} random points" if total else "no gradient was compared")
