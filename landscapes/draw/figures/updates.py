"""Updates: the distribution of losses after single updates, and after random steps of equal length (matplotlib)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...space import labelled
from .. import style
from . import page

if TYPE_CHECKING:
    from ....studies.updates import UpdatesRecord

PITCH, SHAPE = 6.2, 0.6  # room of the panel on a screen [inch]; its height by its width


def updates_figure(found: UpdatesRecord, *, width: float | None = None) -> page.Picture:
    """Draw the cumulative share of steps by loss, for updates along the gradient and random steps of equal length.

    The dashed line is the loss before. It meets a curve at the share of steps that do not increase the loss. The losses
    whose return is in the left tail are shaded. A curve ends below one if simulations failed, or if losses are far off
    the axis.

    Raises ValueError if the page is too narrow or too wide.
    """
    picture, ax = page.panel(style.Sheet.of(width, pitch=PITCH), SHAPE)
    sheet = picture.sheet
    both = [np.sort(np.array(one.losses)) for one in (found.along, found.random)]
    scale = style.Scale.of_loss(np.concatenate([*both, [found.before]]))
    low, high = scale.ends
    room = 0.04 * (high - low)
    left, right = (0.9 * low, 1.1 * high) if scale.logarithmic else (low - room, high + room)
    for one, losses, look in zip((found.along, found.random), both, style.PAIR, strict=True):
        known = losses[np.isfinite(losses)]
        share = np.arange(len(known) + 1) / len(losses)
        label = f"{one.name}: {one.failed} failed" if one.failed else one.name
        line = {name: value for name, value in look.items() if name != "marker"}
        ends = [min(left, known.min(initial=left)), *known, max(right, known.max(initial=right))]
        ax.step(ends, [*share, share[-1]], where="post", label=label, gid="steps", **sheet.look(line))
    ax.axvline(found.before, gid="before", label="loss before", **sheet.look(style.REFERENCE_LINE))
    if found.along.tail_from < right:
        span = max(left, found.along.tail_from), right
        ax.axvspan(*span, color=style.BAND[0], zorder=0, gid="tail", label="left tail of returns")
    ax.set(xlim=(left, right), ylim=(0, 1.02))
    if scale.logarithmic:
        page.log_axis(ax.xaxis)
    page.name_axes(ax, labelled("loss after one update", found.loss_unit), "share of steps")
    page.entitle(picture, f"{found.env} · {found.points} updates from {found.through}")
    page.finish(picture, heading=" · ".join(page.made_by(found)))
    return picture
