"""A census as small multiples: every slice, the least rugged first (matplotlib)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from matplotlib.patches import Patch
from numpy.typing import NDArray

from .. import style
from . import page, panel

if TYPE_CHECKING:
    from ...measures.census import Census

PITCH, ACROSS = 8.0, 8  # room on a screen [inch]; slices side by side
FOOT = 4  # words that the legend has, the most frequent first


def census_figure(census: Census, *, width: float | None = None) -> page.Picture:
    """Draw the losses of every slice on one scale, the least rugged first, row by row.

    Slices are ordered by the share of steps that turn back. What failed or lies outside the box is grey. The legend
    says which share of the slices each word fits.

    Raises ValueError where the page is too narrow or too wide.
    """
    sheet = style.Sheet.of(width, pitch=PITCH)
    across = min(ACROSS, math.ceil(math.sqrt(len(census.slices))))
    rows = -(-len(census.slices) // across)
    picture = page.Picture(sheet, sheet.width * rows / across)
    axes = list(picture.subplots(rows, across, squeeze=False).flat)
    scale = style.Scale.of_loss(np.asarray(census.losses, dtype=float))
    for ax, number in zip(axes, census.order, strict=False):
        drawn = _draw(ax, census.losses[number], scale)
    for empty in axes[len(census.slices) :]:
        empty.set_axis_off()
    unit = f" [{census.loss_unit}]" if census.loss_unit else ""
    panel.colour_bar(axes[0], drawn, f"loss{unit}", scale, beside=axes)
    many = f"{len(census.slices)} slices, the least rugged first"
    page.entitle(picture, f"{census.env} · census at {census.fidelity} · {many}")
    page.finish(picture, _words(census), columns=2, heading=_made(census))
    return picture


def _draw(ax: Axes, loss: NDArray[np.float32], scale: style.Scale) -> AxesImage:
    ax.set(xticks=[], yticks=[], facecolor=style.UNSAMPLED)
    ax.set_box_aspect(1)
    ax.spines[:].set(color=style.QUIET, linewidth=0.4)
    shown = np.ma.masked_invalid(loss)
    return ax.imshow(
        shown, origin="lower", aspect="auto", interpolation="nearest", cmap=style.LOSS_MAP, norm=scale.norm
    )


def _made(census: Census) -> str:
    known = (census.identity.get("device"), census.provenance.get("created"), census.command)
    return " · ".join(str(one) for one in known if one)


def _words(census: Census) -> list[Patch]:
    """Return legend entries without a sign that say how often each word fits, the most frequent first."""
    shares = sorted(census.words.items(), key=lambda one: -one[1].value)
    said = [
        f"{word}: {100 * share.value:.0f} % ({100 * share.low:.0f} to {100 * share.high:.0f})"
        for word, share in shares
        if share.value > 0
    ]
    return [Patch(visible=False, label=text) for text in said[: 2 * FOOT]]
