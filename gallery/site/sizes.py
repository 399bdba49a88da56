"""The sizes of a site's pictures, in its pages: a browser then keeps their room before they are there."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from PIL import Image

SHOWN = re.compile(r'<(?:img|video)\b(?![^>]*\swidth=)(?:[^>]*?\s(?:src|poster)="(?P<file>[^":]+\.(?:png|webp))")')


def give_sizes(site: Path) -> None:
    """Write width and height of each picture, and of each film that has a picture of its end, where it is shown."""
    for page in sorted(site.rglob("*.html")):
        text = page.read_text()
        sized = SHOWN.sub(partial(_sized, folder=page.parent), text)
        if sized != text:
            page.write_text(sized)


def _sized(found: re.Match[str], folder: Path) -> str:
    """Return a tag with the size of its picture, or as it was where that is not there or cannot be read."""
    try:
        with Image.open(folder / found["file"]) as picture:
            width, height = picture.size
    except OSError:
        return found[0]
    return f'{found[0]} width="{width}" height="{height}"'
