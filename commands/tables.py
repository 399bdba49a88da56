"""Tables on a terminal: what is too wide for it goes on in the next line, and no name is cut."""

from __future__ import annotations

from typing import Any

from rich.table import Table


def table(*headings: str, title: str | None = None, **look: Any) -> Table:
    """Return an empty table whose columns fold where the terminal is narrow; `look` is rich's."""
    found = Table(title=title, title_justify="left", **look)
    for heading in headings:
        found.add_column(heading, overflow="fold")
    return found
