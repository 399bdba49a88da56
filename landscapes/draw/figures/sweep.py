"""A sweep as a film: one frame for each of its slices, all on one colour scale (matplotlib)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ...identity import plane_of
from .. import film, style
from . import contour, page

DPI = 120
PITCH = 6.25  # room of a panel with its colour bar on a screen [inch]
LEFT, RIGHT, HEAD, GAP, AXIS = 0.8, 0.83, 1.08, 0.6, 0.55  # room at the sides, over, between, under panels [inch]
BESIDE, LINE = 0.93, 1.55  # share of a panel's room that its colour bar leaves; height of a line, in that of its type
RATES, MIN_SECONDS = (10, 5, 4, 2), 4.0  # frames per second to choose from, so that a film lasts so many seconds


@dataclass(frozen=True, eq=False)
class Sweep:
    """The same window sampled at growing `values` of what `label` names with its unit; one slice for each value.

    Those of a `logarithmic` one grow by equal ratios.
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
        """Write a value with its unit, and as many decimals for each of them, or digits of a logarithmic one."""
        span = abs(self.values[-1] - self.values[0])
        decimals = min(9, max(0, 2 - math.floor(math.log10(span))))
        unit = self.label.partition(" [")[2].removesuffix("]")
        return f"{style.number(value, '.3g' if self.logarithmic else f'.{decimals}f')} {unit}".rstrip()

    def plot(self, number: int = -1) -> page.Picture:
        """Draw a frame, by default the last, on the scales that all frames share."""
        return frame_figure(self, number, Scales.of(self))


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


@dataclass(frozen=True)
class Layout:
    """Say where things are on every frame of a sweep [inch], so that nothing moves from one to the next."""

    sheet: style.Sheet
    panels: int
    entries: int  # most in the legend of any frame

    @property
    def side(self) -> float:
        """Of a panel; its colour bar takes seven per cent of the room for both."""
        return BESIDE * (self.sheet.pitch - (LEFT + RIGHT) * self.sheet.type)

    @property
    def columns(self) -> int:
        """Of the legend."""
        return 2 * self.sheet.columns if self.sheet.zoom == 1 else self.sheet.columns

    @property
    def foot(self) -> float:
        """Under the panels: their axes, the legend, the provenance."""
        return AXIS * self.sheet.type + self.legend + 0.08 + 2 * LINE * self.sheet.small / 72

    @property
    def legend(self) -> float:
        """Height of the legend."""
        return -(-self.entries // self.columns) * LINE * self.sheet.tick / 72

    @property
    def height(self) -> float:
        """Of the page."""
        rows = -(-self.panels // self.sheet.columns)
        return HEAD * self.sheet.type + rows * self.side + (rows - 1) * GAP * self.sheet.type + self.foot

    def box(self, left: float, bottom: float, width: float, height: float) -> tuple[float, float, float, float]:
        """Return a box [inch] as matplotlib has it."""
        page_width = self.sheet.width
        return (left / page_width, bottom / self.height, width / page_width, height / self.height)

    def panel(self, number: int) -> tuple[float, float, float, float]:
        """Return room for a square panel and its colour bar."""
        row, column = divmod(number, self.sheet.columns)
        down = HEAD * self.sheet.type + (row + 1) * self.side + row * GAP * self.sheet.type
        left = column * self.sheet.pitch + LEFT * self.sheet.type
        return self.box(left, self.height - down, self.side / BESIDE, self.side)


def frame_figure(sweep: Sweep, number: int, scales: Scales, *, width: float | None = None) -> page.Picture:
    """Draw one frame: loss map, arrows, the value and where in its range it is; nothing moves from frame to frame."""
    dataset, panels = sweep.slices[number], 1 if scales.slope is None else 2
    sheet = style.Sheet.of(width, pitch=PITCH, columns=panels)
    ended = {code for one in sweep.slices for code in np.unique(one["status"]).tolist()} & {*style.ENDED}
    layout = Layout(sheet, panels, 2 + len(ended))
    picture = page.Picture(sheet, layout.height)
    axes = [picture.add_axes(layout.panel(place)) for place in range(panels)]
    contour.loss_panel(axes[0], dataset, scales.loss)
    if scales.slope:
        contour.arrow_panel(axes[1], dataset, scales.slope)
    plane = plane_of(dataset)
    for ax in axes:
        contour.frame(ax, dataset, plane)
        page.name_axes(ax, plane.labels[0])
    _draw_range(picture, layout, sweep, sweep.values[number])
    _write(picture, layout, dataset)
    legend = picture.legend(
        handles=page.drawn_signs(picture), loc="upper left", ncols=layout.columns,
        bbox_to_anchor=layout.box(LEFT * sheet.type, layout.foot - AXIS * sheet.type, 0.0, 0.0)[:2],
        fontsize=sheet.tick, frameon=False, handlelength=1.8, columnspacing=1.6, borderpad=0, borderaxespad=0,
    )  # fmt: skip
    for text in legend.get_texts():
        text.set_parse_math(False)
    return picture


def _write(picture: page.Picture, layout: Layout, dataset: xr.Dataset) -> None:
    sheet, left = layout.sheet, LEFT * layout.sheet.type
    room = sheet.width - left - page.MARGIN
    x, y, *_ = layout.box(left, layout.height - 0.36 * sheet.type, 0.0, 0.0)
    picture.text(x, y, page.title(dataset), size=sheet.title, color=style.INK, parse_math=False)
    x, y, *_ = layout.box(left, 0.08, 0.0, 0.0)
    said = page.wrap_text(page.provenance(dataset), room, sheet.small)
    picture.text(x, y, said, size=sheet.small, color=style.QUIET, parse_math=False)


def save_films(sweep: Sweep, mp4: Path, gif: Path | None, *, dpi: int = DPI, loss: int = 18) -> None:
    """Write a sweep as an MP4 and as a GIF, one picture for each slice, in a few seconds' length.

    `loss` is that of `film.save_film`.
    """
    scales, count = Scales.of(sweep), len(sweep.slices)
    pictures = (film.picture(frame_figure(sweep, number, scales), dpi=dpi) for number in range(count))
    rate = next((rate for rate in RATES if count / rate >= MIN_SECONDS), RATES[-1])
    film.save_film(pictures, mp4, gif, count=count, rate=rate, loss=loss)


def _draw_range(picture: page.Picture, layout: Layout, sweep: Sweep, value: float) -> None:
    """Say the value, and mark it on a bar from the lowest to the highest."""
    ends, sheet = (sweep.values[0], sweep.values[-1]), layout.sheet
    low, high, here = ((math.log10(one) if sweep.logarithmic else one) for one in (*ends, value))
    place = layout.box(LEFT * sheet.type, layout.height - 0.9 * sheet.type, layout.side, 0.16 * sheet.type)
    ax = picture.add_axes(place, gid="range")
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
