"""A report card as small maps: a row for each scene, a map for each engine, on one scale in each row (matplotlib)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import groupby, zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from .. import style
from . import page, panel

if TYPE_CHECKING:
    from ...measures.card import Card, CardSlice, Grade

PITCH, ACROSS, SHAPE = 2.5, 6, 1.35  # room of a map on a screen [inch]; so many in a row; height of a row for that
FEWEST = 3  # for the legend below
LEAST = 27.0  # room of a map in print [mm]
ARROWS = 9  # most along each axis of a map
LENGTH = 0.09  # of an arrow, as a share of a side
OPPOSED = "#ff6b3d"  # legible on all of the map
OUTCOMES = {"passes": "#1b7837", "fails": "#b2182b", "not installed": style.QUIET}  # and the words themselves


def card_figure(card: Card, *, width: float | None = None) -> page.Picture:
    """Draw the losses and the direction of steepest descent by the gradient of every engine, scene by scene.

    Maps of a scene share a colour scale. An arrow is orange where the gradient opposes the slope between neighbouring
    samples, and white elsewhere; which share of all samples does stands over the map.

    Raises ValueError where the page is too narrow or too wide.
    """
    most = max(Counter(one.scene for one in card.grades).values())
    sheet = style.Sheet.of(width, pitch=PITCH, columns=min(ACROSS, max(FEWEST, most)), least=LEAST)
    rows = _rows(card, sheet.columns)
    picture = page.Picture(sheet, SHAPE * sheet.pitch * len(rows))
    axes = picture.subplots(len(rows), sheet.columns, squeeze=False)
    for scene, group in groupby(zip(rows, axes, strict=True), key=lambda one: card.grades[one[0][0]].scene):
        _draw_scene(scene, [place for row, places in group for place in zip_longest(row, places)], card)
    page.entitle(picture, "Report card of gradients")
    made = f"{card.created} · {card.device} · {', '.join(card.engines())}"
    page.finish(picture, _legend(sheet), heading=made)
    return picture


def _rows(card: Card, columns: int) -> list[list[int]]:
    """Return the numbers of the grades in each row of maps; every scene begins one."""
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
        unit = f" [{cuts[0].loss_unit}]" if cuts[0].loss_unit else ""
        shown = ScalarMappable(scale.norm, style.LOSS_MAP)
        panel.colour_bar(places[0][1], shown, f"{scene}: loss{unit}", scale, beside=[ax for _, ax in places], aspect=12)


def _draw_map(ax: Axes, grade: Grade, cut: CardSlice | None, scale: style.Scale) -> None:
    sheet, look = page.sheet_of(ax), OUTCOMES[grade.outcome]
    ax.set(xticks=[], yticks=[], facecolor=style.UNSAMPLED)
    ax.set_box_aspect(1)
    ax.spines[:].set(color=look, linewidth=1.6 * sheet.weight)
    said = grade.engine.replace(", ", ",\n") + f"\n{grade.outcome}"
    if cut is not None:
        opposed, share = opposing(cut)
        said += f"; {share:.0%} oppose" if np.isfinite(share) else ""
        ax.imshow(
            np.ma.masked_invalid(cut.loss), origin="lower", aspect="auto", interpolation="nearest", cmap=style.LOSS_MAP,
            norm=scale.norm, extent=(0, 1, 0, 1),
        )  # fmt: skip
        _draw_arrows(ax, cut, opposed)
        panel.name_axes(ax, *cut.labels)
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
    """Return where the gradient opposes the slope between neighbouring samples, and the share of those with both."""
    between = np.stack(np.gradient(cut.loss)[::-1], axis=-1) * (np.array(cut.loss.shape[::-1]) - 1)
    along = (between * cut.slope).sum(axis=-1)
    known = np.isfinite(along) & (np.linalg.norm(cut.slope, axis=-1) > 0)
    return known & (along < 0), float((along[known] < 0).mean()) if known.any() else np.nan


def _legend(sheet: style.Sheet) -> list[Line2D]:
    look: dict[str, Any] = {"linestyle": "none", "marker": r"$\rightarrow$", "markersize": 11 * sheet.type}
    return [
        Line2D([], [], color=style.QUIET, label="steepest descent by the gradient (white on the map)", **look),
        Line2D([], [], color=OPPOSED, label="where it opposes the slope between neighbouring samples", **look),
    ]
