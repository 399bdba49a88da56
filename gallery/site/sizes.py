"""Sizes of the pictures in a site's pages, so that a browser reserves their space before they load."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from PIL import Image

SHOWN = re.compile(r'<(?:img|video)\b(?![^>]*\swidth=)(?:[^>]*?\s(?:src|poster)="(?P<file>[^":]+\.(?:png|webp))")')


def give_sizes(site: Path) -> None:
    """Write width and height into the tag of each picture, and of each film with a picture of its last frame."""
    for page in sorted(site.rglob("*.html")):
        text = page.read_text()
        sized = SHOWN.sub(partial(_sized, folder=page.parent), text)
        if sized != text:
            page.write_text(sized)


def _sized(found: re.Match[str], folder: Path) -> str:
    """Return a tag with the size of its picture, or unchanged if the picture is missing or cannot be read."""
    try:
        with Image.open(folder / found["file"]) as picture:
            width, height = picture.size
    except OSError:
        return found[0]
    return f'{found[0]} width="{width}" height="{height}"'
