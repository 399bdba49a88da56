"""The front page: three questions over all environments, and what its slices are filtered by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from ...landscapes.measures.card import Card
from ...landscapes.measures.classify import WORDS
from .league import LeaguePage
from .manifest import FigureEntry, Tile, WordShare
from .wall import FITS, GRADIENTS, SHAPES, dimension

LARGEST = 10**9
SIZES = {"1-3": (1, 3), "4-16": (4, 16), "17-": (17, LARGEST)}  # numbers of parameters, by the name in a link


@dataclass(frozen=True)
class Front:
    """All that the front page shows: slices, a tile for each environment, and the report card and the league if any."""

    shown: Sequence[FigureEntry]
    tiles: Sequence[Tile]
    card: Card | None
    league: LeaguePage | None

    @property
    def groups(self) -> list[tuple[str, list[FigureEntry]]]:
        """The slices by their environments."""
        return [(env, list(group)) for env, group in groupby(self.shown, key=lambda entry: entry.env)]

    @property
    def words(self) -> list[str]:
        """The words that are said of an environment or of a slice."""
        said = {word for tile in self.tiles for word in tile.fitting(FITS)}
        said |= {word for entry in self.shown for word in self.words_of(entry)}
        return [word for word in WORDS if word in said]

    @property
    def engines(self) -> list[str]:
        """The engines that simulated them."""
        return sorted({tile.engine for tile in self.tiles if tile.engine})

    @property
    def sizes(self) -> dict[str, str]:
        """The classes of numbers of parameters that there are, by their names in a link, in words."""
        there = {self.size(tile.dim) for tile in self.tiles}
        return {
            name: f"{low} or more" if high == LARGEST else f"{low} to {high}"
            for name, (low, high) in SIZES.items()
            if name in there
        }

    @property
    def gradients(self) -> Sequence[str]:
        """The words of gradients."""
        return GRADIENTS

    @property
    def measured(self) -> list[Tile]:
        """The environments of which anything is measured."""
        return [tile for tile in self.tiles if tile.slices]

    def size(self, dim: int) -> str:
        """Return the class of a number of parameters."""
        return next(name for name, (low, high) in SIZES.items() if low <= dim <= high)

    def size_of(self, entry: FigureEntry) -> str:
        """Return the class of the number of parameters of a slice's environment."""
        return self.size(dimension(entry))

    def words_of(self, entry: FigureEntry) -> list[str]:
        """Return the words that were measured of a slice."""
        return [one.word for one in entry.report.words if one.measured] if entry.report is not None else []

    def said_of(self, tile: Tile) -> list[str]:
        """Return the words that an environment is found by."""
        return tile.fitting(FITS)

    def shape_of(self, tile: Tile) -> list[WordShare]:
        """Return how smooth an environment is: the words that fit most of its slices."""
        return tile.best(SHAPES)
