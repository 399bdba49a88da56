"""Turns of threads: one works, the others wait.

Python runs one thread at a time anyway, and threads that all want to run pass that on at every call of torch, which
costs more than the calls.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

_mine = threading.local()  # of each thread: the turns that it takes part in


class Turns:
    """Let one thread work at a time, of those that take and give turns."""

    def __init__(self) -> None:
        self._free = threading.Lock()
        self._own = threading.local()  # of each thread: how long it has waited [s]

    def take(self) -> None:
        """Wait until no other thread works."""
        began = time.perf_counter()
        self._free.acquire()
        self._own.waited = self.waited + time.perf_counter() - began
        _mine.turns = self

    def give(self) -> None:
        """Let another thread work."""
        _mine.turns = None
        self._free.release()

    @property
    def waited(self) -> float:
        """How long the calling thread has waited for its turns [s]."""
        return float(getattr(self._own, "waited", 0.0))


@contextmanager
def aside() -> Iterator[None]:
    """Let other threads work within a with block, in which the calling one waits for something else."""
    turns: Turns | None = getattr(_mine, "turns", None)
    if turns is None:
        yield
        return
    turns.give()
    try:
        yield
    finally:
        turns.take()
