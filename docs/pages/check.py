"""Read every page that was built: none may load anything from elsewhere, no link or anchor may lead nowhere, and every
picture says what it is.

    python -m docs.pages.check build/docs
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

# Attributes that make a browser load what they name; a link to click, <a href>, loads nothing by itself.
LOADED = {"src", "srcset", "poster", "data", "background", "action", "formaction", "xlink:href"}
UNLOADED = {"canonical", "alternate", "license", "author", "prev", "next", "search", "index"}  # kinds of <link>
ELSEWHERE = re.compile(r"^\s*(?:(?:https?|wss?|ftp):)?//", re.IGNORECASE)
STYLED = re.compile(r"""url\(\s*['"]?([^'")]+)|@import\s+['"]([^'"]+)""", re.IGNORECASE)


@dataclass
class Page(HTMLParser):
    """What a page says that it loads, what it links to, and what can be linked to in it."""

    loads: list[str] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)
    unsaid: list[str] = field(default_factory=list)  # pictures that say nothing to who does not see them

    def __post_init__(self) -> None:
        super().__init__()
        self._styles = False

    @classmethod
    def read(cls, file: Path) -> Page:
        """Read a file."""
        page = cls()
        page.feed(file.read_text())
        page.close()
        return page

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take down what an element loads, links to and is called."""
        given = {name: value or "" for name, value in attrs}
        self._styles = tag == "style"
        self.anchors |= {given[name] for name in ("id", "name") if given.get(name)}
        self.loads += [given[name] for name in LOADED & given.keys() if not (tag == "form" and not given[name])]
        self.loads += styled(given.get("style", ""))
        if tag == "img" and given.get("alt", "-").rpartition("/")[2] in ("-", given.get("src", "-").rpartition("/")[2]):
            self.unsaid.append(given.get("src", ""))
        if tag in ("a", "area") and "href" in given:
            self.links.append(given["href"])
        if tag == "link" and not UNLOADED & set(given.get("rel", "").lower().split()):
            self.loads.append(given.get("href", ""))

    def handle_endtag(self, tag: str) -> None:
        """Leave a style sheet."""
        self._styles = self._styles and tag != "style"

    def handle_data(self, data: str) -> None:
        """Take down what a style sheet of the page loads."""
        if self._styles:
            self.loads += styled(data)


def styled(sheet: str) -> list[str]:
    """Return what a style sheet loads."""
    return [found[1] or found[2] for found in STYLED.finditer(sheet)]


def pages_of(root: Path) -> list[Path]:
    """Return the pages of a site: all but what its theme keeps beside styles and scripts."""
    return [file for file in sorted(root.rglob("*.html")) if "_static" not in file.relative_to(root).parts]


def find_faults(root: Path) -> Iterator[str]:
    """Yield what is wrong in a folder of pages, a line each: what is loaded from elsewhere, what leads nowhere."""
    read = cache(Page.read)
    for file in pages_of(root):
        page, name = read(file), file.relative_to(root)
        yield from (f"{name} loads {one}" for one in page.loads if ELSEWHERE.match(one))
        yield from (f"{name} shows {one} without saying what it is" for one in page.unsaid)
        here = [one for one in (*page.loads, *page.links) if _is_here(one)]
        yield from (f"{name}: {fault}" for one in dict.fromkeys(here) if (fault := _fault(one, file, read)))
    for file in sorted(root.rglob("*.css")):
        yield from (f"{file.relative_to(root)} loads {one}" for one in styled(file.read_text()) if ELSEWHERE.match(one))


def _is_here(address: str) -> bool:
    parts = urlsplit(address)
    return not parts.scheme and not parts.netloc


def _fault(address: str, file: Path, read: object) -> str:
    """Say what is wrong with an address of the site that stands in a file; empty if nothing is."""
    parts = urlsplit(address.split(" ")[0])
    target = file.parent / unquote(parts.path) if parts.path else file
    target = target / "index.html" if target.is_dir() else target
    if not target.exists():
        return f"{address} leads nowhere"
    said = "=" in parts.fragment  # what a page is to show, as the gallery's do: #node=3,4 is no anchor
    if parts.fragment and not said and target.suffix == ".html" and unquote(parts.fragment) not in read(target).anchors:  # type: ignore[operator] # Page.read, cached
        return f"{address} leads to no anchor"
    return ""


def main(folder: str) -> None:
    """Print the faults of a site. Exits with 1 where there are any, or no page."""
    root = Path(folder)
    pages, faults = pages_of(root), list(find_faults(root))
    print(*faults, f"{len(pages)} pages, {len(faults)} faults", sep="\n")
    sys.exit(bool(faults) or not pages)


if __name__ == "__main__":
    main(sys.argv[1])
