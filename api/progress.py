"""Progress of a job as bars: in a terminal and in a notebook, and nowhere else."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
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

LATE, LATE_SECONDS = 1.5, 5.0  # times what was announced, and seconds more than that, from which a job is late
ENOUGH_DONE = 0.02  # of a bar, by which it is told how long all of it takes


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


@dataclass
class Announcement:
    """Record the estimated time of a job [s], and when it was announced; a bar `begun` later says how much is done."""

    seconds: float
    said: float
    begun: float = 0.0
    first: float = 0.0
    share: float = 0.0

    def begin(self, share: float) -> None:
        """Begin to count, at this share of the bar."""
        self.begun, self.first, self.share = time.monotonic(), share, share

    def describe_delay(self) -> str:
        """Say that it takes longer, and how long if enough is done to estimate that; empty if it does not."""
        now = time.monotonic()
        if now - self.said <= max(LATE * self.seconds, self.seconds + LATE_SECONDS):
            return ""
        from ..landscapes.cost import duration

        done, said = self.share - self.first, f"slower than estimated: the estimate was {duration(self.seconds)}"
        if done < ENOUGH_DONE:
            return f"{said}, {duration(now - self.said)} have passed"
        whole = self.begun - self.said + (now - self.begun) * (1 - self.first) / done
        return f"{said}, it is now about {duration(whole)}"


class Bars(Watch):
    """Show what a job tells on a console: notes as lines, and bars while it works.

    A job that takes longer than it has announced says so, once.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True, soft_wrap=True)
        self._announced: Announcement | None = None

    def announce(self, text: str, seconds: float) -> None:
        """Print a line, and compare the job's progress with it later."""
        self.note(text)
        self._announced = Announcement(seconds, time.monotonic())

    def _look(self) -> None:
        """Say where a job takes longer than announced."""
        if self._announced and (said := self._announced.describe_delay()):
            self._announced = None
            self.note(said)

    def _follow(self, share: float, *, begin: bool = False) -> None:
        """Take what share of a bar is done."""
        if self._announced and begin:
            self._announced.begin(share)
        if self._announced:
            self._announced.share = share
        self._look()

    folder: Path | None = None  # of the last job that has finished

    def finish(self, folder: Path, files: Sequence[str], said: str = "") -> None:
        """Print what came out, and which files are where."""
        self.folder, self._announced = folder, None
        super().finish(folder, files, said)

    def note(self, text: str) -> None:
        """Print a line."""
        self.console.print(text)

    @contextmanager
    def busy(self, text: str) -> Iterator[Say]:
        """Turn a wheel next to a text, which may change."""
        with self.console.status(text) as status:

            def say(text: str) -> None:
                status.update(text)
                self._look()

            yield say
        self._look()

    @contextmanager
    def progress(self, total: int, what: str = "episodes") -> Iterator[Advance]:
        """Show a bar with counts and times; the first advance says where it begins."""
        with Progress(*_columns(), console=self.console) as bar:
            task: Any = None

            def advance(done: int, said: str = "") -> None:
                nonlocal task
                begin = task is None
                if begin:
                    task = bar.add_task(what, total=total, completed=done)
                bar.update(task, completed=done, description=said or what)
                self._follow(done / max(1, total), begin=begin)

            yield advance

    @contextmanager
    def progress_of(self, totals: Mapping[str, int]) -> Iterator[AdvanceOne]:
        """Show a bar for each of several things, which is there from the beginning."""
        with Progress(*_columns(), console=self.console) as bar:
            tasks, counts = {name: bar.add_task(name, total=total) for name, total in totals.items()}, dict[str, int]()

            def advance(name: str, done: int, said: str) -> None:
                bar.update(tasks[name], completed=done, description=said)
                begin = len(counts) < len(totals)  # the first of each says where it begins
                counts[name] = done
                self._follow(sum(counts.values()) / max(1, sum(totals.values())), begin=begin)

            yield advance


def _columns() -> tuple[ProgressColumn, ...]:
    """Return what is shown of a bar: what it counts, counts, the time it took, the time that is left."""
    begun = (Described(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return (*begun, TextColumn("left"), TimeRemainingColumn())


def default_watch() -> Watch:
    """Return what shows progress where somebody sees it: in a notebook or a terminal, not in a pipe."""
    console = Console(stderr=True, soft_wrap=True)
    return Bars(console) if console.is_jupyter or sys.stderr.isatty() else Watch()
