"""The templates of pages, and the format of their numbers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import jinja2

HERE = Path(__file__).parent
TEMPLATES, STATIC = HERE / "templates", HERE / "static"
STYLE = "style.css"
SCRIPTS = ("slice", "scale", "marks", "view", "axes", "map", "profile", "walk", "surface", "page", "save")  # in order
OF_PLANES = ("profile", "surface")  # which a line does without


def templates(*more: Path) -> jinja2.Environment:
    """Return these templates, after those in `more` folders, with the filters that all of them use."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    pages = Environment(
        loader=FileSystemLoader([*more, TEMPLATES]), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    pages.filters["number"] = number
    pages.filters["times"] = lambda text: re.sub(r"(?<=\d) x (?=[\d(])", " \N{MULTIPLICATION SIGN} ", text)
    return pages


def scripts(rank: int) -> list[str]:
    """Return the names of the scripts on a slice's page, in order."""
    return [f"{name}.js" for name in SCRIPTS if rank == 2 or name not in OF_PLANES]


def number(value: Any, digits: int = 4) -> str:
    """Write a number with a proper minus sign, and anything else unchanged."""
    return f"{value:z.{digits}g}".replace("-", "\N{MINUS SIGN}") if isinstance(value, int | float) else str(value)
