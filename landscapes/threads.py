"""The number of threads that torch computes with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Limit torch to one thread within this block.

    The rounding of sums depends on the number of threads, so a search's numbers would not depend on its seed alone.
    torch's other threads also wait actively on cores that others need, which tripled times in Taichi's case.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
