"""Whether memory grows while the same batch is evaluated again and again: tapes, graphs or results that are kept."""

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
    """Say how much more memory is held after evaluations than before.

    `per_evaluation` is the median slope [bytes], which a jump, such as a cache, leaves at zero. `total` is its growth
    over all `evaluations` after the warm-up [bytes].
    """

    where: Where
    grows: bool
    per_evaluation: float
    total: float
    evaluations: int


def memory_growth(
    objective: Objective, x: Float[Tensor, "batch dim"], *, grad: bool = True, seconds: float = SECONDS
) -> MemoryGrowth:
    """Evaluate a batch again and again, and return how the memory of the process grows, or that of a GPU.

    All takes about so many seconds, or `FEWEST_BLOCKS` evaluations. What grows is measured once more while garbage is
    collected: what can be collected is not kept. Raises what the objective raises.
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
    """Return how much memory is held after each block of evaluations, the warm-up left out."""
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
    """What the C library says of its memory: `mallinfo2` of glibc 2.33 and later."""

    _fields_ = [
        *((name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd")),
        *((name, ctypes.c_size_t) for name in ("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")),
    ]


Read = tuple[Where, Callable[[], int], float]  # of what memory, how it is read [bytes], and a growth that means nothing


@cache
def _of_process() -> Read:
    """Return how the memory of the process is read: what is in use, as a heap with holes grows late; else its peak."""
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
    """Return how much memory of the GPU is taken [bytes], whichever library holds it."""
    torch.cuda.synchronize()
    free, whole = torch.cuda.mem_get_info()
    return whole - free


_OF_GPU: Read = ("GPU", _taken_on_gpu, RESERVE)
