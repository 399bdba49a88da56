"""How far gradients predict the loss, over steps of many lengths, and the numbers of points of each kind."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from ...checks.examination import percent
from ...checks.slopes import BAD, STEPS, Kind
from ...checks.usefulness import LONGEST, OPTIMISER_STEPS, SHORTEST, UNKNOWN, Usefulness
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
    "sign": "share of slopes with the right sign",
    "smoothed": "mean gradient within the step, as a share of the slope of the smoothed loss (1: unbiased)",
}


def check_figure(found: CheckReport, *, width: float | None = None) -> page.Picture:
    """Draw cosine, signs and bias of gradients over the length of a step, with 95 % intervals, and kinds of points.

    All three are 1 where a gradient predicts the change of the loss. The background is grey where too few changes are
    above the noise. Dotted lines are the first steps of optimisers.

    Raises ValueError if the page is too narrow or too wide.
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
    more = _draw_curves(curves, found.usefulness)
    _draw_kinds(bars, found.kinds)
    page.entitle(picture, f"{found.env} · {found.fidelity} · {_verdict(found)}")
    page.remark(curves, _causes(found))
    heading = " · ".join(filter(None, (found.device, found.engine, found.command)))
    page.finish(picture, more, heading=heading)
    return picture


def _verdict(found: CheckReport) -> str:
    """Return the verdict of the check on gradients in a sentence, with its interval."""
    share, ends = found.share, "check passes" if found.passed else "check fails"
    if share is None:
        return f"{ends}: no gradient to compare"
    if not share.judged:
        return f"{ends}: none of {share.points} points could be judged"
    though = "" if found.passed or share.wrong else ", though"
    bad = " or ".join(str(kind) for kind in BAD if found.kinds.get(kind)) or "wrong"
    return f"{ends}{though or ':'} gradients are {bad} at {share.describe()}"


def _causes(found: CheckReport) -> str:
    """Name the causes with their parameters and regions; for right gradients, say what the check may have missed."""
    said = []
    for one in found.diagnoses:
        more = " and others" if len(one.parameters) > NAMED else ""
        by = f" by {', '.join(one.parameters[:NAMED])}{more}" if one.parameters and one.region is None else ""
        where = f", with {one.region.rule}" if one.region else ""
        said.append(f"{one.cause or 'no known cause'} ({one.certainty}){by}{where}")
    if found.share and found.share.judged and not found.share.wrong:
        said.append(f"a defect in less than {percent(found.share.missed)} of the box could be missed")
    return "; ".join(said)


def _curve(name: str, curve: Sequence[Usefulness]) -> tuple[page.Grid, page.Grid]:
    """Return steps and the cosine or sign at each, in the form of `page.ends_of`, NaN where none is compared."""
    known = {one.step: getattr(one, name) for one in curve if one.compared}
    steps = sorted({*known, *(step for step in STEPS if SHORTEST <= step <= LONGEST)})
    ends = page.ends_of(known.get(step, UNKNOWN) for step in steps)
    return np.array(steps), np.where(np.isfinite(ends[:, :1]), ends, np.nan)


def _draw_curves(ax: Axes, curve: Sequence[Usefulness]) -> list[Artist | str]:
    """Draw all curves, and return further entries of the legend."""
    page.dress(ax)
    ax.set_xlim(SHORTEST / REACH, LONGEST * REACH)
    (steps, cosine), (_, sign) = (_curve(name, curve) for name in ("cosine", "sign"))
    biased = [one for one in curve if math.isfinite(one.bias.value)]
    kept = 1 - page.ends_of(one.bias for one in biased)[:, [0, 2, 1]]  # what means of gradients have of the slope
    known = np.concatenate([cosine, sign, kept])
    ends = known[np.isfinite(known)].tolist()
    low, high = max(LOWEST, min([-PAD, *(end - PAD for end in ends)])), min(HIGHEST, max([1.0, *ends]) + PAD)
    ax.set_ylim(low, high)
    ax.yaxis.set_major_locator(MultipleLocator(WIDE_TICKS if high - low > WIDE else TICKS))
    _draw_levels(ax)
    for name, values in (("cosine", cosine), ("sign", sign)):
        _draw_curve(ax, name, steps, values)
    _draw_smoothed(ax, [one.step for one in biased], kept)
    _draw_gaps(ax, steps, np.isnan(sign[:, 0]))
    _draw_steps(ax)
    page.log_axis(ax.xaxis)
    page.name_axes(ax, "length of a step [share of the box]", "gradient against the loss: 1 is right")
    if not ends:
        size = page.sheet_of(ax).label
        ax.text(0.32, 0.5, NOTHING, transform=ax.transAxes, size=size, ha="center", va="center", **style.NAME_TEXT)
        return []
    flat = np.isnan(cosine).all() and not np.isnan(sign).all()
    bands = Patch(facecolor=style.FAINT, linewidth=0.0, label="bands and bars: 95 % intervals")
    return ["no cosine: all gradients, or all slopes, are 0", bands] if flat else [bands]


def _draw_curve(ax: Axes, name: str, steps: page.Grid, ends: page.Grid) -> None:
    """Draw a curve with its band; both break where nothing could be compared, and a single point has a bar."""
    look, (value, low, high) = style.CHECKED[name], ends.T
    known = np.isfinite(value)
    if not known.any():
        return
    beside = np.pad(known, 1)
    alone = known & ~beside[:-2] & ~beside[2:]
    about = {"color": look["color"], "gid": f"{name}-interval"}
    ax.fill_between(steps, low, high, **about, **style.CHECKED_BAND)
    ax.vlines(steps[alone], low[alone], high[alone], **about, alpha=0.4)
    ax.plot(steps, value, **page.sheet_of(ax).look(look), clip_on=False, gid=name, label=LABELS[name])


def _draw_smoothed(ax: Axes, steps: Sequence[float], kept: page.Grid) -> None:
    """Draw mean gradients as a share of the smoothed slope; an arrow marks values beyond the panel."""
    look, (low, high) = page.sheet_of(ax).look(style.CHECKED["smoothed"]), ax.get_ylim()
    line = look | {"marker": "", "linestyle": "solid"}
    beyond = []
    for step, (value, *whole) in zip(steps, kept.tolist(), strict=True):
        ends = [min(max(end, low), high) for end in whole]
        ax.plot([step, step], ends, **line, gid="smoothed-interval")
        for side in (0, 1):
            mark = EDGE_MARKS["within" if ends[side] == whole[side] else "beyond"][side]
            ax.plot([step], [ends[side]], **look | {"marker": mark, "markerfacecolor": look["color"]}, clip_on=False)
        if low <= value <= high:
            ax.plot([step], [value], **look, clip_on=False, gid="smoothed")
        else:
            beyond.append(f"{style.number(value, '.2g')} at {step:g}")
    if steps:
        said = LABELS["smoothed"] + (f"; beyond the panel: {', '.join(beyond)}" if beyond else "")
        ax.plot([], [], **look, label=said)


def _draw_gaps(ax: Axes, steps: page.Grid, lost: NDArray[np.bool_]) -> None:
    """Shade the steps with too few changes above the noise, halfway to their neighbours."""
    low, high = ax.get_xlim()
    edges = [low, *np.sqrt(steps[1:] * steps[:-1]), high]
    label = "too few changes of the loss above its noise"
    for start, end in np.array(list(pairwise(edges)))[lost]:
        ax.axvspan(start, end, **style.NO_SLOPE, zorder=0, gid="gap", label=label)


def _draw_levels(ax: Axes) -> None:
    """Draw the levels of a right gradient and of one without information."""
    look = page.sheet_of(ax).look(style.REFERENCE_LINE)
    ax.axhline(1.0, **look)
    ax.axhline(0.0, **look | {"linestyle": "solid", "color": style.FAINT})


def _draw_steps(ax: Axes) -> None:
    sheet = page.sheet_of(ax)
    look = sheet.look(style.STEP_LINE)
    for name, step in OPTIMISER_STEPS.items():
        ax.axvline(step, **look, gid="optimiser", label="first step of an optimiser (for gradient descent: at most)")
        ax.annotate(
            name, (step, 0.0), (-4 * sheet.type, 4 * sheet.type), xycoords=("data", "axes fraction"),
            textcoords="offset points", rotation=90, size=sheet.small, ha="right", va="bottom", **style.NAME_TEXT,
        )  # fmt: skip


def _draw_kinds(ax: Axes, kinds: Mapping[Kind, int]) -> None:
    """Draw a bar for each kind of point, with its number."""
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
