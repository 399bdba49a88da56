"""How good gradients are over a slice: their angle to the slope at several scales, first against zeroth order."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, NullLocator

from ..gradients import biased, disagreement, scale_table
from ..ruggedness import box_slopes
from ..store import plane_of
from . import contour, page, style

WIDTH, HEIGHT = 13.2, 9.0  # of the page [inch]


def quality_figure(dataset: xr.Dataset, steps: xr.Dataset, samples: xr.Dataset, smooth: xr.Dataset) -> Figure:
    """Draw gradient quality: above it over the slice's own samples, below it by scale and under smoothing.

    `steps` is of `gradients.ladder`, `samples` of `gradients.of_samples` and `smooth` of `gradients.smoothed_slopes`.
    """
    plane = plane_of(dataset)
    maps = [str(number) for number in range(samples.sizes["scale"])]
    above: list[Any] = (maps + ["."] * 3)[:3] if plane.rank == 2 else ["line"] * 3
    figure = page.blank_page(WIDTH, HEIGHT)
    axes: dict[str, Axes] = figure.subplot_mosaic([above, ["scales", "narrow", "wide"]])
    if plane.rank == 2:
        for number, name in enumerate(maps):
            _cosine_map(axes[name], dataset, samples.isel(scale=number), last=number == len(maps) - 1)
    else:
        _slope_lines(axes["line"], dataset)
    _scales(axes["scales"], steps, samples)
    for number, ax in enumerate((axes["narrow"], axes["wide"])):
        draw = _disagreement_map if plane.rank == 2 else _two_orders
        draw(ax, dataset, smooth.isel(width=number), smooth)
    figure.suptitle(f"{page.title(dataset)}: gradient quality", size=style.TITLE, color=style.INK, parse_math=False)
    _key(figure, dataset)
    return figure


def _key(figure: Figure, dataset: xr.Dataset) -> None:
    entries: list[Artist] = [Line2D([], [], **style.SURE, label="first order is biased beyond chance (p < 0.001)")]
    if dataset["loss"].ndim == 2:
        entries.append(Patch(**style.UNSEEN, label="no slope above the noise, or too close to the border"))
    page.key(figure, [*entries, *page.failure_key(dataset)], columns=3)
    figure.legends[0].set_title(page.wrapped(page.provenance(dataset), 170), prop=FontProperties(size=style.SMALL))
    figure.legends[0].get_title().set(color=style.QUIET, parse_math=False)


def _cosine_map(ax: Axes, dataset: xr.Dataset, found: xr.Dataset, *, last: bool) -> None:
    plane = plane_of(dataset)
    cosine = found["cosine"].to_numpy()
    ax.set_facecolor(style.UNSEEN["facecolor"])
    picture = ax.imshow(np.ma.masked_invalid(cosine), extent=_extent(dataset), **style.COSINE)
    contour.frame(ax, dataset, plane)
    ax.set_xlabel(plane.labels[0], size=style.LABEL, parse_math=False)
    seen = cosine[np.isfinite(cosine)]
    mean = f"mean {style.number(round(float(seen.mean()), 2))}" if seen.size else "none above the noise"
    _caption(ax, f"differences over {_percent(found['scale'])} of the box: {mean}")
    bar = ax.figure.colorbar(picture, ax=ax, fraction=0.05, pad=0.02)
    style.dress_bar(bar, "cosine of gradient and difference" if last else "")


def _slope_lines(ax: Axes, dataset: xr.Dataset) -> None:
    plane, u = plane_of(dataset), dataset["u"].to_numpy()
    slope, loss = box_slopes(dataset)[:, 0], dataset["loss"].to_numpy()
    difference = np.full_like(loss, np.nan)
    difference[1:-1] = (loss[2:] - loss[:-2]) * (len(loss) - 1) / 2
    ax.plot(u, difference, color=style.LINE, **style.stroke(len(u)), label="difference over two samples")
    ax.plot(u, slope, color=style.SLOPE_LINE, **style.stroke(len(u)), label="gradient", alpha=0.8)
    style.dress(ax)
    ax.set_xlim(float(u[0]), float(u[-1]))
    ax.set_ylim(*style.span_of_line(difference, slope))
    ax.set_xlabel(plane.labels[0], size=style.LABEL, parse_math=False)
    ax.set_ylabel(_slope_label(dataset), size=style.LABEL, parse_math=False)
    ax.legend(fontsize=style.TICK, frameon=False)


def _scales(ax: Axes, steps: xr.Dataset, samples: xr.Dataset) -> None:
    """Draw mean cosine and share of uphill gradients over the scale of the difference."""
    for found, filled in ((steps, True), (samples, False)):
        rows = [row for row in scale_table(found) if row["points"]]
        scale = [row["scale"] for row in rows]
        for name, colour, label in (("cosine", style.LINE, "mean cosine"), ("uphill", style.SLOPE_LINE, "uphill")):
            value = np.array([row[name]["value"] for row in rows], dtype=float)
            ends = np.array([[row[name][end] for end in ("low", "high")] for row in rows], dtype=float).reshape(-1, 2)
            reach = np.abs(np.nan_to_num(ends - value[:, None])).T
            face = colour if filled else "white"
            where = "new evaluations" if filled else "the slice's samples"
            ax.errorbar(
                scale, value, reach, color=colour, marker="o" if name == "cosine" else "v", markerfacecolor=face,
                linewidth=1.1, markersize=4.5, capsize=2, label=f"{label}, {where}",
            )  # fmt: skip
    style.dress(ax)
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(FixedLocator([10.0**power for power in range(-6, 0)]))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_ylim(-1.05, 1.05)
    ax.axhline(0, color=style.FAINT, linewidth=0.8, zorder=0)
    ax.set_box_aspect(1)
    ax.set_xlabel("width of the difference, fraction of the box", size=style.LABEL)
    ax.set_ylabel("cosine; share pointing uphill", size=style.LABEL)
    _caption(ax, "gradient against differences, by scale")
    ax.legend(fontsize=style.SMALL, frameon=False, loc="lower left")


def _disagreement_map(ax: Axes, dataset: xr.Dataset, found: xr.Dataset, all_widths: xr.Dataset) -> None:
    plane, place = plane_of(dataset), found["place"].to_numpy()
    side = round(len(place) ** 0.5)
    at = int(np.flatnonzero(all_widths["width"].to_numpy() == float(found["width"]))[0])
    apart, sure = (of(all_widths).isel(width=at).to_numpy() for of in (disagreement, biased))
    low, high = plane.lower.tolist(), plane.upper.tolist()
    ax.set_facecolor(style.UNSEEN["facecolor"])
    picture = ax.imshow(
        np.ma.masked_invalid(apart.reshape(side, side)), extent=(low[0], high[0], low[1], high[1]), **style.APART
    )
    ax.plot(*place[sure].T, **style.SURE)
    style.dress(ax)
    ax.set_box_aspect(1)
    ax.set_xlabel(plane.labels[0], size=style.LABEL, parse_math=False)
    ax.set_ylabel(plane.labels[1], size=style.LABEL, parse_math=False)
    _caption(ax, f"smoothed over {_percent(found['width'])} of the box: biased at {int(sure.sum())} of {len(sure)}")
    bar = ax.figure.colorbar(picture, ax=ax, fraction=0.05, pad=0.02)
    style.dress_bar(bar, "|first \N{MINUS SIGN} zeroth order| / sum of both" if at else "")


def _two_orders(ax: Axes, dataset: xr.Dataset, found: xr.Dataset, all_widths: xr.Dataset) -> None:
    plane, place = plane_of(dataset), found["place"].to_numpy()[:, 0]
    for name, colour, marker in (("zeroth", style.LINE, "s"), ("first", style.SLOPE_LINE, "o")):
        error = found[f"{name}_error"].to_numpy()[:, 0]
        ax.errorbar(
            place, found[name].to_numpy()[:, 0], error, color=colour, marker=marker, markersize=4, linewidth=0.9,
            capsize=2, label=f"{name} order",
        )  # fmt: skip
    at = int(np.flatnonzero(all_widths["width"].to_numpy() == float(found["width"]))[0])
    sure = biased(all_widths).isel(width=at).to_numpy()
    ax.plot(place[sure], found["first"].to_numpy()[sure, 0], **style.SURE, zorder=4)
    style.dress(ax)
    ax.set_box_aspect(1)
    ax.set_xlabel(plane.labels[0], size=style.LABEL, parse_math=False)
    ax.set_ylabel(_slope_label(dataset), size=style.LABEL, parse_math=False)
    _caption(ax, f"smoothed over {_percent(found['width'])} of the box: biased at {int(sure.sum())} of {len(sure)}")
    ax.legend(fontsize=style.TICK, frameon=False)


def _slope_label(dataset: xr.Dataset) -> str:
    return f"slope [{dataset['loss'].attrs.get('units') or 'loss'} per side of the box]"


def _caption(ax: Axes, text: str) -> None:
    ax.set_title(text, size=style.LABEL, color=style.INK, parse_math=False)


def _percent(share: xr.DataArray) -> str:
    return f"{style.number(float(f'{100 * float(share):.2g}'))} %"


def _extent(dataset: xr.Dataset) -> tuple[float, float, float, float]:
    low, high = (end.tolist() for end in plane_of(dataset).window())
    return low[0], high[0], low[1], high[1]
