"""What the paper says, read from paper.toml: of landscapes in words, of races in claims, of figures in captions."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, NotRequired, TypedDict

from .files import PAPER

if TYPE_CHECKING:
    from ..optim.claims import Claim, Claims

ABSENT = "The paper does not have this environment, so it claims nothing about it."


@dataclass(frozen=True)
class PaperWords:
    """Hold the paper's words for an environment's landscape, of `classify.WORDS`, and where it says them.

    `losses` are the ends of the colour bars of its slices, None where they cannot be read.
    """

    words: tuple[str, ...]
    where: str
    losses: tuple[float, float] | None = None

    def __str__(self) -> str:
        said = f"{', '.join(self.words)} ({self.where})"
        return f"{said}; losses from {self.losses[0]:g} to {self.losses[1]:g} in its slices" if self.losses else said


@dataclass(frozen=True)
class PaperCaption:
    """Hold what the paper says, in our words, of what a slice shows, and the number of its figure, None in ours."""

    says: str = "It does not show this slice."
    number: int | None = None


@dataclass(frozen=True)
class Paper:
    """Hold all that the paper says: `words`, `claims` and `silences` by environment, `captions` by slice."""

    words: Mapping[str, PaperWords]
    claims: Mapping[str, tuple[Claim, ...]]
    silences: Mapping[str, str]
    captions: Mapping[str, PaperCaption]

    def claims_about(self, env: str) -> Claims:
        """Return which optimisers the paper has ahead of which others in an environment, or why it claims nothing."""
        from ..optim.claims import Claims

        claims = self.claims.get(env, ())
        return Claims(claims, None if claims else self.silences.get(env, ABSENT))

    def caption_of(self, slice_: str) -> PaperCaption:
        """Return what the paper says of a slice of the gallery."""
        return self.captions.get(slice_, PaperCaption())


class _Words(TypedDict):
    words: list[str]
    where: str
    losses: NotRequired[tuple[float, float]]


class _Claim(TypedDict):
    environments: list[str]
    first: list[str]
    second: list[str]
    source: str
    alike: NotRequired[bool]


class _Silence(TypedDict):
    environments: list[str]
    why: str


class _Caption(TypedDict):
    slices: list[str]
    says: str
    number: NotRequired[int]


@cache
def read_paper(path: Path = PAPER) -> Paper:
    """Read what the paper says. Raises ValueError where it says a word that landscapes are not described in."""
    with path.open("rb") as file:
        tables = tomllib.load(file)
    return Paper(
        _words(tables["environment"], path),
        _claims(tables["claim"]),
        _silences(tables["silence"]),
        _captions(tables["caption"]),
    )


def _words(tables: Mapping[str, _Words], path: Path) -> dict[str, PaperWords]:
    from ..landscapes.measures.classify import WORDS

    for name, table in tables.items():
        if unknown := set(table["words"]) - set(WORDS):
            raise ValueError(f"{path}: {name} has words {sorted(unknown)}; the words are {', '.join(WORDS)}")
    return {name: _words_of(table) for name, table in tables.items()}


def _words_of(table: _Words) -> PaperWords:
    losses = table.get("losses")
    return PaperWords(tuple(table["words"]), table["where"], (losses[0], losses[1]) if losses else None)


def _claims(tables: Sequence[_Claim]) -> dict[str, tuple[Claim, ...]]:
    from ..optim.claims import Claim

    claims: dict[str, tuple[Claim, ...]] = {}
    for table in tables:
        pairs = product(table["first"], table["second"])
        alike = table.get("alike", False)
        own = tuple(Claim(first, second, table["source"], alike) for first, second in pairs)
        for env in table["environments"]:
            claims[env] = claims.get(env, ()) + own
    return claims


def _silences(tables: Sequence[_Silence]) -> dict[str, str]:
    return {env: table["why"] for table in tables for env in table["environments"]}


def _captions(tables: Sequence[_Caption]) -> dict[str, PaperCaption]:
    return {name: PaperCaption(table["says"], table.get("number")) for table in tables for name in table["slices"]}
