"""Kernel launches that come again: what Warp makes of their arguments is stored, and whole programs or graphs of them.

A new launch costs Python more than most kernels take; one that is stored costs a tenth of that, and one in a program of
a CPU or a graph of a GPU next to nothing.
"""

from __future__ import annotations

import ctypes
import re
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import warp as wp

from . import cpp
from .runtime import load

MAX_GRAPHS, MAX_SEQUENCES = 512, 1024  # that are stored; more are not worth their memory

BLOCK = 128  # threads of a GPU that share registers; scatters and gathers like few


def blocks(precision: str, count: int = 6) -> tuple[int, int] | None:
    """Return the bounds of a kernel that is slow for want of warps: so many blocks are to find registers at once.

    In float64 they cannot, and a kernel that has to would keep numbers in memory.
    """
    return (BLOCK, count) if precision == "float32" else None


@dataclass(frozen=True)
class _Call:
    work: Callable[[], None]

    def launch(self, stream: Any = None) -> None:
        self.work()


@dataclass(frozen=True)
class _Mark:
    """Where launches continue, on a stream of a GPU by its number, 0 being the first; or the first waits, if None."""

    stream: int | None

    def launch(self) -> None:
        """Do nothing where all launches are on one stream."""


class _Streams(dict[int, wp.Stream]):
    """Streams of a GPU by their number, made on demand; the present one is the first."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self.device = device

    def __missing__(self, number: int) -> wp.Stream:
        self[number] = wp.Stream(self.device)
        return self[number]

    def first(self) -> wp.Stream:
        return wp.get_stream(self.device)


@cache
def _packet(kinds: tuple[type, ...]) -> type[ctypes.Structure]:
    """Return the struct in which a kernel of a CPU is given arguments of these kinds."""
    fields = [(f"argument_{number}", kind) for number, kind in enumerate(kinds)]
    return type("Packet", (ctypes.Structure,), {"_fields_": fields})


@cache
def _runner() -> Any:
    """Return the kernel that runs calls of kernels (`native/calls.h`)."""
    kernel = cpp.kernel_in_rows("gradscape.launches", "run_calls", calls=wp.array[wp.uint64])
    load([kernel], "cpu")
    return kernel


class _Program:
    """Launches of a CPU that run one after another without Python, for which threads would wait.

    Their arguments stay as they are; their dimensions may be others when `move` has been called.
    """

    def __init__(self, launches: list[wp.Launch]) -> None:
        self.launches = launches  # which hold their arrays
        self.packets = [self._pack(launch) for launch in launches]
        self.calls = np.zeros((len(launches), 4), dtype=np.uint64)
        for call, launch, packets in zip(self.calls, launches, self.packets, strict=True):
            function = launch.hooks.backward if launch.adjoint else launch.hooks.forward
            call[0] = ctypes.cast(function, ctypes.c_void_p).value or 0
            call[2 : 2 + len(packets)] = [ctypes.addressof(packet) for packet in packets]
        self.move()
        calls: Any = wp.array(self.calls.ravel(), dtype=wp.uint64, device="cpu", copy=False)
        self.runner = wp.launch(_runner(), (1, 1), [calls], device="cpu", record_cmd=True, record_tape=False)

    def move(self) -> None:
        self.calls[:, 1] = [ctypes.addressof(launch.bounds) for launch in self.launches]

    def launch(self) -> None:
        self.runner.launch()

    @staticmethod
    def _pack(launch: wp.Launch) -> list[ctypes.Structure]:
        """Return the arguments of a launch, and their adjoints if it is of an adjoint kernel."""
        _, *given = launch.params
        count = len(launch.kernel.adj.args)
        return [_packet(tuple(map(type, part)))(*part) for part in (given[:count], given[count:]) if part]


@dataclass
class _Sequence:
    """Launches in their order, as they were made for one `extent`.

    `located` are those of which an argument says where that lies, with its number, `sized` those whose dimensions a
    function of it says.
    """

    extent: Any
    launches: list[Any] = field(default_factory=list)
    located: list[tuple[Any, int]] = field(default_factory=list)
    sized: list[tuple[Any, Callable[[Any], tuple[int, int]]]] = field(default_factory=list)
    programs: list[Any] = field(default_factory=list)

    def run_programs(self) -> None:
        """Launch on a CPU, as few programs as can be, or one by one where arguments change."""
        if not self.programs and not self.located:
            for launches, group in groupby(self.launches, lambda command: isinstance(command, wp.Launch)):
                commands = list(group)
                self.programs += [_Program(commands)] if launches else commands
        for command in self.programs or self.launches:
            command.launch()

    def run(self) -> None:
        for command in self.launches:
            command.launch()

    def run_on(self, streams: _Streams) -> None:
        """Launch on several streams of a GPU, so that what is independent runs in parallel."""
        stream = first = streams.first()
        busy: set[int] = set()

        def join() -> None:
            while busy:
                first.wait_stream(streams[min(busy)])
                busy.remove(min(busy))

        try:
            for command in self.launches:
                if not isinstance(command, _Mark):
                    command.launch(stream)
                elif command.stream is None:
                    join()
                elif command.stream == 0:
                    stream = first
                else:
                    busy.add(command.stream)
                    stream = streams[command.stream]
                    stream.wait_stream(first)
        finally:
            join()  # so that what comes next waits, even if this was interrupted

    def capture(self, streams: _Streams) -> Any:
        """Return a graph of the launches."""
        with wp.ScopedCapture(device=streams.device) as captured:
            self.run_on(streams)
        return captured.graph

    def move(self, extent: Any, place: Any) -> None:
        """Make the launches run over another extent."""
        if extent != self.extent:
            self.extent = None  # of launches of which only some were moved, should this be interrupted
            for command, argument in self.located:
                command.set_param_at_index(argument, place)
            for command, dim in self.sized:
                command.set_dim(dim(extent))
            for program in self.programs:
                if isinstance(program, _Program):
                    program.move()
            self.extent = extent


class Launches:
    """Run the launches of a piece of work: made when it first comes, stored from then on.

    What is launched under one key must be the same every time, arrays and numbers: only the extent may be another, a
    box of nodes or a number of rows. Where an array is replaced by another, `clear` must be called. A CPU runs stored
    work as `programs` if it is to, which pays where it comes more than twice.
    """

    one_by_one: ClassVar[bool] = False  # even on a GPU

    def __init__(self, device: str, *, programs: bool = False) -> None:
        self.device, self.programs = device, programs and device == "cpu"
        if self.programs:
            _runner()
        self.sequences: dict[Hashable, _Sequence] = {}
        self.seen: set[tuple[Hashable, Hashable]] = set()
        self.graphs: dict[tuple[Hashable, Hashable], Any] = {}
        self.streams = _Streams(device)

    def run(self, key: Hashable, extent: Hashable, work: Callable[[], None], *, place: Any = None, small: bool) -> None:
        """Do `work` over an extent, and say to launches that take it as an argument which `place` that is.

        Where work is `small`, a GPU records it when it comes again over the same extent.
        """
        known = self.sequences.get(key)
        if known is None:
            if len(self.sequences) == MAX_SEQUENCES:
                self.clear()
            self._recording, self._place = _Sequence(extent), place
            work()
            # Only now: of work that was interrupted a part would be stored; and what is cleared must not be held here.
            self.sequences[key], self._recording = self._recording, _Sequence(None)
            self.seen.add((key, extent))
        elif self.one_by_one or self.device == "cpu":
            known.move(extent, place)
            if self.programs and not self.one_by_one:
                known.run_programs()
            else:
                known.run()
        elif small:
            self._run_graph((key, extent), known, place)
        else:
            known.move(extent, place)
            known.run_on(self.streams)

    def launch(
        self, kernel: Any, dim: tuple[int, int] | Callable[[Any], tuple[int, int]], inputs: list[Any], **how: Any
    ) -> None:
        """Launch a kernel as part of the work under way, with dimensions that may be a function of its extent."""
        size = dim(self._recording.extent) if callable(dim) else dim
        how |= {"record_tape": False, "record_cmd": True, "block_dim": BLOCK}
        command = wp.launch(kernel, size, inputs, device=self.device, **how)
        if self._place is not None:
            places = (number for number, argument in enumerate(inputs) if argument is self._place)
            self._recording.located += [(command, number) for number in places]
        if callable(dim):
            self._recording.sized.append((command, dim))
        self._recording.launches.append(command)
        command.launch()

    def call(self, work: Callable[[], None]) -> None:
        """Do anything else as part of the work under way."""
        self._recording.launches.append(_Call(work))
        work()

    @contextmanager
    def on_stream(self, stream: int) -> Iterator[None]:
        """Let a GPU run what is launched within a with block on a stream, parallel to what follows, up to `join`."""
        self._recording.launches.append(_Mark(stream))
        yield
        self._recording.launches.append(_Mark(0))

    def join(self) -> None:
        """Let what follows wait for what was launched `on_stream`."""
        self._recording.launches.append(_Mark(None))

    def clear(self, concerned: Callable[[Any], bool] = lambda key: True) -> None:
        """Drop what is stored under keys that are `concerned`, by default all."""
        self.sequences = {key: stored for key, stored in self.sequences.items() if not concerned(key)}
        self.seen = {(key, extent) for key, extent in self.seen if not concerned(key)}
        self.graphs = {(key, extent): graph for (key, extent), graph in self.graphs.items() if not concerned(key)}

    def _run_graph(self, key: tuple[Hashable, Hashable], known: _Sequence, place: Any) -> None:
        if key not in self.graphs:
            known.move(key[1], place)
            if key not in self.seen:
                self.seen.add(key)
                known.run_on(self.streams)
                return
            if len(self.graphs) == MAX_GRAPHS:
                self.seen.clear()
                self.graphs.clear()
            self.graphs[key] = known.capture(self.streams)
        wp.capture_launch(self.graphs[key])


@contextmanager
def one_by_one() -> Iterator[None]:
    """Launch kernels one after the other within a with block, neither as graphs nor in parallel."""
    Launches.one_by_one = True
    try:
        yield
    finally:
        Launches.one_by_one = False


# ---- Time Warp's kernels by their names.


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

    Kernels are launched one by one, neither as graphs nor as programs. On a CPU, where launches return when their
    kernel has run, the time includes that of launching.
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
        with one_by_one():  # a program hides its kernels
            yield
    finally:
        wp.launch, wp.Launch.launch = launch, relaunch  # type: ignore[method-assign]


@contextmanager
def _time_on_cuda(times: dict[str, KernelTime]) -> Iterator[None]:
    wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
    try:
        with one_by_one():  # a graph hides its kernels, and parallel ones take longer
            yield
    finally:
        for run in wp.timing_end():
            way, _, name = run.name.partition(" kernel ")
            times[kernel_name(name, backward=way == "backward")].add(run.elapsed / 1e3)


def kernel_name(key: str, *, backward: bool) -> str:
    """Return a kernel's name after that of the function that makes it, without the hash of its code."""
    plain = re.sub(r"_[0-9a-f]{8}$", "", key)
    return plain.replace("__locals__", ".") + (" backward" if backward else "")
