"""Processes that methods compute in, beside each other: Python runs one thread at a time, whatever the cores."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import numpy as np

Result = TypeVar("Result")

_pool: ProcessPoolExecutor | None = None
_seconds = 0.0  # see `seconds_computed`


@contextmanager
def processes(count: int) -> Iterator[None]:
    """Let what is handed to `compute` meanwhile be computed by so many processes, which start as they are needed.

    With one, it is computed where it is called. Results are the same to the last bit.
    """
    global _pool
    if count == 1 or _pool is not None:
        yield
        return
    _pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), initializer=_begin)
    try:
        yield
    finally:
        pool, _pool = _pool, None
        pool.shutdown(cancel_futures=True)


def compute(function: Callable[..., Result], *arguments: Any) -> Result:
    """Return what a function of a module returns, computed by a process if there are any, and here otherwise."""
    global _seconds
    if _pool is not None:
        return _pool.submit(function, *arguments).result()
    began = time.perf_counter()
    result = function(*arguments)
    _seconds += time.perf_counter() - began
    return result


def seconds_computed() -> float:
    """Return how long `compute` has taken here [s]: what processes would take over. It is of one thread's calls."""
    return _seconds


def compute_drawing(random: np.random.Generator, function: Callable[..., Result], *arguments: Any) -> Result:
    """Return what function(*arguments, random) returns, by `compute`; `random` draws the same numbers wherever."""
    result: Result
    result, drawn = compute(_draw, random, function, arguments)
    random.bit_generator.state = drawn
    return result


def _draw(
    random: np.random.Generator, function: Callable[..., Result], arguments: tuple[Any, ...]
) -> tuple[Result, Any]:
    result = function(*arguments, random)
    return result, random.bit_generator.state


def _begin() -> None:
    """Prepare a process: one thread, deaf to an interrupt, which the first process answers, and gone with that one."""
    import torch

    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_the_first, daemon=True).start()


def _follow_the_first() -> None:
    first = multiprocessing.parent_process()
    if first is not None:
        first.join()
        os._exit(1)
