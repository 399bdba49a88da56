"""The report card as one self-contained page: a table of engines in scenes, with a panel for each slice."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from ...checks.examination import percent
from ...measures.card import Card, CardSlice, Grade, describe_share
from .. import style
from ..style import number
from .rendering import templates

if TYPE_CHECKING:
    from ..figure import Picture

PIXELS = 360  # of a panel, along each side
COLOURS = 96  # of a panel
FILTERS: dict[str, Callable[..., str]] = {"percent": percent, "off": describe_share}  # of the table's template
STOPS = 9  # of the gradient that stands for the colour map


@dataclass(frozen=True)
class CardRow:
    """A grade with its panel: the picture as a data link, the two axes, and the share of opposing gradients."""

    grade: Grade
    panel: str
    axes: tuple[str, str]
    opposing: str


@dataclass(frozen=True)
class CardScene:
    """The rows of a scene, which share a loss scale, with the ends and the unit of that scale."""

    name: str
    rows: Sequence[CardRow]
    low: str
    high: str
    unit: str
    logarithmic: bool


def card_scenes(card: Card) -> list[CardScene]:
    """Return the contents of the table scene by scene, with drawn panels."""
    return [_scene(card, name, places) for name, places in card.scenes()]


def card_page(card: Card) -> str:
    """Return a self-contained page, for light and dark screens."""
    pages = templates()
    pages.filters |= FILTERS
    return pages.get_template("card.html").render(card=card, scenes=card_scenes(card), colours=colour_stops())


def colour_stops() -> str:
    """Return the colours of the losses in CSS, from the lowest to the highest."""
    colours = (255 * style.LOSS_MAP(np.linspace(0, 1, STOPS))[:, :3]).round().astype(int)
    return ", ".join(f"rgb({red} {green} {blue})" for red, green, blue in colours.tolist())


def _scene(card: Card, name: str, places: Sequence[int]) -> CardScene:
    cuts = [card.slices[place] for place in places if place in card.slices]
    scale = style.Scale.of_loss(np.concatenate([cut.loss.ravel() for cut in cuts] or [np.zeros(1)]))
    low, high = map(number, scale.ends)
    rows = [_card_row(card.grades[place], card.slices.get(place), scale) for place in places]
    unit = cuts[0].loss_unit if cuts else ""
    return CardScene(name, rows, low if cuts else "", high, unit, scale.logarithmic)


def _card_row(grade: Grade, cut: CardSlice | None, scale: style.Scale) -> CardRow:
    if cut is None:
        return CardRow(grade, "", ("", ""), "")
    from ..figures.multiples import card_panel, opposing

    _, share = opposing(cut)
    panel = _embedded(card_panel(cut, scale, PIXELS))
    axes = tuple(f"{label}, {_ends(ticks)}" for label, ticks in zip(cut.labels, (cut.u, cut.v), strict=True))
    return CardRow(grade, panel, (axes[0], axes[1]), percent(share) if np.isfinite(share) else "")


def _embedded(picture: Picture) -> str:
    """Return a picture as a link that holds it, in so few colours that a page of many stays small."""
    picture.canvas.draw()
    pixels = Image.fromarray(np.asarray(picture.canvas.buffer_rgba())[..., :3])  # type: ignore[attr-defined] # of Agg
    held = BytesIO()
    pixels.quantize(COLOURS).save(held, "png", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(held.getvalue()).decode()}"


def _ends(ticks: np.ndarray) -> str:
    return f"{number(float(ticks[0]))} to {number(float(ticks[-1]))}"
