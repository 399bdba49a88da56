"""Colours, weights, type sizes and norms of every picture; nothing else sets style."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap, ListedColormap, LogNorm, Normalize
from matplotlib.ticker import MaxNLocator
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
    def of_magnitude(cls, values: NDArray[np.float64]) -> Scale:
        """Span the finite logarithms of magnitudes."""
        low, high, extend = _span(values)
        return cls(Normalize(low, high), extend)


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


def dress_bar(bar: Colorbar, label: str) -> None:
    """Give a colour bar its label and ticks."""
    bar.set_label(label, size=LABEL, color=INK, parse_math=False)
    bar.ax.tick_params(labelsize=TICK, color=QUIET, labelcolor=INK, length=3)
    bar.outline.set(edgecolor=QUIET, linewidth=0.6)


def stroke(points: int) -> dict[str, Any]:
    """Return how a line of so many points is drawn: with its points where they can be told apart."""
    return {"linewidth": 1.1, "marker": "o" if points <= 100 else "", "markersize": 2.4}


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
