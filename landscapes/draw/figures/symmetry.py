"""Symmetry: differences of each replica's losses and gradients from those of the scene itself (matplotlib)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .. import style
from . import page

if TYPE_CHECKING:
    from ....studies.symmetry import SymmetryRecord

PITCH, ROW, LEAST = 6.2, 0.09, 0.3  # room of a panel on a screen [inch]; height of a row and least height, by width
MARK = style.VARIANT_MARK | {"color": style.LOSS_LINE, "marker": "o"}


def symmetry_figure(found: SymmetryRecord, *, width: float | None = None) -> page.Picture:
    """Draw a row for each replica: the difference of losses, and the cosines of gradients with the scene's own.

    Marks are the share of the range and the median cosine, both with 95 % intervals. Hollow marks are the lower
    quartile of cosines. The shaded band is the interval of the floor of all replicas together.

    Raises ValueError if the page is too narrow or too wide.
    """
    replicas, share = found.replicas, found.floor.share
    picture, axes = page.panels(style.Sheet.of(width, pitch=PITCH, columns=1, panels=2), 2)
    hollow = picture.sheet.look(MARK | {"markerfacecolor": "white", "markeredgecolor": style.LOSS_LINE})
    low = [one.cosine_low for one in replicas]
    axes[1].plot(low, range(len(low)), **hollow, gid="quartile", label="lower quartile")
    estimates = ([one.apart for one in replicas], [one.cosine for one in replicas])
    for ax, values, unit in zip(axes, estimates, (100.0, 1.0), strict=True):
        page.dress(ax)
        ax.set_box_aspect(max(LEAST, ROW * len(replicas)))
        label = "a replica against the scene itself"
        page.draw_rows(ax, unit * page.ends_of(values), MARK, label, gid="replica")
        ax.set_yticks(range(len(replicas)), [one.name for one in replicas])
        ax.set_ylim(len(replicas) - 0.5, -0.5)
    if np.isfinite(share.low):
        ends = 100 * share.low, 100 * share.high
        axes[0].axvspan(*ends, color=style.BAND[0], zorder=0, gid="floor", label="all replicas together")
    axes[0].set_xlim(left=0)
    page.name_axes(axes[0], "difference of losses [% of the range]")
    page.name_axes(axes[1], "cosine of gradients with the scene's")
    page.entitle(picture, f"{found.env} · symmetry · {found.fidelity}, {found.points} points")
    page.finish(picture, heading=" · ".join(page.made_by(found)))
    return picture
