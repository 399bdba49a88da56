"""Small multiples: slices of a census, a card, a wall, or through several points, side by side (matplotlib)."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ...identity import plane_of
from ...lattice import own_cells, sampled_line
from ...space import labelled
from .. import style
from ..figure import Picture
from . import page

if TYPE_CHECKING:
    from ...measures.card import Card, CardSlice, Grade
    from ...measures.census import Census
    from ...statistics import Estimate


PITCH, MIN_PANEL = 3.6, 40.0  # room of a panel: on a screen [inch], and at least in print [mm]


@dataclass(frozen=True, eq=False)
class CompanionSlice:
    """The losses of a slice through a named point, shape (v, u), or (u,) of a line; NaN where an episode failed."""

    through: str
    loss: NDArray[Any]

    def title(self) -> str:
        """Return the point that the slice goes through and the range of its losses."""
        finite = self.loss[np.isfinite(self.loss)]
        ends = (
            [f"{end:.3g}".replace("-", "\N{MINUS SIGN}") for end in (finite.min(), finite.max())] if finite.size else []
        )
        return f"through {spoken(self.through)}\n{' to '.join(ends) or 'all failed'}"


def spoken(through: str) -> str:
    """Return the name of a point for use in a sentence."""
    kind, _, name = through.partition(":")
    if kind == "center":
        return "the centre"
    return f"the example {name}" if kind == "example" else f"random point {name}" if kind == "random" else through


def companions_figure(
    cuts: Sequence[CompanionSlice], dataset: xr.Dataset, *, width: float | None = None
) -> page.Picture:
    """Draw slices side by side on one scale, with common axes; the first is the slice `dataset` itself.

    Failed samples are grey. Raises ValueError if the page is too narrow or too wide.
    """
    sheet = style.Sheet.of(width, pitch=PITCH, columns=len(cuts), least=MIN_PANEL)
    picture, axes = page.panels(sheet, len(cuts), share=True)
    scale = style.Scale.of_loss(np.concatenate([cut.loss.ravel().astype(float) for cut in cuts]))
    plane = plane_of(dataset)
    y = plane.labels[1] if plane.rank == 2 else page.loss_name(dataset)
    for ax, cut in zip(axes, cuts, strict=True):
        _draw(ax, cut, dataset, scale)
        page.dress(ax, plane)
        if plane.rank == 1 and scale.logarithmic:
            page.log_axis(ax.yaxis)
        page.caption(ax, cut.title())
        page.name_outer(ax, plane.labels[0], y)
    if plane.rank == 2:
        page.colour_bar(axes[0], axes[0].images[0], page.loss_name(dataset), scale, beside=axes)
    page.finish(picture)
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
    _map(ax, cut.loss, scale, (left, right, bottom, top))
    ax.set(xlim=ends[0], ylim=ends[1])


CENSUS_PITCH, ACROSS = 8.0, 8  # room on a screen [inch]; slices side by side, and rows of them
FOOT = 4  # words that the legend has, the most frequent first


def census_figure(census: Census, *, width: float | None = None) -> page.Picture:
    """Draw the losses of slices on one scale, the least rugged first, row by row; more than 64 are thinned.

    Slices are in the order of their turns along a side. Failed samples and those outside the box are grey. The legend
    gives the share of slices that each word fits.

    Raises ValueError if the page is too narrow or too wide.
    """
    sheet = style.Sheet.of(width, pitch=CENSUS_PITCH)
    count = len(census.slices)
    shown = [census.order[k * count // min(count, ACROSS**2)] for k in range(min(count, ACROSS**2))]
    across = min(ACROSS, math.ceil(math.sqrt(len(shown))))
    rows = -(-len(shown) // across)
    picture = page.Picture(sheet, sheet.width * rows / across)
    axes = list(picture.subplots(rows, across, squeeze=False).flat)
    scale = style.Scale.of_loss(np.asarray(census.losses, dtype=float))
    for ax, number in zip(axes, shown, strict=False):
        _frame(ax, shape=1.0)
        drawn = _map(ax, census.losses[number], scale)
    for empty in axes[len(shown) :]:
        empty.set_axis_off()
    page.colour_bar(axes[0], drawn, labelled("loss", census.loss_unit), scale, beside=axes)
    of_all = f"{len(shown)} of " if len(shown) < count else ""
    many = f"{of_all}{count} slices, the least rugged first"
    numerics = [census.floor.sentence()] if census.floor else []
    page.entitle(picture, f"{census.env} · census at {census.fidelity} · {many}")
    made = [*numerics, *page.made_by(census, "device", "created"), *filter(None, [census.command])]
    page.finish(picture, _words(census), heading=" · ".join(made))
    return picture


def _words(census: Census) -> list[str]:
    shares = sorted(census.words.items(), key=lambda one: -one[1].value)
    return [f"{word}: {_share(share)}" for word, share in shares if share.value > 0][: 2 * FOOT]


def _share(share: Estimate) -> str:
    value, low, high = (100 * one for one in (share.value, share.low, share.high))
    return f"{value:.0f} % ({low:.0f} to {high:.0f})" if math.isfinite(low) else f"{value:.0f} % of all"


WALL_PITCH, WALL_ACROSS, MIN_LANDSCAPE = 2.2, 6, 28.0  # room of a landscape [inch]; so many in a row; in print [mm]
LINE = 25  # letters in a line under a landscape


@dataclass(frozen=True, eq=False)
class Landscape:
    """A slice on the wall, with its name and its verdict."""

    name: str
    said: str
    dataset: xr.Dataset


def wall_figure(landscapes: Sequence[Landscape], *, width: float | None = None) -> page.Picture:
    """Draw the losses of slices side by side, each on its own scale from its lowest, dark, to its highest, light.

    The axes of a plane and the words of each slice are under it. Samples that are not OK are grey. A line is a curve.

    Raises ValueError if there is no slice, or if the page is too narrow or too wide.
    """
    if not landscapes:
        raise ValueError("a wall needs at least one landscape; got none")
    sheet = style.Sheet.of(
        width, pitch=WALL_PITCH, columns=min(WALL_ACROSS, len(landscapes)), panels=len(landscapes), least=MIN_LANDSCAPE
    )
    picture, axes = page.panels(sheet, len(landscapes))
    for ax, one in zip(axes, landscapes, strict=True):
        _frame(ax, shape=0.75)
        if _draw_alone(ax, one.dataset, linewidth=1.1) is None:
            ax.set_facecolor("white")
        page.caption(ax, one.name)
        said = "\n".join(textwrap.wrap(one.said.replace(" %", "\N{NO-BREAK SPACE}%"), LINE)) or " "
        ax.set_xlabel(said, size=sheet.small, color=style.QUIET, parse_math=False)
    page.entitle(picture, "Losses, each on its own scale: dark is low, light is high")
    page.finish(picture)
    return picture


def _draw_alone(ax: Axes, dataset: xr.Dataset, *, linewidth: float) -> AxesImage | None:
    """Draw the losses of a slice on its own scale: a plane as a map, which is returned, a line as a curve."""
    if plane_of(dataset).rank == 1:
        line = sampled_line(dataset)
        ax.plot(line["u"], line["loss"], color=style.LOSS_LINE, linewidth=linewidth)
        return None
    loss = own_cells(dataset)["loss"].to_numpy()
    return _map(ax, loss, style.Scale.of_loss(loss))


CARD_PITCH, CARD_ACROSS, SHAPE = 3.2, 4, 1.3  # room of a map on a screen [inch]; maps in a row; its height for that
MIN_COLUMNS = 3  # for the legend below
MIN_CARD_MAP = 27.0  # room of a map in print [mm]
PANEL = 3.0  # side of a panel that stands alone [inch]
ARROWS = 9  # most along each axis of a map
LENGTH = 0.09  # of an arrow, as a share of a side
OPPOSED = "#ff6b3d"  # legible on all of the map
VERDICTS = {  # and the words themselves
    "passes": "#1b7837",
    "fails": "#b2182b",
    "not decided": style.QUIET,
    "not installed": style.QUIET,
}


def card_figure(card: Card, *, width: float | None = None) -> page.Picture:
    """Draw the losses and the directions of steepest descent of every engine, scene by scene.

    Maps of a scene share a colour scale. An arrow is orange where the gradient opposes the slope between neighbouring
    samples, and white elsewhere. The share of opposing samples is over the map.

    Raises ValueError if the page is too narrow or too wide.
    """
    most = max(Counter(one.scene for one in card.grades).values())
    columns = min(CARD_ACROSS, max(MIN_COLUMNS, most))
    sheet = style.Sheet.of(width, pitch=CARD_PITCH, columns=columns, least=MIN_CARD_MAP)
    rows = _rows(card, sheet.columns)
    picture = page.Picture(sheet, SHAPE * sheet.pitch * len(rows))
    axes = picture.subplots(len(rows), sheet.columns, squeeze=False)
    for scene, group in groupby(zip(rows, axes, strict=True), key=lambda one: card.grades[one[0][0]].scene):
        _draw_scene(scene, [place for row, places in group for place in zip_longest(row, places)], card)
    page.entitle(picture, "Report card of gradients")
    made = f"{card.created} · {card.device} · {', '.join(card.engines())}"
    page.finish(picture, _legend(sheet), heading=made)
    return picture


def card_panel(cut: CardSlice, scale: style.Scale, pixels: int) -> page.Picture:
    """Draw only the map of a slice with its arrows, over a whole square picture."""
    picture = page.Picture(style.Sheet.of(None, pitch=PANEL), PANEL)
    picture.set_dpi(pixels / PANEL)
    ax = picture.add_axes((0, 0, 1, 1))
    _frame(ax, shape=1.0, linewidth=0)
    _map(ax, cut.loss, scale, (0, 1, 0, 1))
    _draw_arrows(ax, cut, opposing(cut)[0])
    return picture


def _rows(card: Card, columns: int) -> list[list[int]]:
    """Return the indices of the grades in each row of maps; every scene starts a new row."""
    scenes = [list(group) for _, group in groupby(range(len(card.grades)), key=lambda k: card.grades[k].scene)]
    return [scene[start : start + columns] for scene in scenes for start in range(0, len(scene), columns)]


def _draw_scene(scene: str, places: Sequence[tuple[int | None, Axes]], card: Card) -> None:
    """Draw the maps of a scene side by side, with their colour bar."""
    cuts = [card.slices[number] for number, _ in places if number is not None and number in card.slices]
    scale = style.Scale.of_loss(np.concatenate([cut.loss.ravel() for cut in cuts] or [np.zeros(1)]))
    for number, ax in places:
        if number is None:
            ax.set_axis_off()
        else:
            _draw_map(ax, card.grades[number], card.slices.get(number), scale)
    if cuts:
        shown, said = ScalarMappable(scale.norm, style.LOSS_MAP), labelled(f"{scene}: loss", cuts[0].loss_unit)
        page.colour_bar(places[0][1], shown, said, scale, beside=[ax for _, ax in places], aspect=12)


def _draw_map(ax: Axes, grade: Grade, cut: CardSlice | None, scale: style.Scale) -> None:
    sheet, look = page.sheet_of(ax), VERDICTS[grade.verdict]
    _frame(ax, shape=1.0, color=look, linewidth=1.6 * sheet.weight)
    said = grade.engine.replace(", ", ",\n") + f"\n{grade.verdict}"
    if cut is not None:
        opposed, share = opposing(cut)
        said += f"; {share:.0%} oppose" if np.isfinite(share) else ""
        _map(ax, cut.loss, scale, (0, 1, 0, 1))
        _draw_arrows(ax, cut, opposed)
        page.name_axes(ax, *cut.labels)
        for label in (ax.xaxis.label, ax.yaxis.label):
            label.set_fontsize(sheet.small)
    ax.set_title(said, size=sheet.small, color=look, parse_math=False)


def _draw_arrows(ax: Axes, cut: CardSlice, opposed: NDArray[np.bool_]) -> None:
    rows, columns = (np.arange(count)[:: -(-count // ARROWS)] for count in cut.loss.shape)
    at = np.ix_(rows, columns)
    slope = cut.slope[at]
    with np.errstate(divide="ignore", invalid="ignore"):
        step = -LENGTH * slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    x, y = np.meshgrid((columns + 0.5) / cut.loss.shape[1], (rows + 0.5) / cut.loss.shape[0])
    seen = np.isfinite(step).all(axis=-1)
    colours = np.where(opposed[at][seen], OPPOSED, "white")
    ax.quiver(
        x[seen], y[seen], step[seen, 0], step[seen, 1], color=colours, pivot="mid", angles="xy", scale_units="xy",
        scale=1.0, **style.ARROW | {"width": 0.009},
    )  # fmt: skip


def opposing(cut: CardSlice) -> tuple[NDArray[np.bool_], float]:
    """Return where the gradient opposes the slope between neighbouring samples, and the share of such samples."""
    between = np.stack(np.gradient(cut.loss)[::-1], axis=-1) * (np.array(cut.loss.shape[::-1]) - 1)
    along = (between * cut.slope).sum(axis=-1)
    known = np.isfinite(along) & (np.linalg.norm(cut.slope, axis=-1) > 0)
    return known & (along < 0), float((along[known] < 0).mean()) if known.any() else np.nan


def _legend(sheet: style.Sheet) -> list[Line2D]:
    look: dict[str, Any] = {"linestyle": "none", "marker": r"$\rightarrow$", "markersize": 11 * sheet.type}
    said = {
        "steepest descent by the gradient (white on the map)": style.QUIET,
        "where it opposes the slope between neighbouring samples": OPPOSED,
    }
    return [Line2D([], [], color=colour, label=label, **look) for label, colour in said.items()]


WIDTH, THUMBNAIL_SHAPE = 2.4, 0.75  # of the page [inch]; its height, against its width


def thumbnail_figure(dataset: xr.Dataset, *, width: float | None = None) -> Picture:
    """Draw the losses of a slice over a whole small page; samples that are not OK are grey."""
    sheet = style.Sheet.of(width, pitch=WIDTH)
    picture = Picture(sheet, THUMBNAIL_SHAPE * sheet.width)
    ax = picture.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    picture.set_facecolor(style.UNSAMPLED)
    if (drawn := _draw_alone(ax, dataset, linewidth=1.2)) is not None:
        drawn.set_interpolation("antialiased")
    return picture


def _frame(ax: Axes, *, shape: float, color: str = style.QUIET, linewidth: float = 0.4) -> None:
    """Remove the ticks of a panel; `shape` is its height over its width, and samples without a loss are grey."""
    ax.set(xticks=[], yticks=[], facecolor=style.UNSAMPLED)
    ax.set_box_aspect(shape)
    ax.spines[:].set(color=color, linewidth=linewidth)


def _map(
    ax: Axes, loss: NDArray[Any], scale: style.Scale, extent: tuple[float, float, float, float] | None = None
) -> AxesImage:
    """Draw losses, shape (v, u), as flat cells, with none where a loss is missing."""
    look: dict[str, Any] = {"origin": "lower", "aspect": "auto", "interpolation": "nearest", "extent": extent}
    return ax.imshow(np.ma.masked_invalid(loss), cmap=style.LOSS_MAP, norm=scale.norm, **look)
