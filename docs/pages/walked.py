"""All pages that are walked, by their paths under `generated/`, and how they are written."""

from __future__ import annotations

from pathlib import Path

from . import commands, interface, package, provenance, reproduction, scenes, wall
from .kept import Kept

PICTURES = "pictures"


def write_pages(folder: Path, *, gallery: Path | None) -> None:
    """Write the pages into a folder that holds nothing else: those that are gone from the project go."""
    kept = Kept.read(gallery=gallery)
    pictures = folder / PICTURES
    pages = {
        **commands.pages(),
        **interface.pages(),
        **package.pages(),
        **scenes.pages(kept, pictures),
        **reproduction.pages(kept, pictures),
        **provenance.pages(kept),
        **wall.pages(kept, pictures),
    }
    for old in folder.rglob("*.md"):
        if old.relative_to(folder).as_posix() not in pages:
            old.unlink()
    for name, text in pages.items():
        file = folder / name
        if not file.exists() or file.read_text() != text:  # an equal page is not built again
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
