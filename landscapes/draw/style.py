"""Colours, line weights, type sizes and colour norms of all pictures; no other module sets style."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axis import Axis
from matplotlib.colors import Colormap, ListedColormap, LogNorm, Normalize
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator
from numpy.typing import NDArray

from ..large import refuse_large
from ..objective import Status

DPI, PRINT_DPI = 150, 600  # of a picture for a screen, and of what is pixels in one for print
INK, QUIET, FAINT = "#1a1a1a", "#5f5f5f", "#c9c9c9"
UNSAMPLED = "#ececec"  # MISSING: nothing there yet
BAND = ("#dfe6ee", "#f6f8fa")  # alternating event counts
LOSS_LINE = "#31688e"  # the loss over a line: viridis' blue
SLOPE_LINE = "#b5367a"  # the gradient along it: magma's pink

NIGHT, NIGHT_INK = "#16181b", "#ececec"  # ground and ink of the gallery's pages where they are dark
MID_GREY = "#777777"  # as far from white as from black: lines and labels in a viewer, whose ground is light or dark
BEYOND, LOST = "#9a7b00", "#c94f4f"  # points there that are outside the window, or failed

LOSS_MAP: Colormap = colormaps["viridis"]
RANK_MAP: Colormap = ListedColormap(colormaps["viridis_r"](np.linspace(0.0, 0.92, 256)), "viridis, 1 is light")
SLOPE_MAP: Colormap = ListedColormap(colormaps["magma"](np.linspace(0.08, 0.77, 256)), "magma, legible on white")
FLOOR_MAP: Colormap = colormaps["cividis"]
SLOPE_MAP_DARK: Colormap = ListedColormap(colormaps["magma"](np.linspace(0.42, 1.0, 256)), "magma, legible on black")

FAILURES = {Status.NONFINITE: "not finite", Status.ESCAPED: "outside the domain", Status.ERROR: "error"}
ENDED = FAILURES | {Status.MISSING: "not sampled yet", Status.NO_GRADIENT: "no gradient"}
_FAILED: dict[str, Any] = {"facecolor": "white", "edgecolor": QUIET, "linewidth": 0.0}
STATUS_LOOKS: dict[Status, dict[str, Any]] = {  # of every sample that lacks its loss or its gradient
    Status.MISSING: {"facecolor": UNSAMPLED, "linewidth": 0.0},
    Status.NONFINITE: _FAILED | {"hatch": "////"},
    Status.ESCAPED: _FAILED | {"hatch": "\\\\\\\\"},
    Status.ERROR: _FAILED | {"hatch": "xxxx"},
    Status.NO_GRADIENT: {"facecolor": BAND[0], "edgecolor": QUIET, "linewidth": 0.0, "hatch": ".."},
}

ARROWS = 32  # most arrows per axis
LONGEST_ARROW = 0.055  # as a fraction of a side
ARROW: dict[str, Any] = {"width": 0.0032, "headwidth": 4.0, "headlength": 4.5, "headaxislength": 4.0, "minlength": 0.0}
LOWEST_MARK: dict[str, Any] = {
    "marker": "*", "markersize": 12, "markeredgewidth": 1.0, "markerfacecolor": "white", "markeredgecolor": INK,
    "linestyle": "none",
}  # fmt: skip
FLAT_MARK: dict[str, Any] = {"marker": "o", "markersize": 2.6, "color": QUIET, "linestyle": "none"}

# Okabe & Ito 2008, told apart without colour by line style and marker
METHODS: dict[str, dict[str, Any]] = {
    "random": {"color": "#7f7f7f", "linestyle": (0, (1, 1.4)), "marker": "X"},
    "cma-es": {"color": "#e69f00", "linestyle": (0, (5, 1.5)), "marker": "s"},
    "descents": {"color": "#56b4e9", "linestyle": (0, (5, 1.5, 1, 1.5)), "marker": "v"},
    "bo": {"color": "#009e73", "linestyle": (0, (2.5, 1.2)), "marker": "^"},
    "bo-descents": {"color": "#0072b2", "linestyle": "solid", "marker": "D"},
    "bo-leap": {"color": "#d55e00", "linestyle": "solid", "marker": "o"},
    "l-bfgs-b": {"color": "#882255", "linestyle": (0, (6, 1, 1, 1, 1, 1)), "marker": "p"},
    "basin-hopping": {"color": "#332288", "linestyle": (0, (1, 0.8)), "marker": "H"},
    "adam": {"color": "#44aa99", "linestyle": (0, (9, 1.5)), "marker": "<"},
    "cma-es-gradient": {"color": "#997700", "linestyle": (0, (3, 1, 1, 1)), "marker": "d"},
    "turbo": {"color": "#117733", "linestyle": "solid", "marker": ">"},
    "bo-gradient": {"color": "#999933", "linestyle": (0, (2, 0.8)), "marker": "8"},
    "continuation": {"color": "#aa4499", "linestyle": (0, (4, 1, 1, 1)), "marker": "h"},
    "ppo": {"color": "#cc79a7", "linestyle": (0, (8, 1.5, 1, 1.5, 1, 1.5)), "marker": "P"},
    "sac": {"color": "#5b2a86", "linestyle": (0, (8, 2.5)), "marker": "*", "markersize": 9.0},
    "auto": {"color": "#b00020", "linestyle": (0, (4, 1, 1, 1)), "marker": (4, 1, 0)},
}
OTHER_METHOD: dict[str, Any] = {"color": INK, "linestyle": "solid", "marker": "h"}
METHOD_LINE: dict[str, Any] = {"linewidth": 1.4, "markersize": 6.0, "markeredgewidth": 0.7, "markeredgecolor": "white"}
POINT_MARKS: dict[str, dict[str, Any]] = {  # what a run evaluated a point for
    "random": {"color": "#7f7f7f", "marker": "P"},
    "population": {"color": "#31688e", "marker": "o"},
    "descent": {"color": "#b5367a", "marker": "v"},
    "acquisition": {"color": "#009e73", "marker": "D"},
    "policy": {"color": "#5b2a86", "marker": "s"},
    "measurement": {"color": "#8c564b", "marker": "h"},
    "given": {"color": "#c47a00", "marker": "^"},  # by another program
}
TINTED = ("#0b0b18", "#ffffdc")  # inks on a colour that are no greys, so that they stay where a page is dark
NOT_RUN: dict[str, Any] = {"facecolor": UNSAMPLED, "edgecolor": QUIET, "linewidth": 0.0, "hatch": "////"}
METHOD_BAND: dict[str, Any] = {"alpha": 0.12, "linewidth": 0.0}
OVERLAID: dict[str, Any] = {"linewidths": 0.6, "zorder": 3, "rasterized": True}  # the points of a run over a map
HALO: dict[str, Any] = OVERLAID | {"linewidths": 1.5, "zorder": 2.9, "facecolors": "none", "edgecolors": "white"}
CHECKPOINT: dict[str, Any] = OVERLAID | {"edgecolors": INK}  # of a training, along its path
LAST: dict[str, Any] = OVERLAID | {"edgecolors": "white", "linewidths": 1.6, "marker": "s", "zorder": 3.1}
MARK_AREAS = (4.0, 34.0)  # of points on the plane [pt^2]: of one among many, and of one among few
FARTHEST_SHARE = 0.2  # of that area, at the farthest from the plane
DESCENT_LINE: dict[str, Any] = {"linewidths": 1.1, "zorder": 2.6, "capstyle": "round"}  # a descent
IMPROVEMENTS: tuple[dict[str, Any], ...] = (  # the line through them: white with a dark edge, for any ground
    {"color": INK, "alpha": 0.6, "linewidth": 2.2, "zorder": 2.75},
    {"color": "white", "linewidth": 1.0, "zorder": 2.8},
)
FAINTEST = 0.25  # opacity of a descent at the farthest
BEST_MARK: dict[str, Any] = {"marker": "*", "s": 190.0, "linewidths": 1.1, "zorder": 5}
FAILED_MARK: dict[str, Any] = {"marker": "x", "s": 18.0, "linewidths": 0.9, "color": INK, "zorder": 3.5}
BORDER: dict[str, Any] = {"s": 20.0, "facecolors": "none", "linewidths": 0.8, "zorder": 3.2, "clip_on": False}

_MAP: dict[str, Any] = {"origin": "lower", "aspect": "auto", "interpolation": "nearest", "rasterized": True}
COSINE: dict[str, Any] = {"cmap": colormaps["RdBu"], "vmin": -1.0, "vmax": 1.0}  # of a gradient and a slope
DIFFERENCE_MAP: Colormap = colormaps["PuOr_r"]  # of two losses: orange where the second is higher
DISAGREEMENT: dict[str, Any] = _MAP | {"cmap": colormaps["cividis"], "vmin": 0.0, "vmax": 1.0}  # of two estimates
NO_SLOPE: dict[str, Any] = {"facecolor": "#dcdcdc", "linewidth": 0.0}  # no slope above the noise
BIASED: dict[str, Any] = {
    "marker": "D", "markersize": 5.0, "markerfacecolor": "white", "markeredgecolor": INK, "linestyle": "none"
}  # fmt: skip
FARTHEST = BIASED | {"markersize": 6.0}  # where two slices are farthest apart
PAIR: tuple[dict[str, Any], dict[str, Any]] = (  # of two slices over a line, told apart without colour, too
    {"color": "#0072b2", "linestyle": "solid"},
    {"color": "#d55e00", "linestyle": (0, (4, 1.5)), "marker": ""},
)

VARIANTS: dict[str, dict[str, Any]] = {  # which option was changed to make a variant
    "dt": {"color": "#0072b2", "marker": "o"},
    "resolution": {"color": "#009e73", "marker": "s"},
    "particles": {"color": "#e69f00", "marker": "^"},
    "precision": {"color": "#cc79a7", "marker": "D"},
    "stiffness": {"color": "#d55e00", "marker": "v"},
    "engine": {"color": "#8455c9", "marker": "P"},
    "device": {"color": "#7f7f7f", "marker": "X"},
    "mixed": {"color": "#0072b2", "marker": "o", "markersize": 4.5},
    "joint": {"color": "#b5367a", "marker": "h"},
    "named": {"color": INK, "marker": "*", "markersize": 13.0},
}
VARIANT_MARK: dict[str, Any] = {
    "linestyle": "none", "markersize": 6.5, "markeredgewidth": 0.7, "markeredgecolor": "white", "zorder": 3
}  # fmt: skip
EFFECTS: dict[str, dict[str, Any]] = {  # what a part of a model does, in the words of its verdict
    "moves nothing beyond the noise": {"color": "#7f7f7f", "marker": "o"},
    "changes gradients, not losses": {"color": "#cc79a7", "marker": "D"},
    "changes losses, not their order": {"color": "#0072b2", "marker": "s"},
    "changes the order": {"color": "#d55e00", "marker": "^"},
    "fails where the full model does not": {"color": INK, "marker": "X"},
}
MISSING_MARK: dict[str, Any] = {"markerfacecolor": "white", "markeredgewidth": 1.3}  # of a part that is left out
NOISE_LINE: dict[str, Any] = {"color": QUIET, "linewidth": 0.9, "linestyle": (0, (1, 1.5)), "zorder": 1}
OUTCOMES: dict[str, dict[str, Any]] = {  # of a setting on a stability map; those of `FAILURES` by name
    "accurate": {"facecolor": "#8fc1b5", "linewidth": 0.0},
    "inaccurate": {"facecolor": "#f2cf7e", "linewidth": 0.0},
    "not judged": {"facecolor": "#c9d3e0", "linewidth": 0.0},
    "refused": {"facecolor": UNSAMPLED, "edgecolor": QUIET, "linewidth": 0.0, "hatch": ".."},
    **{kind.name: STATUS_LOOKS[kind] for kind in (*FAILURES, Status.NO_GRADIENT)},
}
_BOUNDARY: dict[str, Any] = {"color": INK, "linewidth": 1.4, "markersize": 3.6, "markerfacecolor": "white", "zorder": 3}
BOUNDARIES: tuple[dict[str, Any], dict[str, Any]] = (  # of accuracy, of stability
    _BOUNDARY | {"linestyle": (0, (3, 1.5)), "marker": "s"},
    _BOUNDARY | {"marker": "o"},
)
CHECKED: dict[str, dict[str, Any]] = {  # what a check's curve compares; told apart without colour by lines and marks
    "cosine": {"color": "#0072b2", "linestyle": "solid", "marker": "o", "linewidth": 1.5, "markersize": 4.5},
    "sign": {"color": "#d55e00", "linestyle": (0, (4, 1.5)), "marker": "s", "linewidth": 1.5, "markersize": 4.5},
    "smoothed": {
        "color": INK, "marker": "D", "markersize": 6.0, "markerfacecolor": "white", "linestyle": "none",
        "linewidth": 1.2, "zorder": 4,
    },
}  # fmt: skip
CHECKED_BAND: dict[str, Any] = {"alpha": 0.16, "linewidth": 0.0, "zorder": 1.2}
STEP_LINE: dict[str, Any] = {"color": QUIET, "linewidth": 0.9, "linestyle": (0, (1, 1.5)), "zorder": 1}
_RIGHT: dict[str, Any] = {"facecolor": "#56b4e9", "linewidth": 0.0}
_UNTOLD: dict[str, Any] = {"facecolor": "white", "edgecolor": QUIET, "linewidth": 0.6, "hatch": "////"}
_FLAT: dict[str, Any] = {"facecolor": "#c9d3e0", "linewidth": 0.0}
POINT_KINDS: dict[str, dict[str, Any]] = {  # how the gradient at a point compares with differences, by name of the kind
    "agrees": {"facecolor": "#0072b2", "linewidth": 0.0},
    "kink": _RIGHT,
    "jump": _RIGHT,
    "flat": _FLAT,
    "exactly zero": _FLAT,
    "lost in noise": _UNTOLD,
    "too steep to judge": _UNTOLD,
    "failed": _UNTOLD | {"hatch": "xxxx"},
    "NaN": {"facecolor": "#d55e00", "linewidth": 0.0},
    "wrong": {"facecolor": "#d55e00", "linewidth": 0.0},
}
EIGENVALUES: dict[str, dict[str, Any]] = {  # of a Hessian, by sign
    "positive": {"color": "#0072b2", "marker": "o", "linestyle": "none", "markersize": 5.5},
    "negative": {"color": "#d55e00", "marker": "s", "linestyle": "none", "markersize": 5.0},
    "cannot tell": {
        "color": QUIET, "marker": "o", "linestyle": "none", "markersize": 5.5, "markerfacecolor": "white"
    },
}  # fmt: skip
EIGENVALUE_NAMES = {"positive": "positive", "negative": "negative", "cannot tell": "undetermined sign"}
INTERVAL_LINE: dict[str, Any] = {"color": FAINT, "linewidth": 1.0, "zorder": 1.5, "solid_capstyle": "butt"}
CHOSEN_MARK: dict[str, Any] = {  # a ring around a variant that a fidelity's name should mean
    "linestyle": "none", "marker": "o", "markersize": 12.0, "markerfacecolor": "none", "markeredgewidth": 1.3,
    "zorder": 4,
}  # fmt: skip
CHOSEN: dict[str, dict[str, Any]] = {
    "draft": {"markeredgecolor": "#d55e00"},
    "standard": {"markeredgecolor": "#b5367a"},
}
FRONT: dict[str, Any] = {"color": QUIET, "linewidth": 1.2, "zorder": 2}
REFERENCE_LINE: dict[str, Any] = {"color": INK, "linewidth": 0.9, "linestyle": (0, (4, 2)), "zorder": 1}
NAME_TEXT: dict[str, Any] = {"color": INK, "zorder": 6, "path_effects": [withStroke(linewidth=2.0, foreground="white")]}
LEADER: dict[str, Any] = {"arrowstyle": "-", "color": QUIET, "linewidth": 0.5, "shrinkA": 0.0, "shrinkB": 2.0}

EXTEND = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
INCH = 25.4  # [mm]
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
NARROWEST, WIDEST = 80.0, 400.0  # of a picture for print [mm]
LIGHTEST = 0.5  # of lines and marks, against those on a screen: a tenth of a millimetre
WEIGHTS = {"linewidth": 1, "linewidths": 1, "markersize": 1, "markeredgewidth": 1, "capsize": 1, "s": 2}


@dataclass(frozen=True)
class Sheet:
    """Sizes of a picture for its medium: a screen, as wide as the panels need, or a printed page of a given width."""

    width: float  # [inch]
    columns: int  # panels side by side
    zoom: float  # of a panel, against its size on a screen
    title: float = 12.0  # type sizes [pt]
    label: float = 10.0
    tick: float = 9.0
    small: float = 7.0

    @classmethod
    def of(
        cls, width: float | None, *, pitch: float, columns: int = 1, panels: int | None = None, least: float = NARROWEST
    ) -> Sheet:
        """Return the sheet of a screen, `columns` panels of a `pitch` [inch], or of a page `width` millimetres wide.

        On a page, as many of the `panels` are side by side as have at least `least` millimetres each. Type has the
        sizes of a journal.

        Raises ValueError if the page is narrower or wider than a printed page.
        """
        if width is None:
            return cls(columns * pitch, columns, 1.0)
        if not NARROWEST <= width <= WIDEST:
            raise ValueError(f"a picture for print is {NARROWEST:g} to {WIDEST:g} mm wide; got {width:g}")
        panels = panels or columns
        fit = max(1, min(panels, int(width / least)))
        fit = math.ceil(panels / math.ceil(panels / fit))  # as many in each row
        return cls(width / INCH, fit, width / INCH / fit / pitch, title=8.0, label=7.0, tick=6.5, small=6.0)

    @property
    def pitch(self) -> float:
        """The width of a panel with its labels [inch]."""
        return self.width / self.columns

    @property
    def type(self) -> float:
        """The size of type, relative to a screen."""
        return self.label / Sheet.label

    @property
    def weight(self) -> float:
        """The weight of lines and marks, relative to a screen: that of the panels, down to a printable minimum."""
        return min(1.0, max(LIGHTEST, self.zoom))

    def look(self, look: Mapping[str, Any]) -> dict[str, Any]:
        """Return a look of lines or marks with the sheet's weight."""
        return {
            name: value * self.weight ** WEIGHTS[name] if name in WEIGHTS else value for name, value in look.items()
        }


@dataclass(frozen=True, eq=False)
class Scale:
    """A map from values to colours; `extend` names the ends of the colour bar beyond which values continue."""

    norm: Normalize
    extend: str

    @classmethod
    def of_loss(cls, values: NDArray[np.float64]) -> Scale:
        """Span the finite losses, logarithmic from three decades on, without the outermost percent if it is far out."""
        low, high, extend = _span(values)
        if low > 0 and high / low >= 1e3:
            return cls(LogNorm(low, high), extend)
        return cls(Normalize(low, high), extend)

    @classmethod
    def between(cls, low: float, high: float, *, logarithmic: bool = False, extend: str = "neither") -> Scale:
        """Span a range, which is positive if logarithmic; `extend` names the ends beyond which values continue."""
        return cls(LogNorm(low, high) if logarithmic else Normalize(low, high), extend)

    @classmethod
    def symmetric(cls, values: NDArray[np.float64]) -> Scale:
        """Span finite values symmetrically about zero, without the largest few if they are far out."""
        _, most, _ = _span(np.abs(values))
        return cls(Normalize(-most, most), "neither").over(values)

    @classmethod
    def of_magnitude(cls, values: NDArray[np.float64]) -> Scale:
        """Span the finite logarithms of magnitudes."""
        low, high, extend = _span(values)
        return cls(Normalize(low, high), extend)

    @classmethod
    def of_deviation(cls, values: NDArray[np.float64]) -> Scale:
        """Span finite standard deviations from zero on."""
        _, high, extend = _span(values)
        return cls(Normalize(0.0, high), "max" if extend in ("max", "both") else "neither")

    @property
    def ends(self) -> tuple[float, float]:
        """The lowest and the highest value with a distinct colour."""
        return float(self.norm.vmin or 0.0), float(self.norm.vmax or 0.0)

    def over(self, values: NDArray[np.float64]) -> Scale:
        """Return the same scale, open at the ends that some of the values exceed."""
        low, high = self.ends
        finite = values[np.isfinite(values)]
        return Scale(self.norm, EXTEND[bool((finite < low).any()), bool((finite > high).any())])

    @property
    def logarithmic(self) -> bool:
        """Whether equal ratios, not equal differences, have equal distances."""
        return isinstance(self.norm, LogNorm)

    def ticks(self) -> list[float]:
        """Return round values along the scale."""
        low, high = self.ends
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
    refuse_large(finite)
    least, low, high, most = (float(value) for value in np.percentile(finite, (0, 1, 99, 100)))
    room = high - low
    below, above = least < low - room, most > high + room
    low, high = (low if below else least), (high if above else most)
    if not high > low:  # one value all over: a scale around it
        pad = 0.5 * abs(low) or 0.5
        low, high = low - pad, high + pad
    return low, high, EXTEND[below, above]


def stroke(points: int) -> dict[str, Any]:
    """Return the look of a line of `points` points, with markers if they are distinguishable."""
    return {"linewidth": 1.1, "marker": "o" if points <= 100 else "", "markersize": 2.4}


def method(run: xr.Dataset) -> dict[str, Any]:
    """Return the look of a run's method."""
    return METHODS.get(str(run.attrs["method"]), OTHER_METHOD)


def point_areas(distance: NDArray[np.float64], reach: float, points: int) -> NDArray[np.float64]:
    """Return marker areas [pt^2] of `points` points, which fall with the distance from the plane, at most `reach`."""
    least, most = MARK_AREAS
    area = max(least, min(most, most * (150 / max(points, 1)) ** 0.35))
    share: NDArray[np.float64] = 1 - (1 - FARTHEST_SHARE) * distance / reach if reach else np.ones_like(distance)
    areas: NDArray[np.float64] = area * share
    return areas


def number(value: float, form: str = ".4g") -> str:
    """Write a number in a format, by default with four digits, with a proper minus sign and no negative zero."""
    return f"{value:z{form}}".replace("-", "\N{MINUS SIGN}")


def text_on(colour: Sequence[float], inks: tuple[str, str] = ("black", "white")) -> str:
    """Return the dark or the light ink, whichever is legible on a colour (red, green, blue; 0 to 1)."""
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in colour[:3]]
    luminance = float(np.dot(linear, (0.2126, 0.7152, 0.0722)))  # WCAG 2
    return inks[1.05 / (luminance + 0.05) > (luminance + 0.05) / 0.05]


def power(value: float, plain: int = 4) -> str:
    """Write a round number of a logarithmic axis, with a power of ten beyond `plain` digits."""
    exponent = math.floor(math.log10(value) + 1e-9)
    if -plain <= exponent < plain:
        return number(value)
    factor = round(value / 10.0**exponent)
    ten = "10" + str(exponent).translate(SUPERSCRIPTS)
    return ten if factor == 1 else f"{factor}\N{MULTIPLICATION SIGN}{ten}"


def hairline_width(lines: int) -> float:
    """Return the width [pt] of a number of vertical lines: hairlines if there are many."""
    return max(0.25, min(0.8, 40 / max(lines, 1)))


def span_of_line(values: NDArray[np.float64], beside: NDArray[np.float64]) -> tuple[float, float]:
    """Return limits that show all `values` and most of the data drawn `beside` them."""
    low, high, _ = _span(values)
    bulk = beside[np.isfinite(beside)]
    if bulk.size:
        near = np.percentile(bulk, (2, 98))
        reach = 2 * (high - low)
        low, high = min(low, max(float(near[0]), low - reach)), max(high, min(float(near[1]), high + reach))
    pad = 0.05 * (high - low)
    return low - pad, high + pad


WIDE = 6  # ticks in a panel with room for them
PLAIN = 3  # digits of values that are written without a power of ten
NEAR = 1e-9  # what rounding may change of a logarithm
DENSE = (range(1, 10), (1, 2, 5))  # multiples of powers of ten, from the densest on


def decades(low: float, high: float, most: int = WIDE) -> list[float]:
    """Return the logarithms of at most about `most` round values between two logarithms, ascending."""
    whole = range(math.ceil(low - NEAR), math.floor(high + NEAR) + 1)
    if len(whole) >= max(2, most // 2):
        every = -(-len(whole) // most)
        return [float(power) for power in whole if power % every == 0]
    for factors in reversed(DENSE):
        if len(found := _multiples(low, high, factors)) >= max(2, most // 2):
            return found
    values = round_values(10.0**low * (1 - NEAR), 10.0**high * (1 + NEAR))
    return [min(max(math.log10(value), low), high) for value in values]


def _multiples(low: float, high: float, factors: Sequence[int]) -> list[float]:
    powers = range(math.floor(low), math.ceil(high) + 1)
    places = [power + math.log10(factor) for power in powers for factor in factors]
    return [place for place in places if low - NEAR <= place <= high + NEAR]


def write_power(place: float) -> str:
    """Write the value with this logarithm: a multiple of a power of ten, or else a plain number."""
    factor = 10.0 ** (place - math.floor(place + NEAR))
    return power(10.0**place, PLAIN) if abs(factor - round(factor)) < 1e-6 else number(10.0**place)


def mark_decades(axis: Axis, most: int = WIDE) -> None:
    """Set the ticks of a matplotlib axis whose coordinates are decimal logarithms; it must have its limits.

    Minor ticks are at 2 to 9 times powers of ten if there is room, else at decades.
    """
    low, high = sorted(axis.get_view_interval())
    axis.set_major_locator(FixedLocator(decades(low, high, most)))
    axis.set_minor_locator(FixedLocator(_multiples(low, high, range(1, 10) if high - low <= most else (1,))))
    axis.set_major_formatter(FuncFormatter(lambda place, _: write_power(place)))
