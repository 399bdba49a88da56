"""Processes that methods compute in, beside each other: Python runs one thread at a time, whatever the cores."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from .turns import aside

if TYPE_CHECKING:
    import numpy as np

Result = TypeVar("Result")

WORTH = 100  # episodes left of a run; processes are not started for fewer

_pools: list[ProcessPoolExecutor] = []  # of one process each
_turns = itertools.count()  # of threads that compute for the first time
_seat = threading.local()  # of each thread: its turn
_seconds = 0.0  # see `seconds_computed`


@contextmanager
def processes(count: int) -> Iterator[None]:
    """Let what is handed to `compute` meanwhile be computed by so many processes, which start as they are needed.

    Each thread has its process, which remembers what it has computed for it. With one, it is computed where it is
    called. Results are the same to the last bit.
    """
    if count == 1 or _pools:
        yield
        return
    context = multiprocessing.get_context("spawn")
    _pools.extend(ProcessPoolExecutor(1, context, initializer=_begin) for _ in range(count))
    try:
        yield
    finally:
        pools = _pools.copy()
        _pools.clear()
        for pool in pools:
            pool.shutdown(wait=False, cancel_futures=True)
        for pool in pools:
            pool.shutdown()


def worth_starting(count: int, episodes: int) -> int:
    """Return how many of `count` processes are worth starting for runs that have so many episodes left at most."""
    return count if episodes > WORTH else 1


def compute(function: Callable[..., Result], *arguments: Any) -> Result:
    """Return what a function of a module returns, computed by a process if there are any, and here otherwise."""
    global _seconds
    if _pools:
        found = _pool().submit(function, *arguments)
        with aside():
            return found.result()
    began = time.perf_counter()
    result = function(*arguments)
    _seconds += time.perf_counter() - began
    return result


def _pool() -> ProcessPoolExecutor:
    """Return the process of the thread that calls this."""
    if not hasattr(_seat, "turn"):
        _seat.turn = next(_turns)
    return _pools[int(_seat.turn) % len(_pools)]


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
    """Prepare a process: one thread, deaf to an interrupt, which the first process answers, and gone with that one.

    Linear algebra of scipy, not loaded yet, would wait for threads of its own at every step of L-BFGS.
    """
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    import torch

    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_the_first, daemon=True).start()


def _follow_the_first() -> None:
    first = multiprocessing.parent_process()
    if first is not None:
        first.join()
        os._exit(1)
