"""Markdown templates of pages; texts of the package are escaped, except for code in backticks."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

CODE = re.compile(r"(`[^`]+`)")
SPECIAL = re.compile(r"([\\*_\[\]<>$#|{}~])")


def prose(text: str) -> str:
    """Escape Markdown in a text, except for backticks, and for empty lines between paragraphs."""
    parts = CODE.split(text)
    return "".join(part if CODE.fullmatch(part) else SPECIAL.sub(r"\\\1", part) for part in parts)


def cell(text: str) -> str:
    """Return a text for a cell of a table: in one line, with escaped bars."""
    return " ".join(re.sub(r"(?<!\\)\|", r"\\|", prose(text)).split())


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of cells that are Markdown already."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in lines)


TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parents[1] / "templates"),
    undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
)  # fmt: skip
TEMPLATES.filters |= {"prose": prose, "cell": cell, "code": lambda text: text.replace("|", "\\|")}


def render(template: str, **shown: Any) -> str:
    """Render a template, such as "wall.md", with its data."""
    return TEMPLATES.get_template(f"{template}.jinja").render(shown)
