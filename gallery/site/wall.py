"""The front page: a slice of every environment with the results of its census, and the report card of engines."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from ...jobs.card import read_card
from ...landscapes.convert import from_json
from ...landscapes.measures.card import Card
from ...landscapes.measures.census import Census
from ...landscapes.measures.following import FOLLOWING_WORDS
from ...landscapes.measures.verdict import FLAT, WORDS
from ...landscapes.statistics import Estimate
from ...landscapes.storage.records import read_json, reading
from ...landscapes.storage.store import open_slice
from ..files import CARD, CARD_RECORD, DEVICES, STORE, WALL_PICTURE, WALL_TABLE, RecordFiles
from ..league import save_both
from .downloads import save_table
from .page_data import FigureEntry
from .studio import Studio

GRADIENTS = FOLLOWING_WORDS
SHAPES = tuple(word for word in WORDS if word not in (*GRADIENTS, FLAT))
MIN_SHARE = 1 / 3  # of the slices: from this share on a word is said of an environment
SHOWN_WORDS = 3  # of how smooth an environment is
MOSTLY = {  # what may be true of most slices: words of which a slice has one at most
    "very smooth": ("very smooth",),
    "smooth with local minima": ("smooth with local minima",),
    "rugged": ("rugged", "extremely rugged"),
    "gradients follow": ("gradients follow",),
}
REMAKE_CENSUS = "delete it, and `landscape census {} --device {}` measures it again"
REMAKE_CARD = "delete it, and `landscape card --out {}` measures it again"
SIZES = {"1-3": "1 to 3", "4-16": "4 to 16", "17-": "17 or more"}  # numbers of parameters, by the name in a link


@dataclass(frozen=True)
class WordShare:
    """A verdict word, the share of an environment's slices that it fits, and the interval if there is one."""

    word: str
    share: float
    low: float | None = None
    high: float | None = None

    def __str__(self) -> str:
        return f"{self.word} {self.share:.0%}".replace("%", "\N{NO-BREAK SPACE}%")


@dataclass(frozen=True)
class Tile:
    """An environment on the wall: the slice that is shown, and the share of slices that each word fits.

    The slices are those of its `census`, which has a command, a picture and a table, or else those of the gallery. The
    `flat` slices of a census are not counted. `most` lists what is true of most slices: the lower end of its 95 %
    interval is above one half.
    """

    env: str
    figure: str
    page: str
    labels: Sequence[str]
    dim: int
    engine: str
    slices: int
    census: bool
    words: Sequence[WordShare]
    picture: str = ""
    table: str = ""
    command: str = ""
    flat: int = 0
    most: Sequence[str] = ()

    def fitting(self, least: float = MIN_SHARE) -> list[str]:
        """Return the words that fit at least a share of the slices."""
        return [one.word for one in self.words if one.share >= least]

    @property
    def shape(self) -> list[WordShare]:
        """The most frequent words on smoothness, in descending order of their share."""
        found = [one for one in self.words if one.word in SHAPES and one.share > 0]
        return sorted(found, key=lambda one: -one.share)[:SHOWN_WORDS]

    def __str__(self) -> str:
        if not self.slices:
            return "not measured yet"
        said = ", ".join(map(str, self.shape)) or "no verdict"
        flat = f"; {self.flat} more are flat" if self.flat else ""
        return f"{said} of {self.slices} slice{'s' if self.slices > 1 else ''}{'' if self.census else ' here'}{flat}"

    def share(self, word: str) -> WordShare | None:
        """Return the share of a word, or None if it is not known."""
        return next((one for one in self.words if one.word == word), None)


def answers(tiles: Sequence[Tile]) -> tuple[str, str]:
    """Say how smooth the environments with a census are, and in which of them gradients follow."""
    counted = [tile for tile in tiles if tile.census and tile.slices]
    if not counted:
        return ("No environment has a census yet.",) * 2
    smooth, minima, rugged, follow = (_names(counted, said) for said in MOSTLY)
    many = f"{len(counted)} environment{'s' if len(counted) > 1 else ''}"
    return (
        f"A census has measured many slices of {many}. Most slices are very smooth in {smooth}, smooth with local "
        f"minima in {minima}, and rugged in {rugged}. In the others no verdict fits most slices, or the slices are too "
        "few to tell.",
        f"Gradients follow the loss over 1 % of the box in most slices of {follow}. In the others they follow loosely, "
        "in fewer slices or not at all, or the slices are too few to tell.",
    )


def _names(tiles: Sequence[Tile], said: str) -> str:
    """Return the names of the environments in which something is true of most slices."""
    return " and ".join(", ".join(tile.env for tile in tiles if said in tile.most).rsplit(", ", 1)) or "none"


def size_class(dim: int) -> str:
    """Return the class of a number of parameters, a key of `SIZES`."""
    return "1-3" if dim <= 3 else "4-16" if dim <= 16 else "17-"


def make_tiles(shown: Sequence[FigureEntry], data: Path, out: Path, studio: Studio) -> list[Tile]:
    """Copy the censuses of these figures' environments into the site, and return a tile for each environment."""
    groups = [(env, list(group)) for env, group in groupby(shown, key=lambda entry: entry.env)]
    return [_tile(env, group, data, out, studio) for env, group in groups]


def _tile(env: str, group: Sequence[FigureEntry], data: Path, out: Path, studio: Studio) -> Tile:
    best = max(group, key=lambda one: (len(one.labels), one.numbers.spread))
    about = (env, best.id, best.page, best.labels, best.dim, str(best.identity.get("engine", "")))
    if found := _place_census(env, data, out, studio):
        census, files = found
        words = [_word_share(word, one) for word, one in census.words.items() if math.isfinite(one.value)]
        picture, table = (path.relative_to(out).as_posix() for path in (files.picture, files.table))
        flat = len(census.slices) - census.solid
        most = [said for said, any_of in MOSTLY.items() if _is_most(census.share(any_of))]
        return Tile(*about, census.solid, True, words, picture, table, census.command, flat, most)
    said = [set(entry.words) for entry in group if entry.report is not None]
    words = [WordShare(word, sum(word in one for one in said) / len(said)) for word in WORDS] if said else []
    return Tile(*about, len(said), False, words)


def _is_most(share: Estimate) -> bool:
    return (share.low if math.isfinite(share.low) else share.value) > 0.5


def _word_share(word: str, share: Estimate) -> WordShare:
    ends = (share.low, share.high) if math.isfinite(share.low) else (None, None)
    return WordShare(word, share.value, *ends)


def _place_census(env: str, data: Path, out: Path, studio: Studio) -> tuple[Census, RecordFiles] | None:
    """Copy a census with the table of its slices into the site, and return it with its files, or None without one."""
    for device in DEVICES:
        source, target = (RecordFiles.of_census(root, env, device) for root in (data, out))
        if not source.there():
            continue
        with reading(source.record, REMAKE_CENSUS.format(env, device)):
            census = from_json(Census, read_json(source.record))
            rows = list(_census_rows(census))
        studio.place(source, target)
        save_table(rows, target.table)
        return census, target
    return None


def _census_rows(census: Census) -> Iterator[Mapping[str, Any]]:
    """Yield a row for each slice of a census."""
    unit = f" [{census.loss_unit}]" if census.loss_unit else ""
    for one in census.slices:
        low, high = one.range or (None, None)
        measured = dict(zip(census.spreads, one.measures, strict=True))
        place = {"base": one.base, "cut": one.cut, "axes": " x ".join(one.axes)}
        ends = {f"lowest{unit}": low, f"highest{unit}": high, "failed": one.failed}
        yield {**place, **ends, **measured, "words": "; ".join(one.words)}


def draw_wall(tiles: Sequence[Tile], data: Path, out: Path) -> None:
    """Draw the wall and write its table."""
    from ...landscapes.draw.figures.multiples import Landscape, wall_figure

    hung = [Landscape(tile.env, str(tile), open_slice(data / tile.figure / STORE)) for tile in tiles]
    save_both(wall_figure(hung), out / WALL_PICTURE)
    rows = []
    for tile in tiles:
        source = "census" if tile.census else "gallery"
        about = {"environment": tile.env, "parameters": tile.dim, "engine": tile.engine, "slices": tile.slices}
        rows += [{**about, "source": source, **asdict(one)} for one in tile.words]
    save_table(rows, out / WALL_TABLE)


def place_card(data: Path, out: Path, studio: Studio) -> Card | None:
    """Copy the report card of the figures' data into the site, and return it, or None without one."""
    source, target = (RecordFiles(root / CARD / CARD_RECORD) for root in (data, out))
    if not source.there():
        return None
    with reading(source.record, REMAKE_CARD.format(data / CARD)):
        card = read_card(source.record)
    studio.place(source, target)
    rows = card.table().reset_index()
    save_table(rows.where(rows.notna(), "").to_dict("records"), target.table)
    return card
