"""The terminal, as the verbs write to it: tables, lines and bars."""

from __future__ import annotations

import shlex
import sys
from typing import Any

from rich.box import SIMPLE as SIMPLE
from rich.table import Table as Table
from rich.text import Text as Text

from ..api.progress import Bars as Bars
from ..api.progress import Console as Console
from ..api.progress import Described as Described


def command_line() -> str:
    """Return the command that this process runs, as one types it."""
    return shlex.join(["landscape", *sys.argv[1:]])


def number(value: float, form: str = ".3g") -> str:
    """Write a number, nothing where it is NaN."""
    return "" if value != value else format(value, form)


def table(*headings: str, title: str | None = None, **look: Any) -> Table:
    """Return an empty table whose columns fold where the terminal is narrow; `look` is rich's."""
    found = Table(title=title, title_justify="left", **look)
    for heading in headings:
        found.add_column(heading, overflow="fold")
    return found
