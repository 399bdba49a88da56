"""Typesetting of a picture: the page gets the height that its panels need, and text is wrapped to its room."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.font_manager import FontProperties
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.textpath import text_to_path

from .. import style

if TYPE_CHECKING:
    from ..figure import Picture

MARGIN = 0.1  # between type and the edge of the page [inch]
HINTED = 1.06  # small type whose letters are moved to whole pixels is up to so much wider
MORE, LEAST = " …", 3  # what stands for the rest of a text; characters of a line
BESIDE = 1.2  # length of what is written up a panel's side, against it, at most
AMPLE = 3.0  # height to begin with that no legend or title uses up [inch]
NEARLY, TURNS = 0.02, 8  # as high as it has to be [inch]; most attempts at it


def settle(picture: Picture) -> None:
    """Make the page as high as what stands on it, panels as wide as they may be in their proportions; then keep it.

    Meanwhile panels fill the room they have: the layout takes what a panel leaves of it for its margins'.
    """
    shapes = {ax: shape for ax in picture.axes if (shape := ax.get_box_aspect()) and ax.get_subplotspec()}
    for ax in shapes:  # a colour bar has no place in the grid: it goes with its panel
        ax.set_box_aspect(None)
    _set_height(picture, picture.get_figheight() + AMPLE)
    for turn in range(TURNS):
        if turn < TURNS / 2:  # or lines might break now here, now there
            _wrap(picture)
        _lay_out(picture)
        if abs(lack := _missing_height(picture, shapes)) < NEARLY:
            break
        _set_height(picture, picture.get_figheight() + lack)
    for ax, shape in shapes.items():
        ax.set_box_aspect(shape)
        ax.apply_aspect()


def _set_height(picture: Picture, height: float) -> None:
    """Set the height of the page to whole pixels of a screen [inch]."""
    picture.set_figheight(round(height * style.DPI) / style.DPI)


def _lay_out(picture: Picture) -> None:
    """Place the panels, by matplotlib's constrained layout.

    It measures a panel, most of its work, several times in one place, a shared colour bar once for each of its panels;
    each time it asks either axis for its ticks and their boxes up to eight times.
    """
    with ExitStack() as kept:
        for ax in picture.axes:
            _ask_once(ax, "get_tightbbox", ax, kept)
            for axis, name in product((ax.xaxis, ax.yaxis), ("_update_ticks", "_get_ticklabel_bboxes")):
                _ask_once(axis, name, ax, kept)
        ConstrainedLayoutEngine().execute(picture)


def _ask_once(artist: Artist, name: str, ax: Axes, kept: ExitStack) -> None:
    """Let a method of a panel, or of its axis, be run anew only where the panel has moved, until `kept` is closed."""
    ask: Callable[..., Any] | None = getattr(artist, name, None)
    if ask is None:  # a matplotlib that has no such method is only slower
        return
    known: dict[str, Any] = {}

    def answer(*about: Any, **how: Any) -> Any:
        if known.get("place") != ax.bbox.bounds:
            known["answer"] = ask(*about, **how)
            known["place"] = ax.bbox.bounds  # afterwards: measuring a panel gives it its proportions
        return known["answer"]

    setattr(artist, name, answer)
    kept.callback(delattr, artist, name)


def _missing_height(picture: Picture, shapes: Mapping[Axes, float]) -> float:
    """Return how much higher the page should be for its panels to have their shapes, height against width [inch]."""
    width, height = picture.get_size_inches()
    rows: dict[int, float] = {}
    for ax, shape in shapes.items():
        room, spec = ax.get_position(), ax.get_subplotspec()
        assert spec is not None  # as the panels were chosen
        row, need = spec.rowspan.start, shape * room.width * width - room.height * height
        rows[row] = max(need, rows.get(row, need))
    return float(sum(rows.values()))


def _wrap(picture: Picture) -> None:
    for text, (said, room) in picture.fitted.items():
        size = float(text.get_fontsize())
        text.set_text("\n".join(wrap_text(line, room(), size) for line in said.split("\n")))


def title_room(ax: Axes) -> float:
    """Return how wide what is written about a panel's middle may be, for the columns it has of the page [inch]."""
    spec, box, (width, _) = ax.get_subplotspec(), ax.get_position(), _page_size(ax)
    if spec is None:
        return width
    columns = spec.get_gridspec().ncols
    middle = (box.x0 + box.x1) / 2
    aside = min(middle - spec.colspan.start / columns, spec.colspan.stop / columns - middle)
    return float(2 * width * aside - MARGIN)


def side_room(ax: Axes) -> float:
    """Return how long what is written up a panel's side may be [inch]."""
    return float(BESIDE * ax.get_position().height * _page_size(ax)[1])


def _page_size(ax: Axes) -> tuple[float, float]:
    page = ax.get_figure(root=True)
    assert page is not None  # panels are on one
    width, height = page.get_size_inches()
    return float(width), float(height)


@lru_cache(1024)  # a page is laid out several times, with the same texts
def wrap_text(text: str, width: float, size: float, *, lines: int = 2) -> str:
    """Break a text in a type size [pt] into so many lines of a width [inch] at most, about equally long."""
    broken, fits = [text], len(text)
    while fits > LEAST and (most := max(text_width(line, size) for line in broken)) > width:
        fits = min(fits - 1, int(1.1 * fits * width / most))
        broken = _break_lines(text, max(fits, LEAST), lines)
    shorter = broken
    while fits > LEAST and len(shorter) == len(broken) > 1 and not shorter[-1].endswith(MORE):
        broken, fits = shorter, fits - 1
        shorter = _break_lines(text, fits, lines)
    return "\n".join(broken)


def _break_lines(text: str, fits: int, lines: int) -> list[str]:
    return textwrap.wrap(text, fits, max_lines=lines, placeholder=MORE, break_on_hyphens=False) or [text]


@lru_cache(4096)
def text_width(text: str, size: float) -> float:
    """Return how much room type of a size [pt] takes at most [inch], on a screen or on paper."""
    width, _, _ = text_to_path.get_text_width_height_descent(text, FontProperties(size=size), ismath=False)
    return HINTED * float(width) / 72
