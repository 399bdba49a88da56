"""Tables that a program writes into a page of the docs, between two marks: <!-- NAME --> and <!-- /NAME -->."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def written(page: Path, name: str) -> str:
    """Return the table of a name that a page holds; raises ValueError where it has no such marks, or two of them."""
    (found,) = re.findall(rf"<!-- {name} -->\n\n(.*?)\n\n<!-- /{name} -->", page.read_text(), flags=re.DOTALL)
    return str(found)


def write(text: str, page: Path, name: str) -> None:
    """Put a table into a page, in the place of the one of this name."""
    page.write_text(page.read_text().replace(written(page, name), text))
