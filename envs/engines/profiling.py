"""Time Warp's kernels by their names."""

from __future__ import annotations

import re
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import warp as wp

from .launches import one_by_one


@dataclass
class KernelTime:
    """How often a kernel was launched, and the seconds it took altogether."""

    calls: int = 0
    seconds: float = 0.0

    def add(self, seconds: float) -> None:
        """Count one launch."""
        self.calls += 1
        self.seconds += seconds


def count_compiled_modules() -> int:
    """Count the modules of kernels in Warp's cache, so that two counts tell what was compiled in between."""
    return sum(file.suffix in (".o", ".cubin", ".ptx") for file in Path(str(wp.config.kernel_cache_dir)).rglob("*"))


@contextmanager
def time_kernels(device: str) -> Iterator[dict[str, KernelTime]]:
    """Time every Warp kernel launched within a with block, by name; complete where the block ends.

    On a CPU, where launches return when their kernel has run, the time includes that of launching. On CUDA kernels are
    launched one by one, not as graphs.
    """
    times: dict[str, KernelTime] = defaultdict(KernelTime)
    with _time_on_cuda(times) if device == "cuda" else _time_on_cpu(times):
        yield times


@contextmanager
def _time_on_cpu(times: dict[str, KernelTime]) -> Iterator[None]:
    """Time launches, both new ones and those that were stored."""
    launch, relaunch = wp.launch, wp.Launch.launch

    @contextmanager
    def clock(kernel: Any, *, backward: bool) -> Iterator[None]:
        start = time.perf_counter()
        yield
        times[kernel_name(kernel.key, backward=backward)].add(time.perf_counter() - start)

    def time_launch(kernel: Any, *arguments: Any, **named: Any) -> Any:
        if named.get("record_cmd"):
            return launch(kernel, *arguments, **named)
        with clock(kernel, backward=named.get("adjoint", False)):
            return launch(kernel, *arguments, **named)

    def time_relaunch(command: Any, *arguments: Any) -> None:
        with clock(command.kernel, backward=command.adjoint):
            relaunch(command, *arguments)

    wp.launch, wp.Launch.launch = time_launch, time_relaunch  # type: ignore[assignment, method-assign]
    try:
        yield
    finally:
        wp.launch, wp.Launch.launch = launch, relaunch  # type: ignore[method-assign]


@contextmanager
def _time_on_cuda(times: dict[str, KernelTime]) -> Iterator[None]:
    wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
    try:
        with one_by_one():  # a graph hides its kernels, and those beside each other take longer
            yield
    finally:
        for run in wp.timing_end():
            way, _, name = run.name.partition(" kernel ")
            times[kernel_name(name, backward=way == "backward")].add(run.elapsed / 1e3)


def kernel_name(key: str, *, backward: bool) -> str:
    """Return a kernel's name after that of the function that makes it, without the hash of its code."""
    plain = re.sub(r"_[0-9a-f]{8}$", "", key)
    return plain.replace("__locals__", ".") + (" backward" if backward else "")
