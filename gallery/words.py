"""What the paper says of each environment's landscape."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from ..landscapes.measures.classify import WORDS

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Said:
    """Hold the paper's words for a landscape, of `verdict.WORDS`, and where it says them."""

    words: tuple[str, ...]
    where: str


def paper_words(path: Path = HERE / "words.toml") -> dict[str, Said]:
    """Read what the paper says, by environment."""
    with path.open("rb") as file:
        tables = tomllib.load(file)
    for name, table in tables.items():
        if unknown := set(table["words"]) - set(WORDS):
            raise ValueError(f"{path}: {name} has words {sorted(unknown)}; the words are {', '.join(WORDS)}")
    return {name: Said(tuple(table["words"]), table["where"]) for name, table in tables.items()}
