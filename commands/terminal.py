"""The terminal, as `landscape` writes to it: what stands in a name is neither markup nor an emoji's name."""

from __future__ import annotations

from typing import Any

from rich import console as rich
from rich.progress import TextColumn
from rich.status import Status
from rich.text import Text


class Console(rich.Console):
    """Print text as it is: names and paths are other people's, and may hold [brackets] and :colons:."""

    def __init__(self, **look: Any) -> None:
        super().__init__(markup=False, emoji=False, **look)

    def status(self, status: rich.RenderableType, **look: Any) -> Status:
        """Say what is being done while it is; the text of a status is markup whatever the console says."""
        return _Plain(Text(status) if isinstance(status, str) else status, console=self, **look)


class _Plain(Status):
    def update(self, status: rich.RenderableType | None = None, **look: Any) -> None:
        super().update(Text(status) if isinstance(status, str) else status, **look)


class Described(TextColumn):
    """Say beside a bar what it counts, as it is."""

    def __init__(self) -> None:
        super().__init__("{task.description}", markup=False)
