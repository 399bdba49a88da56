"""Progress of a job as bars: in a terminal and in a notebook, and nowhere else."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich import console as rich
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.status import Status
from rich.text import Text

from ..jobs.watch import Advance, AdvanceOne, Say, Watch
from ..landscapes.plain import printable


class Console(rich.Console):
    """Print text as it is, in one colour: names, paths and errors are other people's, with [brackets] and :colons:.

    Control characters, which a terminal would obey, are shown as their escapes.
    """

    def __init__(self, **look: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **look)

    def render_str(self, text: str, **look: Any) -> Text:
        """Lay out text, its control characters escaped before it is measured."""
        return super().render_str(printable(text), **look)

    def render(self, renderable: rich.RenderableType, options: rich.ConsoleOptions | None = None) -> Iterator[Segment]:
        """Render what is printed; of texts that were laid out elsewhere control characters are escaped here."""
        for part in super().render(renderable, options):
            yield part if part.control else part._replace(text=printable(part.text))

    def status(self, status: rich.RenderableType, **look: Any) -> Status:
        """Say what is being done while it is; the text of a status is markup whatever the console says."""
        return _PlainStatus(Text(status) if isinstance(status, str) else status, console=self, **look)


class _PlainStatus(Status):
    def update(self, status: rich.RenderableType | None = None, **look: Any) -> None:
        super().update(Text(status) if isinstance(status, str) else status, **look)


class Described(TextColumn):
    """Say next to a bar what it counts, as it is."""

    def __init__(self) -> None:
        super().__init__("{task.description}", markup=False)


class Bars(Watch):
    """Show what a job tells on a console: notes as lines, and bars while it works."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True, soft_wrap=True)

    folder: Path | None = None  # of the last job that has finished

    def finish(self, folder: Path, files: Sequence[str], said: str = "") -> None:
        """Print what came out, and which files are where."""
        self.folder = folder
        super().finish(folder, files, said)

    def note(self, text: str) -> None:
        """Print a line."""
        self.console.print(text)

    @contextmanager
    def busy(self, text: str) -> Iterator[Say]:
        """Turn a wheel next to a text, which may change."""
        with self.console.status(text) as status:
            yield status.update

    @contextmanager
    def progress(self, total: int, what: str = "episodes") -> Iterator[Advance]:
        """Show a bar with counts and times; the first advance says where it begins."""
        with Progress(*_columns(), console=self.console) as bar:
            task: Any = None

            def advance(done: int, said: str = "") -> None:
                nonlocal task
                if task is None:
                    task = bar.add_task(what, total=total, completed=done)
                bar.update(task, completed=done, description=said or what)

            yield advance

    @contextmanager
    def progress_of(self, totals: Mapping[str, int]) -> Iterator[AdvanceOne]:
        """Show a bar for each of several things, which is there from the beginning."""
        with Progress(*_columns(), console=self.console) as bar:
            tasks = {name: bar.add_task(name, total=total) for name, total in totals.items()}
            yield lambda name, done, said: bar.update(tasks[name], completed=done, description=said)


def _columns() -> tuple[ProgressColumn, ...]:
    """Return what is shown of a bar: what it counts, counts, the time it took, the time that is left."""
    begun = (Described(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return (*begun, TextColumn("left"), TimeRemainingColumn())


def default_watch() -> Watch:
    """Return what shows progress where somebody sees it: in a notebook or a terminal, not in a pipe."""
    console = Console(stderr=True, soft_wrap=True)
    return Bars(console) if console.is_jupyter or sys.stderr.isatty() else Watch()
