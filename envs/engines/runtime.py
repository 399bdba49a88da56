"""Start Warp: device, precision, threads, kernel cache."""

from __future__ import annotations

import os
import queue
import re
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
import warp as wp

wp.config.log_level = wp.LOG_ERROR  # no banner

T = TypeVar("T")


def _start() -> None:
    """Start Warp without its native complaint, on standard error, where there is no GPU."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


_start()


@dataclass(frozen=True)
class Precision:
    """Tie one floating-point precision to its Warp and torch types."""

    name: str
    real: Any
    vec3: Any
    vec4: Any
    mat33: Any
    torch: torch.dtype


@cache
def precision(name: str) -> Precision:
    """Return the types of `float32` or `float64`."""
    reals = {"float32": (wp.float32, torch.float32), "float64": (wp.float64, torch.float64)}
    if name not in reals:
        raise ValueError(f"precision must be float32 or float64; got {name!r}")
    real, dtype = reals[name]
    vector, matrix = wp.types.vector, wp.types.matrix
    return Precision(name, real, vector(3, real), vector(4, real), matrix((3, 3), real), dtype)


def promise(deterministic: bool) -> wp.DeterministicMode:
    """Return what a module of kernels is told: whether its atomic adds must come in the same order every time."""
    return wp.DeterministicMode.RUN_TO_RUN if deterministic else wp.DeterministicMode.NOT_GUARANTEED


def cuda_available() -> bool:
    """Say whether Warp can drive a CUDA device here."""
    return bool(wp.is_cuda_available())


def device_names() -> list[str]:
    """Return the names of the CUDA devices."""
    return [f"{device.alias}: {device.name}" for device in wp.get_cuda_devices()]


def free_memory() -> int:
    """Return the free bytes of the CUDA device, what was given up until now included."""
    wp.synchronize_device("cuda")
    return int(wp.get_device("cuda").free_memory)


def cores() -> int:
    """Count the cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def to_torch(array: wp.array) -> torch.Tensor:
    """View a Warp array as a tensor of the same memory."""
    tensor: torch.Tensor = wp.to_torch(array, requires_grad=False)
    return tensor


def load(kernels: Iterable[Any], device: str) -> None:
    """Compile kernels, or fetch them from the cache, before threads launch them."""
    modules = list({kernel.module: None for kernel in kernels})
    wp.force_load(device, modules, max_workers=cores())


def filled(data: Any, record: Any) -> Any:
    """Return a Warp struct with the fields of a dataclass in it."""
    for field in fields(record):
        setattr(data, field.name, getattr(record, field.name))
    return data


def compiled_modules() -> int:
    """Count the modules of kernels in Warp's cache, so that two counts tell what was compiled in between."""
    return sum(file.suffix in (".o", ".cubin", ".ptx") for file in Path(str(wp.config.kernel_cache_dir)).rglob("*"))


@dataclass
class KernelTime:
    """How often a kernel was launched, and the seconds it took altogether."""

    calls: int = 0
    seconds: float = 0.0

    def add(self, seconds: float) -> None:
        """Count one launch."""
        self.calls += 1
        self.seconds += seconds


@contextmanager
def kernel_times(device: str) -> Iterator[dict[str, KernelTime]]:
    """Time every Warp kernel launched within a with block, by name; complete where the block ends.

    On a CPU, where launches return when their kernel has run, the time includes that of launching. On CUDA kernels are
    launched one by one, not as graphs.
    """
    times: dict[str, KernelTime] = defaultdict(KernelTime)
    with _cuda_kernels(times) if device == "cuda" else _cpu_launches(times):
        yield times


@contextmanager
def _cpu_launches(times: dict[str, KernelTime]) -> Iterator[None]:
    launch, again = wp.launch, wp.Launch.launch

    def timed(kernel: Any, *arguments: Any, **named: Any) -> Any:
        if named.get("record_cmd"):
            return launch(kernel, *arguments, **named)
        with clock(kernel, backward=named.get("adjoint", False)):
            return launch(kernel, *arguments, **named)

    def timed_again(command: Any, *arguments: Any) -> None:
        with clock(command.kernel, backward=command.adjoint):
            again(command, *arguments)

    @contextmanager
    def clock(kernel: Any, *, backward: bool) -> Iterator[None]:
        start = time.perf_counter()
        yield
        times[_kernel_name(kernel.key, backward=backward)].add(time.perf_counter() - start)

    wp.launch, wp.Launch.launch = timed, timed_again  # type: ignore[assignment, method-assign]
    try:
        yield
    finally:
        wp.launch, wp.Launch.launch = launch, again  # type: ignore[method-assign]


@contextmanager
def _cuda_kernels(times: dict[str, KernelTime]) -> Iterator[None]:
    from .launches import Replay

    graph = Replay._graph
    Replay._graph = lambda self, key, known: known.run()  # type: ignore[method-assign]  # a graph hides its kernels
    wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
    try:
        yield
    finally:
        Replay._graph = graph  # type: ignore[method-assign]
        for run in wp.timing_end():
            way, _, name = run.name.partition(" kernel ")
            key = re.sub(r"_[0-9a-f]{8}$", "", name)  # without the hash of its code
            times[_kernel_name(key, backward=way == "backward")].add(run.elapsed / 1e3)


def _kernel_name(key: str, *, backward: bool) -> str:
    """Return a kernel's name after that of the function that makes it."""
    return key.replace("__locals__", ".") + (" backward" if backward else "")


class Pool(Generic[T]):
    """Lend objects that serve one thread at a time, making a new one where none is idle; with `most` of them, wait."""

    def __init__(self, make: Callable[[], T], *, most: int | None = None) -> None:
        self._make = make
        self._idle: queue.LifoQueue[T] = queue.LifoQueue()
        self._making = threading.Lock()
        self._room = threading.Semaphore(most) if most else nullcontext()

    @contextmanager
    def lend(self) -> Iterator[T]:
        """Give an idle object, or a new one, for the length of a with block."""
        with self._room:
            try:
                item = self._idle.get_nowait()
            except queue.Empty:
                with self._making:
                    item = self._make()
            try:
                yield item
            finally:
                self._idle.put(item)
