"""Worker processes for the computations of methods: Python runs one thread at a time, whatever the cores."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

MIN_EPISODES = 100  # left of a run; processes are not started for fewer


class WorkerProcesses:
    """Single-threaded processes, started as needed; none if `count` is one.

    A search always has the same process, which remembers earlier computations for it.
    """

    def __init__(self, count: int) -> None:
        context = multiprocessing.get_context("spawn")
        many = range(count if count > 1 else 0)
        self._pools = [ProcessPoolExecutor(1, context, initializer=prepare_process) for _ in many]
        self._turns: dict[int, int] = {}  # by search, in the order in which they computed first

    def __enter__(self) -> WorkerProcesses:
        return self

    def __exit__(self, *_: object) -> None:
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=True)
        for pool in self._pools:
            pool.shutdown()

    def submit(self, search: int, function: Callable[[], Result]) -> Callable[[], Result]:
        """Compute a function for a search; return a handle to wait for, or compute it here."""
        if not self._pools:
            return function
        turn = self._turns.setdefault(search, len(self._turns))
        return self._pools[turn % len(self._pools)].submit(function).result


def workers_worth(workers: int, episodes: int) -> int:
    """Return how many of the workers are worth starting for runs with this many episodes left."""
    return workers if episodes > MIN_EPISODES else 1


def prepare_process() -> None:
    """Prepare a process: one thread, no reaction to interrupts (its parent handles them), and an end with its parent.

    Linear algebra of scipy, not loaded yet, would wait for its own threads at every step of L-BFGS.
    """
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    import torch

    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
