"""Colours, weights, type sizes and norms of every picture; nothing else sets style."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap, ListedColormap, LogNorm, Normalize
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from ..objective import Status

DPI = 150
PANEL = 4.3  # side of a map [inch]
STRIP = 0.26  # height of a strip of event counts [inch]

TITLE, LABEL, TICK, SMALL = 12.0, 10.0, 9.0, 7.0  # type sizes [pt]
INK, QUIET, FAINT = "#1a1a1a", "#5f5f5f", "#c9c9c9"
UNSAMPLED = "#ececec"  # MISSING: nothing there yet
BAND = ("#dfe6ee", "#f6f8fa")  # alternating event counts
LINE = "#31688e"  # the loss over a line: viridis' blue
SLOPE_LINE = "#b5367a"  # the gradient along it: magma's pink

LOSS_MAP: Colormap = colormaps["viridis"]
SLOPE_MAP: Colormap = ListedColormap(colormaps["magma"](np.linspace(0.08, 0.77, 256)), "magma, legible on white")

FAILURES = {Status.NONFINITE: "not finite", Status.ESCAPED: "left the domain", Status.ERROR: "error"}
_FAILED: dict[str, Any] = {"facecolor": "white", "edgecolor": QUIET, "linewidth": 0.0}
LOOKS: dict[Status, dict[str, Any]] = {  # of every sample that is not OK
    Status.MISSING: {"facecolor": UNSAMPLED, "linewidth": 0.0},
    Status.NONFINITE: _FAILED | {"hatch": "////"},
    Status.ESCAPED: _FAILED | {"hatch": "\\\\\\\\"},
    Status.ERROR: _FAILED | {"hatch": "xxxx"},
}

ARROWS = 32  # most arrows per axis
LONGEST_ARROW = 0.055  # as a fraction of a side
ARROW: dict[str, Any] = {"width": 0.0032, "headwidth": 4.0, "headlength": 4.5, "headaxislength": 4.0, "minlength": 0.0}
LOWEST: dict[str, Any] = {
    "marker": "*", "markersize": 12, "markerfacecolor": "white", "markeredgecolor": INK, "linestyle": "none"
}  # fmt: skip
FLAT: dict[str, Any] = {"marker": "o", "markersize": 2.6, "color": QUIET, "linestyle": "none"}

# Okabe & Ito 2008, told apart without colour by line style and marker
METHODS: dict[str, dict[str, Any]] = {
    "random": {"color": "#7f7f7f", "linestyle": (0, (1, 1.4)), "marker": "X"},
    "cma-es": {"color": "#e69f00", "linestyle": (0, (5, 1.5)), "marker": "s"},
    "descents": {"color": "#56b4e9", "linestyle": (0, (5, 1.5, 1, 1.5)), "marker": "v"},
    "bo": {"color": "#009e73", "linestyle": (0, (2.5, 1.2)), "marker": "^"},
    "bo-descents": {"color": "#0072b2", "linestyle": "solid", "marker": "D"},
    "bo-leap": {"color": "#d55e00", "linestyle": "solid", "marker": "o"},
    "ppo": {"color": "#cc79a7", "linestyle": (0, (8, 1.5, 1, 1.5, 1, 1.5)), "marker": "P"},
    "sac": {"color": "#5b2a86", "linestyle": (0, (8, 2.5)), "marker": "*", "markersize": 9.0},
}
OTHER_METHOD: dict[str, Any] = {"color": INK, "linestyle": "solid", "marker": "h"}
METHOD_LINE: dict[str, Any] = {"linewidth": 1.4, "markersize": 6.0, "markeredgewidth": 0.7, "markeredgecolor": "white"}
KINDS: dict[str, dict[str, Any]] = {  # what a run evaluated a point for
    "random": {"color": "#7f7f7f", "marker": "P"},
    "population": {"color": "#31688e", "marker": "o"},
    "descent": {"color": "#b5367a", "marker": "v"},
    "acquisition": {"color": "#009e73", "marker": "D"},
    "policy": {"color": "#5b2a86", "marker": "s"},
}
METHOD_BAND: dict[str, Any] = {"alpha": 0.12, "linewidth": 0.0}
OVERLAID: dict[str, Any] = {"linewidths": 0.6, "zorder": 3, "rasterized": True}  # the points of a run over a map
HALO: dict[str, Any] = OVERLAID | {"linewidths": 1.5, "zorder": 2.9, "facecolors": "none", "edgecolors": "white"}
NEAR, FAR = (4.0, 34.0), 0.2  # area of a point on the plane [pt^2], fewest of many; share of it left at the farthest
TRAIL: dict[str, Any] = {"linewidths": 1.1, "zorder": 2.6, "capstyle": "round"}  # a descent
FAINTEST = 0.25  # opacity of a descent at the farthest
BEST: dict[str, Any] = {"marker": "*", "s": 190.0, "linewidths": 1.1, "zorder": 5}
BROKEN: dict[str, Any] = {"marker": "x", "s": 18.0, "linewidths": 0.9, "color": INK, "zorder": 3.5}  # a failed episode
BORDER: dict[str, Any] = {"s": 20.0, "facecolors": "none", "linewidths": 0.8, "zorder": 3.2, "clip_on": False}

_MAP: dict[str, Any] = {"origin": "lower", "aspect": "auto", "interpolation": "nearest", "rasterized": True}
COSINE: dict[str, Any] = _MAP | {"cmap": colormaps["RdBu"], "vmin": -1.0, "vmax": 1.0}  # of a gradient and a slope
APART: dict[str, Any] = _MAP | {"cmap": colormaps["cividis"], "vmin": 0.0, "vmax": 1.0}  # of two estimates
UNSEEN: dict[str, Any] = {"facecolor": "#dcdcdc", "linewidth": 0.0}  # no slope above the noise
SURE: dict[str, Any] = {
    "marker": "D", "markersize": 5.0, "markerfacecolor": "white", "markeredgecolor": INK, "linestyle": "none"
}  # fmt: skip

LADDERS: dict[str, dict[str, Any]] = {  # what was turned to make a rung of a trade-off
    "dt": {"color": "#0072b2", "marker": "o"},
    "resolution": {"color": "#009e73", "marker": "s"},
    "particles": {"color": "#e69f00", "marker": "^"},
    "precision": {"color": "#cc79a7", "marker": "D"},
    "stiffness": {"color": "#d55e00", "marker": "v"},
    "engine": {"color": "#5b2a86", "marker": "P"},
    "device": {"color": "#7f7f7f", "marker": "X"},
    "named": {"color": INK, "marker": "*", "markersize": 13.0},
}
RUNG: dict[str, Any] = {
    "linestyle": "none", "markersize": 6.5, "markeredgewidth": 0.7, "markeredgecolor": "white", "zorder": 3
}  # fmt: skip
WHISKER: dict[str, Any] = {"color": FAINT, "linewidth": 1.0, "zorder": 1.5, "solid_capstyle": "butt"}
FRONT: dict[str, Any] = {"color": QUIET, "linewidth": 1.2, "zorder": 2}
AGAINST: dict[str, Any] = {"color": INK, "linewidth": 0.9, "linestyle": (0, (4, 2)), "zorder": 1}
NAME: dict[str, Any] = {
    "fontsize": LABEL, "color": INK, "zorder": 4, "path_effects": [withStroke(linewidth=2.5, foreground="white")]
}  # fmt: skip
BESIDE: tuple[tuple[str, tuple[float, float], dict[str, Any]], ...] = (  # where a name may stand [pt]
    ("above", (0.0, 9.0), {"ha": "center", "va": "bottom"}),
    ("below", (0.0, -9.0), {"ha": "center", "va": "top"}),
    ("right", (9.0, 0.0), {"ha": "left", "va": "center"}),
    ("left", (-9.0, 0.0), {"ha": "right", "va": "center"}),
)


@dataclass(frozen=True, eq=False)
class Scale:
    """Map values to colours; `extend` says at which end of the colour bar values go on beyond it."""

    norm: Normalize
    extend: str

    @classmethod
    def of_loss(cls, values: NDArray[np.float64]) -> Scale:
        """Span the finite losses: logarithmic from three decades on, without an outermost per cent far out."""
        low, high, extend = _span(values)
        if low > 0 and high / low >= 1e3:
            return cls(LogNorm(low, high), extend)
        return cls(Normalize(low, high), extend)

    @classmethod
    def linear(cls, low: float, high: float) -> Scale:
        """Span a range."""
        return cls(Normalize(low, high), "neither")

    @classmethod
    def of_magnitude(cls, values: NDArray[np.float64]) -> Scale:
        """Span the finite logarithms of magnitudes."""
        low, high, extend = _span(values)
        return cls(Normalize(low, high), extend)

    @property
    def logarithmic(self) -> bool:
        """Whether equal ratios, not differences, are equally far apart."""
        return isinstance(self.norm, LogNorm)

    def ticks(self) -> list[float]:
        """Return round values along the scale."""
        low, high = float(self.norm.vmin or 0.0), float(self.norm.vmax or 0.0)
        if self.logarithmic:
            values = LogLocator(subs=(1, 2, 5) if high < 2e3 * low else (1,), numticks=9).tick_values(low, high)
            return [float(value) for value in values if low <= value <= high]
        return round_values(low, high)


def round_values(low: float, high: float) -> list[float]:
    """Return about five round values in a range."""
    return [
        float(value)
        for value in MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
        if low <= value <= high
    ]


def _span(values: NDArray[np.float64]) -> tuple[float, float, str]:
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return 0.0, 1.0, "neither"
    least, low, high, most = (float(value) for value in np.percentile(finite, (0, 1, 99, 100)))
    room = high - low
    below, above = least < low - room, most > high + room
    low, high = (low if below else least), (high if above else most)
    if not high > low:  # one value all over: a scale around it
        pad = 0.5 * abs(low) or 0.5
        low, high = low - pad, high + pad
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    return low, high, extend[below, above]


def dress(ax: Axes) -> None:
    """Give a panel its ticks and frame."""
    ax.tick_params(labelsize=TICK, color=QUIET, labelcolor=INK, length=3)
    ax.spines[:].set(color=QUIET, linewidth=0.6)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.yaxis.set_major_locator(MaxNLocator(5))


def log_axis(axis: Axis) -> None:
    """Make an axis of what is drawn already logarithmic, with plain numbers at 1, 2 and 5 where decades are few."""
    scale = axis.axes.set_xscale if axis is axis.axes.xaxis else axis.axes.set_yscale
    scale("log")
    low, high = sorted(axis.get_view_interval())
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 2e3 * low else (1,), numticks=9))
    axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axis.set_minor_formatter(NullFormatter())


def dress_bar(bar: Colorbar, label: str) -> None:
    """Give a colour bar its label and ticks."""
    bar.set_label(label, size=LABEL, color=INK, parse_math=False)
    bar.ax.tick_params(labelsize=TICK, color=QUIET, labelcolor=INK, length=3)
    bar.outline.set(edgecolor=QUIET, linewidth=0.6)


def stroke(points: int) -> dict[str, Any]:
    """Return how a line of so many points is drawn: with its points where they can be told apart."""
    return {"linewidth": 1.1, "marker": "o" if points <= 100 else "", "markersize": 2.4}


def method(run: xr.Dataset) -> dict[str, Any]:
    """Return the look of a run's method."""
    return METHODS.get(str(run.attrs["method"]), OTHER_METHOD)


def point_areas(distance: NDArray[np.float64], reach: float, points: int) -> NDArray[np.float64]:
    """Return how large so many points are drawn [pt^2]: smaller the farther off the plane, `reach` being farthest."""
    least, most = NEAR
    area = max(least, min(most, most * (150 / max(points, 1)) ** 0.35))
    share: NDArray[np.float64] = 1 - (1 - FAR) * distance / reach if reach else np.ones_like(distance)
    areas: NDArray[np.float64] = area * share
    return areas


def number(value: float) -> str:
    """Write a number with four digits and the minus sign that the ticks have."""
    return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")


def thin(lines: int) -> float:
    """Return the width of so many vertical lines [pt]: hairlines where there are many."""
    return max(0.25, min(0.8, 40 / max(lines, 1)))


def text_width(text: str) -> float:
    """Return about how much room small type takes [inch], with a margin."""
    return (0.65 * SMALL * len(text) + 4) / 72


def span_of_line(values: NDArray[np.float64], beside: NDArray[np.float64]) -> tuple[float, float]:
    """Return limits that show `values` and the bulk of what is drawn `beside` them."""
    low, high, _ = _span(values)
    bulk = beside[np.isfinite(beside)]
    if bulk.size:
        near = np.percentile(bulk, (2, 98))
        reach = 2 * (high - low)
        low, high = min(low, max(float(near[0]), low - reach)), max(high, min(float(near[1]), high + reach))
    pad = 0.05 * (high - low)
    return low - pad, high + pad
