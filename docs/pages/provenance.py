"""Where every picture comes from: what made it, when, by which version, and under which licence it may be used."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

from .included import INCLUDED
from .kept import NOT_MEASURED, Kept, KeptFigure
from .text import page, table

DOCS = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((DOCS.parent / "pyproject.toml").read_text())["project"]


def pages(kept: Kept) -> dict[str, str]:
    """Return the page."""
    made = tomllib.loads((DOCS / "pictures.toml").read_text())
    text = page(
        "Figures: licence and provenance",
        f"Every picture here was drawn by gradscape from what gradscape simulated, and has its licence, "
        f"{PROJECT['license']}. None is taken from the paper or from another project. Pictures also say on themselves "
        "by which version, where, when and by which command they were made.",
        "## The slices of the gallery",
        "Sampled with the command; *model* is the version of the scene's model then, and *current* says whether it is "
        "the one now.",
        table(("figure", "command", "gradscape", "device", "date", "model", "current"), map(_row, kept.figures)),
        "## The pictures of these pages",
        table(("picture", "shown in", "command"), _drawn(made)),
        "## What is of others",
        "The site's theme, pydata-sphinx-theme (BSD-3-Clause), brings the icons of Font Awesome Free (icons CC BY 4.0, "
        "fonts SIL OFL 1.1, code MIT); the site's search and its style are Sphinx's (BSD-2-Clause). "
        "[References](../references.md) names the papers that the code follows.",
    )
    return {"figures.md": text}


def _row(one: KeptFigure) -> tuple[str, ...]:
    if one.slice is None:
        return (f"`{one.figure.id}`", f"`{one.figure.command('auto')}`", NOT_MEASURED, "", "", "", "")
    known, made = one.slice.identity, one.slice.provenance
    command = made.get("command") or one.figure.command(known.get("device", "auto"))
    version = made.get("versions", {}).get("gradscape", "")
    said = (version, known.get("device", ""), made.get("created", ""), known["model_version"])
    return (f"`{one.figure.id}`", f"`{command}`", *map(str, said), "yes" if one.current else "no")


def _drawn(made: dict[str, str]) -> Iterator[tuple[str, ...]]:
    pages = {one: one.name for one in sorted(DOCS.glob("*.md"))}
    pages |= {DOCS.parent / name: here for name, here in INCLUDED.items()}
    for name, command in sorted(made.items()):
        shown = [here for file, here in pages.items() if re.search(rf"\((docs/)?{re.escape(name)}\)", file.read_text())]
        yield f"`{name}`", ", ".join(f"[{Path(one).stem}](../{one})" for one in shown), f"`{command}`"
