"""A slice beside the same cut through other points, on one scale of losses (matplotlib)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from numpy.typing import NDArray

from ...identity import plane_of
from .. import style
from . import page, panel

PITCH, LEAST = 3.6, 40.0  # room of a panel: on a screen [inch], and at least in print [mm]
TALL = 1.05  # height of a row of panels, in that of their room


@dataclass(frozen=True, eq=False)
class CompanionSlice:
    """The losses of a cut through a named point, of shape (v, u), or (u) of a line; NaN where an episode failed."""

    through: str
    loss: NDArray[Any]

    def title(self) -> str:
        """Say where it goes through and what its losses range over."""
        finite = self.loss[np.isfinite(self.loss)]
        ends = (
            [f"{end:.3g}".replace("-", "\N{MINUS SIGN}") for end in (finite.min(), finite.max())] if finite.size else []
        )
        return f"through {spoken(self.through)}\n{' to '.join(ends) or 'all failed'}"


def spoken(through: str) -> str:
    """Say the name of a point as a sentence has it."""
    kind, _, name = through.partition(":")
    if kind == "center":
        return "the centre"
    return f"the example {name}" if kind == "example" else f"random point {name}" if kind == "random" else through


def companions_figure(
    cuts: Sequence[CompanionSlice], dataset: xr.Dataset, *, width: float | None = None
) -> page.Picture:
    """Draw cuts side by side on one scale; the first is the slice `dataset` itself, whose axes all have.

    What failed is grey. Raises ValueError where the page is too narrow or too wide.
    """
    sheet = style.Sheet.of(width, pitch=PITCH, columns=len(cuts), least=LEAST)
    rows = -(-len(cuts) // sheet.columns)
    picture = page.Picture(sheet, rows * TALL * sheet.pitch)
    axes = panel.grid(picture, len(cuts), share=True)
    scale = style.Scale.of_loss(np.concatenate([cut.loss.ravel().astype(float) for cut in cuts]))
    plane = plane_of(dataset)
    y = plane.labels[1] if plane.rank == 2 else page.loss_name(dataset)
    for ax, cut in zip(axes, cuts, strict=True):
        _draw(ax, cut, dataset, scale)
        panel.dress(ax, plane)
        if plane.rank == 1 and scale.logarithmic:
            panel.log_axis(ax.yaxis)
        panel.caption(ax, cut.title())
        panel.name_outer(ax, plane.labels[0], y)
    if plane.rank == 2:
        panel.colour_bar(axes[0], axes[0].images[0], page.loss_name(dataset), scale, beside=axes)
    page.finish(picture, [])
    return picture


def _draw(ax: Axes, cut: CompanionSlice, dataset: xr.Dataset, scale: style.Scale) -> None:
    plane = plane_of(dataset)
    ax.set_box_aspect(1)
    ends = [(float(low), float(high)) for low, high in zip(plane.lower, plane.upper, strict=True)]
    if plane.rank == 1:
        ax.plot(np.linspace(*ends[0], cut.loss.size), cut.loss, color=style.LOSS_LINE)
        return
    ax.set_facecolor(style.UNSAMPLED)
    half = [(high - low) / (count - 1) / 2 for (low, high), count in zip(ends, cut.loss.shape[::-1], strict=True)]
    (left, right), (bottom, top) = ((low - pad, high + pad) for (low, high), pad in zip(ends, half, strict=True))
    shown = np.ma.masked_invalid(cut.loss)
    ax.imshow(
        shown,
        origin="lower",
        aspect="auto",
        interpolation="nearest",
        extent=(left, right, bottom, top),
        cmap=style.LOSS_MAP,
        norm=scale.norm,
    )
    ax.set(xlim=ends[0], ylim=ends[1])
