"""Whoever watches a job in a test: one keeps what it tells, one interrupts it."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gradscape.jobs.watch import Watch


class Told(Watch):
    """Keep what a job tells."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def note(self, text: str) -> None:
        self.lines.append(text)


class Stop(Watch):
    """Interrupt a job once so much of it is done, as Ctrl-C does."""

    def __init__(self, at: int) -> None:
        self.at = at

    @contextmanager
    def progress(self, total: int, what: str = "episodes") -> Iterator[Any]:
        def advance(done: int, said: str = "") -> None:
            if done >= self.at:
                raise KeyboardInterrupt

        yield advance
