"""A sweep as a film: one frame for each of its slices, all on one colour scale (matplotlib)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from ...identity import plane_of
from .. import film, style
from . import contour, page

DPI = 120
PITCH = 6.25  # room of a panel with its colour bar on a screen [inch]
RANGE = 0.025  # height of the bar over the panels, against its width
RATES, MIN_SECONDS = (10, 5, 4, 2), 4.0  # frames per second to choose from, so that a film lasts so many seconds


@dataclass(frozen=True, eq=False)
class Sweep:
    """The same window sampled at increasing `values` of the quantity `label`, one slice for each value.

    The values of a `logarithmic` sweep increase by equal ratios.
    """

    label: str
    values: Sequence[float]
    slices: Sequence[xr.Dataset]
    logarithmic: bool = False

    @property
    def name(self) -> str:
        """The label without its unit."""
        return self.label.partition(" [")[0]

    def write_value(self, value: float) -> str:
        """Write a value with its unit, with equal decimals for all values, or equal digits in a logarithmic sweep."""
        span = abs(self.values[-1] - self.values[0])
        decimals = min(9, max(0, 2 - math.floor(math.log10(span))))
        unit = self.label.partition(" [")[2].removesuffix("]")
        return f"{style.number(value, '.3g' if self.logarithmic else f'.{decimals}f')} {unit}".rstrip()

    def plot(self, number: int = -1) -> page.Picture:
        """Draw a frame, by default the last one, on the common scales of all frames."""
        return frame_figure(self, number, Scales.of(self))


@dataclass(frozen=True, eq=False)
class Scales:
    """The common scales of all frames of a sweep; `slope` is None without gradients."""

    loss: style.Scale
    slope: style.Scale | None

    @classmethod
    def of(cls, sweep: Sweep) -> Scales:
        """Span the losses and the gradients of all frames together."""
        losses = np.stack([one["loss"].to_numpy() for one in sweep.slices])
        slope = None
        if all("grad" in one for one in sweep.slices):
            slope = style.Scale.of_magnitude(np.stack([contour.log_magnitude(one) for one in sweep.slices]))
        return cls(style.Scale.of_loss(losses), slope)


def frame_figure(
    sweep: Sweep, number: int, scales: Scales, *, width: float | None = None, like: page.Picture | None = None
) -> page.Picture:
    """Draw one frame: loss map, arrows, and the value in its range, with the layout of `like`."""
    dataset, panels = sweep.slices[number], ["loss"] if scales.slope is None else ["loss", "slope"]
    plane, sheet = plane_of(dataset), style.Sheet.of(width, pitch=PITCH, columns=len(panels))
    picture = page.Picture(sheet, sheet.width)
    below = [panels] if sheet.columns == len(panels) else [[name] for name in panels]
    rows: Any = [["range", *"." * (sheet.columns - 1)], *below]
    axes = picture.subplot_mosaic(rows, height_ratios=[RANGE, *[1.0] * len(below)])
    contour.loss_panel(axes["loss"], dataset, scales.loss)
    if scales.slope:
        contour.arrow_panel(axes["slope"], dataset, scales.slope)
    for name in panels:
        contour.frame(axes[name], dataset, plane)
        page.name_axes(axes[name], plane.labels[0])
    _draw_range(axes["range"], sweep, sweep.values[number])
    page.entitle(picture, page.title(dataset))
    page.finish(picture, columns=2 * sheet.columns, heading=page.provenance(dataset), like=like)
    return picture


def save_films(sweep: Sweep, mp4: Path, gif: Path | None, *, dpi: int = DPI, loss: int = 18) -> None:
    """Write a sweep as an MP4 and a GIF of a few seconds, one picture for each slice.

    `loss` is that of `film.save_film`.
    """
    scales, count = Scales.of(sweep), len(sweep.slices)
    fullest = max(range(count), key=lambda number: len(np.unique(sweep.slices[number]["status"])))
    like = frame_figure(sweep, fullest, scales)
    pictures = (film.picture(frame_figure(sweep, number, scales, like=like), dpi=dpi) for number in range(count))
    rate = next((rate for rate in RATES if count / rate >= MIN_SECONDS), RATES[-1])
    film.save_film(pictures, mp4, gif, count=count, rate=rate, loss=loss)


def _draw_range(ax: Axes, sweep: Sweep, value: float) -> None:
    """Write the value, and mark it on a bar from the lowest to the highest."""
    ends, sheet = (sweep.values[0], sweep.values[-1]), page.sheet_of(ax)
    low, high, here = ((math.log10(one) if sweep.logarithmic else one) for one in (*ends, value))
    ax.set_gid("range")
    ax.set_box_aspect(RANGE)
    ax.set_axis_off()
    ax.set_xlim(low, high)
    ax.set_ylim(-1, 1)
    bar = sheet.look({"linewidth": 3, "solid_capstyle": "round", "clip_on": False})
    ax.plot([low, high], [0, 0], color=style.FAINT, **bar)
    ax.plot([low, here], [0, 0], color=style.LOSS_LINE, **bar)
    ax.plot([here], [0], marker="o", color=style.LOSS_LINE, **sheet.look({"markersize": 8, "clip_on": False}))
    plain: dict[str, Any] = {"textcoords": "offset points", "parse_math": False, "annotation_clip": False}
    for end, spot, at in zip(ends, (low, high), ("left", "right"), strict=True):
        look: dict[str, Any] = {"size": sheet.tick, "color": style.QUIET, "ha": at, "va": "top"}
        ax.annotate(sweep.write_value(end), (spot, 0), (0, -7 * sheet.type), **look, **plain)
    said, look = f"{sweep.name} = {sweep.write_value(value)}", {"size": sheet.label + 1, "color": style.INK}
    ax.annotate(said, (low, 0), (0, 8 * sheet.type), weight="bold", **look, **plain)
