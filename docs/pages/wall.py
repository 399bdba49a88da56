"""The gallery on a page: a small picture of every slice, which leads to its page of the gallery or to its scene's."""

from __future__ import annotations

from pathlib import Path

from .kept import NOT_MEASURED, Kept, KeptFigure
from .pictures import draw_slice, shown
from .text import page


def pages(kept: Kept, pictures: Path) -> dict[str, str]:
    """Return the page; small pictures are drawn beside."""
    whole = (
        '<a href="../gallery/index.html">The gallery</a> has a page for each of these: with a map to walk over, a '
        "surface, films, episodes and what was measured."
        if kept.gallery
        else "`landscape gallery build` makes a page for each of these, with a map to walk over, a surface, films and "
        "episodes. `make docs` takes that site in where it is built."
    )
    parts = [part for env in kept.by_env for part in _scene(env, kept, pictures)]
    return {"wall.md": page("Gallery", f"{whole} [How it is made](../gallery.md).", *parts)}


def _scene(env: str, kept: Kept, pictures: Path) -> list[str]:
    there = [one for one in kept.by_env[env] if one.slice is not None]
    return [f"## [{env}](scenes/{env}.md)", *(_shown(one, kept, pictures) for one in there)] if there else []


def _shown(one: KeptFigure, kept: Kept, pictures: Path) -> str:
    """Return a picture in both colours, with what it shows."""
    name = draw_slice(one, pictures, small=True)
    leads = f"../gallery/{one.figure.id}/index.html" if kept.gallery else f"scenes/{one.figure.env}.html"
    words = ", ".join(one.report.words) if one.report else NOT_MEASURED
    assert one.slice is not None
    alt = f"{one.figure.id}: losses over {' and '.join(one.slice.plane.labels)}; {words}"
    return shown(name, alt, "", look="wall", leads=leads)
