"""Docstrings and help texts as Markdown: what they have in backticks is code, and nothing else is marked up."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

CODE = re.compile(r"(`[^`]+`)")
SPECIAL = re.compile(r"([\\*_\[\]<>$#|{}~])")


def prose(text: str) -> str:
    """Return a text whose characters mean themselves but for backticks, and for empty lines, which part paragraphs."""
    parts = CODE.split(text)
    return "".join(part if CODE.fullmatch(part) else SPECIAL.sub(r"\\\1", part) for part in parts)


def cell(text: str) -> str:
    """Return a text for a cell of a table: in one line, and of whose bars none ends the cell."""
    return " ".join(re.sub(r"(?<!\\)\|", r"\\|", prose(text)).split())


def code(text: str) -> str:
    """Return what stands between backticks in a cell of a table: its bars end no cell."""
    return text.replace("|", "\\|")


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of cells that are Markdown already."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in lines)


def page(title: str, *parts: str) -> str:
    """Return a page: its title, and what it holds, each part parted by an empty line; empty ones are left out."""
    return "\n\n".join([f"# {title}", *(part.strip("\n") for part in parts if part.strip())]) + "\n"


def contents(entries: Iterable[str], *, options: Sequence[str] = (":maxdepth: 1",)) -> str:
    """Return a table of contents of pages, by their paths from the page it stands on."""
    return "\n".join(["```{toctree}", *options, "", *entries, "```"])
