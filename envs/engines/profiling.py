"""Time Warp's kernels, and count what they have to do, each by its name."""

from __future__ import annotations

import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import warp as wp

from .demand import Demand, demand
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
def count_demands() -> Iterator[dict[str, Demand]]:
    """Add up what every Warp kernel launched within a with block has to move and to calculate, by name."""
    found: dict[str, Demand] = defaultdict(lambda: Demand(0, 0.0))

    def count(launch: _Launch) -> AbstractContextManager[None]:
        name, one = launch.name, launch.demand()
        found[name] = Demand(found[name].bytes + one.bytes, found[name].flops + one.flops)
        return nullcontext()

    with one_by_one(), _around_launches(count):
        yield found


@dataclass(frozen=True)
class _Launch:
    """A launch under way: of a kernel or of its adjoint, with the arguments that `wp.Launch` keeps."""

    kernel: Any
    backward: bool
    command: Callable[[], Any]

    @property
    def name(self) -> str:
        return kernel_name(self.kernel.key, backward=self.backward)

    def demand(self) -> Demand:
        kept = self.command()
        return demand(kept.kernel, kept.bounds.shape, kept.fwd_args, kept.adj_args or (), backward=self.backward)


@contextmanager
def _around_launches(around: Callable[[_Launch], AbstractContextManager[None]]) -> Iterator[None]:
    """Enter a context around every launch within a with block, be it made anew or stored."""
    launch, relaunch = wp.launch, wp.Launch.launch

    def watch_launch(kernel: Any, *arguments: Any, **named: Any) -> Any:
        if named.get("record_cmd"):
            return launch(kernel, *arguments, **named)

        def record() -> Any:
            return launch(kernel, *arguments, **{**named, "record_cmd": True, "record_tape": False})

        with around(_Launch(kernel, named.get("adjoint", False), record)):
            return launch(kernel, *arguments, **named)

    def watch_relaunch(command: Any, *arguments: Any) -> None:
        with around(_Launch(command.kernel, command.adjoint, lambda: command)):
            relaunch(command, *arguments)

    wp.launch, wp.Launch.launch = watch_launch, watch_relaunch  # type: ignore[assignment, method-assign]
    try:
        yield
    finally:
        wp.launch, wp.Launch.launch = launch, relaunch  # type: ignore[method-assign]


@contextmanager
def _time_on_cpu(times: dict[str, KernelTime]) -> Iterator[None]:
    @contextmanager
    def clock(launch: _Launch) -> Iterator[None]:
        start = time.perf_counter()
        yield
        times[launch.name].add(time.perf_counter() - start)

    with _around_launches(clock):
        yield


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
