"""The roofline of a device (Williams et al. 2009): how fast it moves bytes and multiplies numbers at best, as measured.

A kernel that has to move some bytes and to calculate so much cannot take less than the longer of both at these rates.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from ..landscapes.sampling.memory import free_memory
from ..landscapes.threads import one_torch_thread

COPIED = {"cpu": 2**28, "cuda": 2**32}  # bytes of an array that no cache holds
SIDE = {"cpu": 2**11, "cuda": 2**13}  # of a square matrix
REPEATED = 5


@dataclass(frozen=True)
class Roof:
    """How many bytes a device moves in a second, reading and writing, and how many operations it does [flop/s].

    Of a CPU it is what one thread does, since kernels have one.
    """

    bytes_per_second: float
    flops_per_second: float

    def seconds(self, bytes_: int, flops: float) -> float:
        """Return the least time in which so much can be done [s]."""
        return max(bytes_ / self.bytes_per_second, flops / self.flops_per_second)


def measure_roof(device: str, precision: str) -> Roof:
    """Measure a device's roof by copying an array and by multiplying two matrices of a precision, the best of some."""
    with one_torch_thread():
        flops = _multiply(device, getattr(torch, precision))  # first: what cuBLAS keeps would lie in the large arrays
        free_memory()
        roof = Roof(_copy(device), flops)
    free_memory()
    return roof


def _copy(device: str) -> float:
    """Return the bytes that are read and written in a second."""
    source = torch.ones(COPIED[device], dtype=torch.uint8, device=device)
    copy = torch.empty_like(source)
    return 2.0 * COPIED[device] / _least_seconds(lambda: copy.copy_(source), device)


def _multiply(device: str, kind: torch.dtype) -> float:
    """Return the products and sums that are done in a second."""
    matrix = torch.ones(SIDE[device], SIDE[device], dtype=kind, device=device)
    return 2.0 * SIDE[device] ** 3 / _least_seconds(lambda: matrix @ matrix, device)


def _least_seconds(call: Callable[[], object], device: str) -> float:
    def once() -> float:
        began = time.perf_counter()
        call()
        if device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter() - began

    once()
    return min(once() for _ in range(REPEATED))
