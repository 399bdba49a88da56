"""Kernel launches that come again as they were: on a GPU they are recorded once and replayed as one CUDA graph."""

from collections.abc import Callable, Hashable
from typing import Any

import warp as wp

KEPT = 512  # graphs; more are not worth their memory


class Replay:
    """Run launches eagerly the first time they come, record them the second time, and replay them from then on.

    What is launched under one `key` must be the same every time: kernels, sizes, arrays and numbers. Where an array is
    replaced by another, `forget` must be called. On a CPU every launch is eager.
    """

    def __init__(self, device: str) -> None:
        self.device = device
        self.seen: set[Hashable] = set()
        self.graphs: dict[Hashable, Any] = {}

    def __call__(self, key: Hashable, launches: Callable[[], None]) -> None:
        """Run what `launches` launches."""
        if self.device == "cpu" or key not in self.seen:
            self.seen.add(key)
            launches()
            return
        if key not in self.graphs:
            if len(self.graphs) == KEPT:
                self.forget()
            with wp.ScopedCapture(device=self.device) as capture:
                launches()
            self.graphs[key] = capture.graph
        wp.capture_launch(self.graphs[key])

    def forget(self) -> None:
        """Drop every graph."""
        self.seen.clear()
        self.graphs.clear()
