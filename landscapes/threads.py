"""How many threads torch computes with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Keep torch to one thread meanwhile.

    How sums round depends on how many threads share them, so that a search's numbers would not depend on its seed
    alone. And its other threads busily wait for work on cores that others need: triple times, in Taichi's case.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
