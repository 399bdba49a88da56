"""A slice as something else moves: frames on one colour scale, as a film (matplotlib)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..store import plane_of
from . import contour, film, page, style

DPI = 120
PITCH, HEIGHT = 6.0, 6.5  # of the page: width of a panel with its colour bar, and height [inch]
LEFT, FOOT = 0.8, 1.12  # where the panels begin [inch]
RATES, LEAST = (10, 5, 4, 2), 4.0  # frames per second to choose from, so that a film lasts so many seconds


@dataclass(frozen=True, eq=False)
class Sweep:
    """The same window sampled at growing `values` of what `label` names with its unit; one slice for each value."""

    label: str
    values: Sequence[float]
    slices: Sequence[xr.Dataset]

    @property
    def name(self) -> str:
        """The label without its unit."""
        return self.label.partition(" [")[0]

    def said(self, value: float) -> str:
        """Write a value with its unit, and as many decimals for each of them."""
        span = abs(self.values[-1] - self.values[0])
        decimals = min(9, max(0, 2 - math.floor(math.log10(span))))
        unit = self.label.partition(" [")[2].removesuffix("]")
        number = f"{value:.{decimals}f}".replace("-", "\N{MINUS SIGN}")
        return f"{number} {unit}".rstrip()


@dataclass(frozen=True, eq=False)
class Scales:
    """The scales that all frames of a sweep share; `slope` is None where there are no gradients."""

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


def frame_figure(sweep: Sweep, number: int, scales: Scales) -> Figure:
    """Draw one frame: loss map, arrows, the value and where in its range it is; nothing moves from frame to frame."""
    dataset, panels = sweep.slices[number], 1 if scales.slope is None else 2
    width = panels * PITCH + 0.5
    figure = Figure(figsize=(width, HEIGHT))
    figure.set_layout_engine("none")
    axes = [_panel(figure, LEFT + PITCH * panel, width) for panel in range(panels)]
    entries = contour.loss_panel(axes[0], dataset, scales.loss)
    if scales.slope:
        entries += contour.arrow_panel(axes[1], dataset, scales.slope)
    plane = plane_of(dataset)
    for ax in axes:
        contour.frame(ax, dataset, plane)
        ax.set_xlabel(plane.labels[0], size=style.LABEL, parse_math=False)
    _draw_range(figure, sweep, sweep.values[number], width)
    left = LEFT / width
    figure.text(left, 1 - 0.36 / HEIGHT, page.title(dataset), size=style.TITLE, color=style.INK, parse_math=False)
    said = page.wrapped(page.provenance(dataset), 92 * panels)
    figure.text(left, 0.08 / HEIGHT, said, size=style.SMALL, color=style.QUIET, parse_math=False)
    legend = figure.legend(
        handles=[*entries, *page.failure_key(dataset)], loc="center left", bbox_to_anchor=(left, 0.47 / HEIGHT),
        ncols=2 * panels, fontsize=style.TICK, frameon=False, handlelength=1.8, columnspacing=1.6, borderpad=0,
    )  # fmt: skip
    for text in legend.get_texts():
        text.set_parse_math(False)
    return figure


def save_films(sweep: Sweep, mp4: Path, gif: Path | None, *, dpi: int = DPI, loss: int = 18) -> None:
    """Write a sweep as an MP4 and as a GIF, one picture for each slice, in a few seconds' length.

    `loss` is that of `film.save_film`.
    """
    scales, count = Scales.of(sweep), len(sweep.slices)
    pictures = (film.picture(frame_figure(sweep, number, scales), dpi=dpi) for number in range(count))
    rate = next((rate for rate in RATES if count / rate >= LEAST), RATES[-1])
    film.save_film(pictures, mp4, gif, count=count, rate=rate, loss=loss)


def _panel(figure: Figure, left: float, width: float) -> Axes:
    """Return room for a square panel and the colour bar that takes seven per cent of it [inch]."""
    side = style.PANEL
    return figure.add_axes((left / width, FOOT / HEIGHT, side / 0.93 / width, side / HEIGHT))


def _draw_range(figure: Figure, sweep: Sweep, value: float, width: float) -> None:
    """Say the value, and mark it on a bar from the lowest to the highest."""
    low, high = sweep.values[0], sweep.values[-1]
    ax = figure.add_axes((LEFT / width, (HEIGHT - 0.9) / HEIGHT, style.PANEL / width, 0.16 / HEIGHT), gid="range")
    ax.set_axis_off()
    ax.set_xlim(low, high)
    ax.set_ylim(-1, 1)
    ax.plot([low, high], [0, 0], color=style.FAINT, linewidth=3, solid_capstyle="round", clip_on=False)
    ax.plot([low, value], [0, 0], color=style.LINE, linewidth=3, solid_capstyle="round", clip_on=False)
    ax.plot([value], [0], marker="o", markersize=8, color=style.LINE, clip_on=False)
    for end, at in ((low, "left"), (high, "right")):
        ax.annotate(
            sweep.said(end), (end, 0), (0, -7), textcoords="offset points", ha=at, va="top",
            size=style.TICK, color=style.QUIET, parse_math=False, annotation_clip=False,
        )  # fmt: skip
    ax.annotate(
        f"{sweep.name} = {sweep.said(value)}", (low, 0), (0, 8), textcoords="offset points",
        size=style.LABEL + 1, color=style.INK, weight="bold", parse_math=False, annotation_clip=False,
    )  # fmt: skip
