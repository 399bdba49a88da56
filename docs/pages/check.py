"""Check every page that was built.

No page loads anything from elsewhere, no link is broken, and every picture has an alternative text.

    python -m docs.pages.check build/docs
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urlsplit

from bs4 import BeautifulSoup, Tag

# Attributes that make a browser load what they name; a link to click, <a href>, loads nothing by itself.
LOADED = ("src", "srcset", "poster", "data", "background", "action", "formaction", "xlink:href")
UNLOADED = {"canonical", "alternate", "license", "author", "prev", "next", "search", "index"}  # kinds of <link>
ELSEWHERE = re.compile(r"^\s*(?:(?:https?|wss?|ftp):)?//", re.IGNORECASE)
STYLED = re.compile(r"""url\(\s*['"]?([^'")]+)|@import\s+['"]([^'"]+)""", re.IGNORECASE)


@dataclass(frozen=True)
class Page:
    """What a page loads, its links, its anchors, and its pictures without an alternative text."""

    loads: list[str]
    links: list[str]
    anchors: set[str]
    unsaid: list[str]

    @classmethod
    def read(cls, file: Path) -> Page:
        """Read a file."""
        soup = BeautifulSoup(file.read_text(), "html.parser", multi_valued_attributes=None)
        elements = soup.find_all(True)
        loads = [one[name] for one in elements for name in LOADED if one.get(name)]
        loads += [one for element in elements for one in styled(element.get("style", ""))]
        loads += [one for sheet in soup("style") for one in styled(sheet.get_text())]
        loads += [one.get("href", "") for one in soup("link") if not UNLOADED & {*one.get("rel", "").lower().split()}]
        return cls(
            loads,
            [one["href"] for one in soup(["a", "area"], href=True)],
            {one[name] for one in elements for name in ("id", "name") if one.get(name)},
            [one.get("src", "") for one in soup("img") if _last(one, "alt") in ("-", _last(one, "src"))],
        )


def styled(sheet: str) -> list[str]:
    """Return the addresses that a style sheet loads."""
    return [found[1] or found[2] for found in STYLED.finditer(sheet)]


def pages_of(root: Path) -> list[Path]:
    """Return the pages of a site, without those that its theme keeps with styles and scripts."""
    return [file for file in sorted(root.rglob("*.html")) if "_static" not in file.relative_to(root).parts]


def find_faults(root: Path) -> Iterator[str]:
    """Yield the faults in a folder of pages, one line each: loads from elsewhere, missing texts, broken links."""
    read = cache(Page.read)
    for file in pages_of(root):
        page, name = read(file), file.relative_to(root)
        yield from (f"{name} loads {one}" for one in page.loads if ELSEWHERE.match(one))
        yield from (f"{name} shows {one} without an alternative text" for one in page.unsaid)
        for address in dict.fromkeys([*page.loads, *page.links]):
            parts = urlsplit(address.split(" ")[0])
            if parts.scheme or parts.netloc:
                continue
            target = file.parent / unquote(parts.path) if parts.path else file
            target = target / "index.html" if target.is_dir() else target
            if not target.exists():
                yield f"{name}: {address} leads nowhere"
            anchor = "" if "=" in parts.fragment else unquote(parts.fragment)  # #node=3,4 is the state of a page
            if anchor and target.suffix == ".html" and target.exists() and anchor not in read(target).anchors:
                yield f"{name}: {address} leads to no anchor"
    for file in sorted(root.rglob("*.css")):
        yield from (f"{file.relative_to(root)} loads {one}" for one in styled(file.read_text()) if ELSEWHERE.match(one))


def _last(picture: Tag, attribute: str) -> str:
    return str(picture.get(attribute, "-")).rpartition("/")[2]


def main(folder: str) -> None:
    """Print the faults of a site, and exit with 1 if there are any, or no page."""
    root = Path(folder)
    pages, faults = pages_of(root), list(find_faults(root))
    print(*faults, f"{len(pages)} pages, {len(faults)} faults", sep="\n")
    sys.exit(bool(faults) or not pages)


if __name__ == "__main__":
    main(sys.argv[1])
