"""Spread a batch over threads, and lend them the solvers that serve one thread at a time."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from typing import Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

T = TypeVar("T")
Part = TypeVar("Part")
Result = TypeVar("Result")


def cores() -> int:
    """Count the cores this process may use."""
    from .engines import runtime

    return runtime.cores()


class Pool(Generic[T]):
    """Lend objects that serve one thread at a time, making a new one where none is idle; with `most` of them, wait."""

    def __init__(self, make: Callable[[], T], *, most: int | None = None) -> None:
        self._make = make
        self._idle: queue.LifoQueue[T] = queue.LifoQueue()
        self._making = threading.Lock()
        self._room = threading.Semaphore(most) if most else nullcontext()

    @contextmanager
    def lend(self) -> Iterator[T]:
        """Give an idle object, or a new one, for the length of a with block."""
        with self._room:
            try:
                item = self._idle.get_nowait()
            except queue.Empty:
                with self._making:
                    item = self._make()
            try:
                yield item
            finally:
                self._idle.put(item)


def copied(values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Copy numbers out of a solver's memory, which its next run overwrites, to float64 on the CPU.

    `.double().cpu()` would return that memory itself where a solver computes in float64 on a CPU.
    """
    return values.to("cpu", torch.float64, copy=True)


def map_parts(
    work: Callable[[Part], Result], parts: Sequence[Part], *, threads: int, stop: threading.Event
) -> list[Result]:
    """Do the work on each part, in several threads at once where there are some; `stop` is set while they give up."""
    if threads == 1 or len(parts) == 1:
        return list(map(work, parts))
    with ThreadPoolExecutor(threads) as executor:
        try:
            return list(executor.map(work, parts))
        except BaseException:  # an interrupt too: let no thread simulate on
            stop.set()
            executor.shutdown(cancel_futures=True)
            stop.clear()
            raise
