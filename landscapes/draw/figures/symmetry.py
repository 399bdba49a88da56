"""Symmetry: how far the losses and gradients of each replica are from those of the scene itself (matplotlib)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from .. import style
from . import page

if TYPE_CHECKING:
    from ....studies.symmetry import MeasuredReplica, SymmetryRecord
    from ...statistics import Estimate

PITCH, ROW, LEAST = 6.2, 0.09, 0.3  # room of a panel on a screen [inch]; height of a row and least height, by width


def symmetry_figure(found: SymmetryRecord, *, width: float | None = None) -> page.Picture:
    """Draw a row for each replica: how far losses are apart, and the cosines of gradients with the scene's own.

    Marks are the share of the range and the median cosine, both with 95 % intervals; hollow is the lower quartile of
    cosines. Shaded is the floor of all replicas together, within its interval.

    Raises ValueError where the page is too narrow or too wide.
    """
    sheet = style.Sheet.of(width, pitch=PITCH, columns=1, panels=2)
    picture = page.Picture(sheet, sheet.width)
    axes = page.grid(picture, 2)
    for ax in axes:
        page.dress(ax)
        ax.set_box_aspect(max(LEAST, ROW * len(found.replicas)))
    _draw_losses(axes[0], found)
    _draw_gradients(axes[1], found.replicas)
    look = sheet.look(style.VARIANT_MARK | {"color": style.LOSS_LINE, "marker": "o"})
    entries = [
        Line2D([], [], **look, label="a replica against the scene itself"),
        Line2D([], [], **sheet.look(style.INTERVAL_LINE), label="95 % interval"),
        Line2D(
            [], [], **{**look, "markerfacecolor": "white", "markeredgecolor": style.LOSS_LINE}, label="lower quartile"
        ),
        Patch(color=style.BAND[0], label="all replicas together"),
    ]
    page.entitle(picture, f"{found.env} · symmetry · {found.fidelity}, {found.points} points")
    page.finish(picture, entries, columns=2, heading=" · ".join(page.made_by(found)))
    return picture


def _draw_losses(ax: Axes, found: SymmetryRecord) -> None:
    """Draw how far losses are apart, in per cent of the range."""
    _draw_rows(ax, found.replicas, [one.apart for one in found.replicas], unit=100.0)
    share = found.floor.share
    if np.isfinite(share.low):
        ax.axvspan(100 * share.low, 100 * share.high, color=style.BAND[0], zorder=0, gid="floor")
    ax.set_xlim(left=0)
    page.name_axes(ax, "losses apart [% of the range]")


def _draw_gradients(ax: Axes, replicas: Sequence[MeasuredReplica]) -> None:
    """Draw the cosines of gradients."""
    look = page.sheet_of(ax).look(style.VARIANT_MARK | {"color": style.LOSS_LINE, "marker": "o"})
    hollow = {**look, "markerfacecolor": "white", "markeredgecolor": style.LOSS_LINE}
    ax.plot([one.cosine_low for one in replicas], range(len(replicas)), **hollow, gid="quartile")
    _draw_rows(ax, replicas, [one.cosine for one in replicas])
    page.name_axes(ax, "cosine of gradients with the scene's")


def _draw_rows(ax: Axes, replicas: Sequence[MeasuredReplica], values: Sequence[Estimate], unit: float = 1.0) -> None:
    """Draw an estimate with its interval in each replica's row, named on the left, the first one on top."""
    sheet = page.sheet_of(ax)
    look = sheet.look(style.VARIANT_MARK | {"color": style.LOSS_LINE, "marker": "o"})
    for place, one in enumerate(values):
        ax.plot([unit * one.low, unit * one.high], [place, place], **sheet.look(style.INTERVAL_LINE), gid="interval")
        ax.plot([unit * one.value], [place], **look, gid="replica")
    ax.set_yticks(range(len(replicas)), [one.name for one in replicas])
    ax.set_ylim(len(replicas) - 0.5, -0.5)
