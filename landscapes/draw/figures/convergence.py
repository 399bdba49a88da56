"""Self-convergence: the change of losses from level to level against the width of the levels (matplotlib)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes

from .. import style
from . import page

if TYPE_CHECKING:
    from ....studies.convergence import ConvergenceRecord, Move, SettingConvergence

PITCH, SHAPE = 5.2, 0.8  # room of a panel on a screen [inch]; its height, against its width
COLUMN, FLAT = 3, 0.34  # panels of that shape that a column of a page has room for, and the shape of more
ROW = 0.07  # of a flat panel's width: what a name next to it takes
REACH = 1.8  # what the axes reach beyond the marks, as a ratio
KINDS = {"p95": ("95th percentile", 0.45), "median": ("median over the points", 1.0)}  # of moves, and their opacity
MIN_MOVE = 1e-16  # of the spread: what is drawn on the lower edge of rounding
WIDTHS = {
    "dt": "time step [s]",
    "resolution": "cell width, relative to the reference",
    "particles": "particle distance, relative to the reference",
    "joint": "cell width, relative to the reference; step in proportion",
}


def convergence_figure(found: ConvergenceRecord, *, width: float | None = None) -> page.Picture:
    """Draw a panel for each setting, and one for distributions if there are any.

    Marks are the change of the loss from a level to the next finer one: the median over the points and, paler, the 95th
    percentile, both with intervals. The dashed line is the slope of the designed order, and the shaded area has those
    within the interval of the observed order. The dotted line is the floor. The grey line is the limit of the rule, a
    tenth of standard's error. Precision has only two levels and no panel.

    Raises ValueError if the page is too narrow or too wide.
    """
    drawn = [one for one in found.settings if one.setting in WIDTHS and one.moves]
    count = len(drawn) + bool(found.distributions)
    sheet = style.Sheet.of(width, pitch=PITCH, columns=min(2, max(1, count)), panels=max(1, count))
    picture, axes = page.panels(sheet, max(1, count))
    flat = sheet.columns == 1 and count > COLUMN
    for ax in axes:
        ax.set_box_aspect(FLAT if flat else SHAPE)
    for ax, one in zip(axes, drawn, strict=False):
        _draw_setting(ax, one, found)
    if found.distributions:
        _draw_distributions(axes[-1], found)
        axes[-1].set_box_aspect(max(FLAT, ROW * len(found.distributions.compared)) if flat else SHAPE)
    page.entitle(picture, f"{found.env} · self-convergence · {found.points} points")
    look = {"color": style.QUIET, "marker": "o", "linestyle": "solid", "linewidth": 1.0}
    shown = [page.sign(sheet, name, look | {"alpha": alpha}) for name, alpha in KINDS.values() if drawn]
    page.finish(picture, shown, columns=3, heading=" · ".join(page.made_by(found)))
    return picture


def _draw_setting(ax: Axes, one: SettingConvergence, found: ConvergenceRecord) -> None:
    page.dress(ax)
    for kind, (_, alpha) in KINDS.items():
        _draw_moves(ax, one.moves, kind, style.VARIANTS[one.setting] | {"alpha": alpha})
    ends = page.ends_of(move_ for move in one.moves for move_ in (move.median, move.p95))
    values = [*np.maximum(ends[np.isfinite(ends)], MIN_MOVE)] or [MIN_MOVE, 1.0]
    widths = [move.width for move in one.moves]
    ax.set(xlim=(min(widths) / REACH**0.5, max(widths) * REACH**0.5), ylim=(min(values) / REACH, max(values) * REACH))
    _draw_design(ax, one)
    _draw_levels(ax, one, found)
    page.log_axis(ax.xaxis, ax.yaxis)
    page.name_axes(ax, WIDTHS[one.setting], f"change of the loss{' [share of the spread]' if found.spread else ''}")
    page.caption(ax, _title(one))


def _draw_moves(ax: Axes, moves: Sequence[Move], kind: str, look: dict[str, object]) -> None:
    ends, widths = page.ends_of(getattr(move, kind) for move in moves), np.array([move.width for move in moves])
    known = np.isfinite(ends[:, 0])
    ends = np.maximum(np.where(np.isfinite(ends), ends, ends[:, :1]), MIN_MOVE)
    for width, (_, low, high) in zip(widths[known], ends[known], strict=True):
        page.interval(ax, [width, width], [low, high], label=None)
    line = page.sheet_of(ax).look(style.VARIANT_MARK | look | {"linestyle": "solid"})
    ax.plot(widths[known], ends[known, 0], **line, gid=kind)


def _draw_design(ax: Axes, one: SettingConvergence) -> None:
    """Draw the slopes of the designed order and of the observed order's interval, through the medians."""
    known = [(move.width, move.median.value) for move in one.moves if move.median.value]
    if not known:
        return
    widths, values = np.array(known).T
    middle, height = np.exp(np.log(widths).mean()), np.exp(np.log(values).mean())
    span = np.geomspace(*ax.get_xlim(), 32)
    if one.order.low is not None and one.order.high is not None and one.verdict == "converges":
        edges = [height * (span / middle) ** order for order in (one.order.low, one.order.high)]
        band: dict[str, Any] = {"color": style.BAND[0], "linewidth": 0.0, "zorder": 0, "gid": "observed"}
        ax.fill_between(span, *edges, **band, label="observed order, 95 %")
    if one.designed is not None:
        look = page.sheet_of(ax).look({"color": style.INK, "linewidth": 0.9, "linestyle": (0, (5, 2)), "zorder": 1})
        ax.plot(span, height * (span / middle) ** one.designed, **look, gid="design", label="designed order")


def _draw_levels(ax: Axes, one: SettingConvergence, found: ConvergenceRecord) -> None:
    """Draw the floor, the limit of the rule, and the reference's distance from Richardson's limit."""
    sheet, off = page.sheet_of(ax), found.rule.off.value
    left = next((one.median.value for one in found.remainders if one.name == found.reference), None)
    lines = {
        "rule": (0.1 * off if off else None, "solid", "a tenth of standard's error"),
        "floor": (one.floor, (0, (1, 1.5)), "floor"),
        "limit": (left, (0, (6, 1.5, 1, 1.5)), "reference to Richardson's limit, median"),
    }
    for gid, (value, dashes, said) in lines.items():
        low, high = ax.get_ylim()
        if value and low / 30 < value < 30 * high:
            look = sheet.look({"color": style.QUIET, "linewidth": 1.0, "linestyle": dashes, "zorder": 0.5})
            ax.axhline(value, **look, gid=gid, label=said)
            ax.set_ylim(min(low, value / REACH), max(high, value * REACH))


def _title(one: SettingConvergence) -> str:
    order = one.order
    if order.value is None:
        return f"{one.setting}: {one.verdict}"
    ends = " to ".join("?" if end is None else style.number(end, ".2g") for end in (order.low, order.high))
    return f"{one.setting}: {one.verdict}, order {style.number(order.value, '.2g')} ({ends})"


def _draw_distributions(ax: Axes, found: ConvergenceRecord) -> None:
    """Draw the Wasserstein distances of each fidelity's losses from the reference's, and the noise."""
    apart = found.distributions
    assert apart is not None
    page.dress(ax)
    ends = page.ends_of(one.distance.wasserstein for one in apart.compared)
    look = style.VARIANT_MARK | {"color": style.LOSS_LINE, "marker": "o"}
    page.draw_rows(ax, np.where(np.isfinite(ends), ends, ends[:, :1]), look, "", gid="distance")
    if limit := apart.noise_limit["wasserstein"]:
        said = "noise: the reference repeated (95 %)"
        ax.axvspan(0, limit, color=style.BAND[0], zorder=0, gid="noise", label=said)
    ax.set_yticks(range(len(apart.compared)), [one.name.removeprefix("reference-") for one in apart.compared])
    ax.set_xlim(left=0)
    ax.margins(y=0.15)
    page.name_axes(ax, "Wasserstein distance from the reference [share of the spread]")
    page.caption(ax, f"losses over {apart.neighbourhoods} neighbourhoods")
