"""A wall of landscapes: slices of many environments in one style, each with what it is like in words (matplotlib)."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from ...identity import plane_of
from ...lattice import own_cells, sampled_line
from .. import style
from . import page, panel

PITCH, ACROSS, LEAST = 2.2, 6, 28.0  # room of a landscape: on a screen [inch]; side by side there; in print [mm]
LINE = 25  # letters in a line under a landscape


@dataclass(frozen=True, eq=False)
class Landscape:
    """A slice on the wall, what it is of, and what that is like."""

    name: str
    said: str
    dataset: xr.Dataset


def wall_figure(landscapes: Sequence[Landscape], *, width: float | None = None) -> page.Picture:
    """Draw the losses of slices side by side, each on a scale of its own from its lowest, dark, to its highest, light.

    Under a plane are its axes, and under each its words. What is not OK is grey. A line is drawn as one, its loss
    upwards.

    Raises ValueError where there is no slice, or the page is too narrow or too wide.
    """
    if not landscapes:
        raise ValueError("a wall needs a landscape at least; got none")
    sheet = style.Sheet.of(
        width, pitch=PITCH, columns=min(ACROSS, len(landscapes)), panels=len(landscapes), least=LEAST
    )
    rows = -(-len(landscapes) // sheet.columns)
    picture = page.Picture(sheet, 1.15 * rows * sheet.pitch)
    for ax, one in zip(panel.grid(picture, len(landscapes)), landscapes, strict=True):
        _draw(ax, one.dataset)
        panel.caption(ax, one.name)
        said = "\n".join(textwrap.wrap(one.said.replace(" %", "\N{NO-BREAK SPACE}%"), LINE)) or " "
        ax.set_xlabel(said, size=sheet.small, color=style.QUIET, parse_math=False)
    page.entitle(picture, "Losses, each on its own scale: dark is low, light is high")
    page.finish(picture, [])
    return picture


def _draw(ax: Axes, dataset: xr.Dataset) -> None:
    ax.set(xticks=[], yticks=[], facecolor=style.UNSAMPLED)
    ax.set_box_aspect(0.75)
    ax.spines[:].set(color=style.QUIET, linewidth=0.4)
    if plane_of(dataset).rank == 1:
        line = sampled_line(dataset)
        ax.plot(line["u"], line["loss"], color=style.LOSS_LINE, linewidth=1.1)
        ax.set_facecolor("white")
        return
    loss = own_cells(dataset)["loss"].to_numpy()
    norm = style.Scale.of_loss(loss).norm
    shown = np.ma.masked_invalid(loss)
    ax.imshow(shown, origin="lower", aspect="auto", interpolation="nearest", cmap=style.LOSS_MAP, norm=norm)
