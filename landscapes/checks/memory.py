"""Whether memory grows when the same batch is evaluated repeatedly: retained tapes, graphs or results."""

from __future__ import annotations

import ctypes
import gc
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import combinations, pairwise
from statistics import median
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ..capacity import peak_memory
from ..objective import Objective

Where = Literal["process", "GPU"]
BLOCKS, FEWEST_BLOCKS, WARM_UP = 12, 6, 3  # of evaluations between two readings; of them those before the first
SECONDS, MOST = 1.0, 2000  # that all evaluations may take, and their number
FLOOR = 5e5  # bytes: healthy functions stay below 1e5
RESERVE = 16e6  # bytes that allocators keep in reserve, where it cannot be asked what is in use
SMALL = 64  # bytes of one of Python's own small blocks, about
BATCHES = 2  # what a healthy objective may keep of those that it has evaluated
RISING = 0.7  # share of the blocks after which there is more, in what grows


@dataclass(frozen=True)
class MemoryGrowth:
    """The growth of memory over evaluations.

    `per_evaluation` is the median slope [bytes], which ignores a jump, such as a cache. `total` is its growth over all
    `evaluations` after the warm-up [bytes].
    """

    where: Where
    grows: bool
    per_evaluation: float
    total: float
    evaluations: int


def memory_growth(
    objective: Objective, x: Float[Tensor, "batch dim"], *, grad: bool = True, seconds: float = SECONDS
) -> MemoryGrowth:
    """Evaluate a batch repeatedly, and return the growth of the memory of the process, or of a GPU.

    It takes about `seconds`, or `FEWEST_BLOCKS` evaluations. Growth is measured once more with garbage collection:
    collectable memory is not retained. Raises any error of the objective.
    """

    def evaluate() -> None:
        objective.evaluate(x, grad=grad)

    evaluate()  # compiles
    start = time.perf_counter()
    evaluate()
    each = max(time.perf_counter() - start, 1e-6)
    blocks = WARM_UP + max(FEWEST_BLOCKS, min(BLOCKS, int(seconds / each)))
    count = max(1, min(MOST // blocks, int(seconds / each / blocks)))
    batch = max(8.0 * x.numel(), float(objective.memory()) * min(len(x), objective.preferred_batch))
    on_gpu = objective.device == "cuda" and torch.cuda.is_available()
    found = []
    for where, read, floor in [_of_process(), *([_OF_GPU] if on_gpu else [])]:
        least = max(floor, BATCHES * batch)
        ways: tuple[Callable[[], object], ...] = (lambda: None, gc.collect)  # the latter where memory grows without
        for between in ways:
            one = _judge(where, _measure(evaluate, read, blocks, count, between), count, least)
            if not one.grows:
                break
        found.append(one)
    return max(found, key=lambda one: (one.grows, one.where == "GPU"))


def _measure(
    evaluate: Callable[[], None], read: Callable[[], int], blocks: int, count: int, between: Callable[[], object]
) -> list[int]:
    """Return the held memory after each block of evaluations, without the warm-up."""
    held = []
    for _ in range(blocks):
        for _ in range(count):
            evaluate()
        between()
        held.append(read())
    return held[WARM_UP - 1 :]


def _judge(where: Where, held: list[int], count: int, least: float) -> MemoryGrowth:
    slope = median((later - before) / (j - i) for (i, before), (j, later) in combinations(enumerate(held), 2))
    rising = sum(later > before for before, later in pairwise(held)) / (len(held) - 1)
    total = slope * (len(held) - 1)
    return MemoryGrowth(where, total > least and rising >= RISING, slope / count, total, count * (len(held) - 1))


class _Heap(ctypes.Structure):
    """The memory report of the C library: `mallinfo2` of glibc 2.33 and later."""

    _fields_ = [
        *((name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd")),
        *((name, ctypes.c_size_t) for name in ("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")),
    ]


Read = tuple[Where, Callable[[], int], float]  # of what memory, how it is read [bytes], and a growth that means nothing


@cache
def _of_process() -> Read:
    """Return a reader of the process's memory: bytes in use, because a fragmented heap grows late; else its peak."""
    try:
        ask = ctypes.CDLL(None).mallinfo2
    except (AttributeError, OSError, TypeError):
        return "process", peak_memory, RESERVE
    ask.restype = _Heap

    def in_use() -> int:
        heap = ask()
        return int(heap.uordblks + heap.hblkhd + SMALL * sys.getallocatedblocks())

    return "process", in_use, FLOOR


def _taken_on_gpu() -> int:
    """Return the used memory of the GPU [bytes], by all libraries together."""
    torch.cuda.synchronize()
    free, whole = torch.cuda.mem_get_info()
    return whole - free


_OF_GPU: Read = ("GPU", _taken_on_gpu, RESERVE)
