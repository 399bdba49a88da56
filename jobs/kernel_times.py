"""Where the time of an environment goes: by kernel, and against the roofline of the device."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from ..envs.base import Environment
from ..envs.engines.profiling import count_demands, time_kernels
from .roofline import Roof

WAYS = {"forward": False, "with_gradient": True}


@dataclass(frozen=True)
class KernelSeconds:
    """Say how often a kernel was launched, the seconds it took altogether, and their share of the time that passed.

    With a roofline, also the `bytes` it had to move and its operations [flop] at least, and what share of its time
    these take at the roof; None without.
    """

    name: str
    calls: int
    seconds: float
    share: float
    bytes: int | None = None
    flops: float | None = None
    of_roof: float | None = None


@dataclass(frozen=True)
class KernelTable:
    """Hold the kernels of one batch, slowest first, which took so many `seconds` altogether."""

    batch: int
    seconds: float
    kernels: tuple[KernelSeconds, ...]


def tabulate_kernels(env: Environment, points: Float[Tensor, "count dim"], roof: Roof | None) -> dict[str, KernelTable]:
    """Return the time by kernel, forward and with gradient, of points that one solver takes at once.

    They run on one thread: what several launch at a time adds up to more than the time that passes. With a roof, they
    are simulated once more, and kernels held against it.
    """
    env._simulate(points, grad=True)
    found = {}
    for way, grad in WAYS.items():
        with time_kernels(env.device) as times:
            began = time.perf_counter()
            env._simulate(points, grad=grad)
            wall = time.perf_counter() - began
        slowest = sorted(times.items(), key=lambda item: -item[1].seconds)
        rows = [KernelSeconds(name, one.calls, one.seconds, one.seconds / wall) for name, one in slowest]
        if roof is not None:
            rows = _hold_against(roof, rows, env, points, grad=grad)
        found[way] = KernelTable(len(points), wall, tuple(rows))
    return found


def _hold_against(
    roof: Roof, rows: Sequence[KernelSeconds], env: Environment, points: Float[Tensor, "count dim"], *, grad: bool
) -> list[KernelSeconds]:
    """Simulate once more, and say what the kernels had to do."""
    with count_demands() as demands:
        env._simulate(points, grad=grad)
    found = []
    for row in rows:
        moved, flops = demands[row.name]
        of_roof = roof.seconds(moved, flops) / row.seconds
        found.append(replace(row, bytes=moved, flops=flops, of_roof=of_roof))
    return found
