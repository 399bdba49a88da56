"""Memory of the device: when it runs out, idle solvers are dropped and batches are halved."""

from __future__ import annotations

import gc
import queue
import re
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from typing import Any, ClassVar, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Evaluation, Objective, ObjectiveWrapper, evaluate

# What torch, Warp, Taichi and CUDA say; the first of them alone has a type of its own.
SAID = re.compile(
    r"out of memory|out of CUDA|fail\w* to allocate|can't allocate memory|not enough memory|acquire primary context",
    re.IGNORECASE,
)
ADVICE = "end other programs on the device, or use a lower --fidelity or another --device"

T = TypeVar("T")


class Pool(Generic[T]):
    """Lend objects that serve one thread at a time; make a new one where none is idle, up to `most` of them."""

    every: ClassVar[weakref.WeakSet[Pool[Any]]] = weakref.WeakSet()

    def __init__(self, make: Callable[[], T], *, most: int | None = None) -> None:
        self._make = make
        self._idle: queue.LifoQueue[T] = queue.LifoQueue()
        self._making = threading.Lock()
        self._room = threading.Semaphore(most) if most else nullcontext()
        Pool.every.add(self)

    @contextmanager
    def lend(self) -> Iterator[T]:
        """Lend an idle object, or a new one, for the length of a with block."""
        with self._room:
            try:
                item = self._idle.get_nowait()
            except queue.Empty:
                with self._making:
                    item = self._made()
            try:
                yield item
            finally:
                self._idle.put(item)

    def clear(self) -> None:
        """Drop the idle objects, which frees their memory."""
        with suppress(queue.Empty):
            while True:
                self._idle.get_nowait()

    def _made(self) -> T:
        """Return a new object, in the memory of all idle ones where there is too little without."""
        try:
            return self._make()
        except (RuntimeError, MemoryError) as error:
            if not is_out_of_memory(error):
                raise
        release_idle()
        free_memory()  # here, where the error no longer holds what was made of it
        return self._make()


class MemoryBound(ObjectiveWrapper):
    """Evaluate an objective with smaller batches once its device ran out of memory, down to one point.

    That changes no result, if rows of the objective do not depend on their batch. An objective that holds memory for
    all rows of a batch, such as an environment, is told to hold less by its method `shrink(rows)`.
    """

    def __init__(self, objective: Objective) -> None:
        super().__init__(objective)
        self._notes: list[str] = []
        self._most: int | None = None

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if requested, at points `x` in the parameters' own units.

        Raises MemoryError where the device has too little memory for a single point.
        """
        parts: list[Evaluation] = []
        start = 0
        while start < len(x):
            rows = x[start : start + (self._most or len(x))]
            part = self._try(rows, grad=grad)
            if part is None:
                release_idle()
                free_memory()  # the arrays of the attempt that failed
                part = self._try(rows, grad=grad, last=True) if len(rows) == 1 else None
            if part is None:
                self._most = len(rows) // 2
                self.shrink(self._most)
                self._notes.append(f"{self.name} ran out of memory at {len(rows)} points; continuing with {self._most}")
                continue
            parts.append(part)
            start += len(rows)
        return Evaluation.join(parts, dim=x.shape[1], grad=grad)

    def take_notes(self) -> tuple[str, ...]:
        """Return the warnings since the last call."""
        notes, self._notes = tuple(self._notes), []
        return notes

    def _try(self, x: Float[Tensor, "batch dim"], *, grad: bool, last: bool = False) -> Evaluation | None:
        """Return the evaluation, None where the device has too little memory for this many points.

        The `last` try of a single point raises MemoryError there.
        """
        try:
            return evaluate(self.objective, x, grad=grad)
        except (RuntimeError, MemoryError) as error:
            if not is_out_of_memory(error):
                raise
            if last:
                raise MemoryError(f"{self.name} ran out of memory at a single point: {error}; {ADVICE}") from error
            return None


def release_idle() -> None:
    """Drop the idle solvers of all environments in this process, which frees their memory."""
    for pool in list(Pool.every):
        pool.clear()


def free_memory() -> None:
    """Collect garbage and empty the cache of GPU memory."""
    gc.collect()  # an error that has been raised and what it tells of may refer to each other
    torch.cuda.empty_cache()


@contextmanager
def sparing_collections() -> Iterator[None]:
    """Exclude existing objects from garbage collection within this block: scanning them takes longer than a batch."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error means that the host or a GPU has too little memory."""
    return isinstance(error, MemoryError | torch.OutOfMemoryError) or bool(SAID.search(str(error)))
