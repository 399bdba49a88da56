"""Measure an environment: rates by batch size, engine against engine, time by kernel, memory, a sampler's own cost."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from ..landscapes.capacity import Need, require
from ..landscapes.objective import Evaluation, Status
from ..landscapes.plane import Plane
from ..landscapes.sampling import sample
from ..landscapes.store import SliceStore
from .base import Environment
from .engines import find_engine
from .engines.profiling import count_compiled_modules, time_kernels
from .engines.runtime import cores, device_names, free_memory

K = TypeVar("K")
WAYS = {"forward": False, "with_gradient": True}
LEAST = 2  # repetitions of everything, whatever they take
SMALL = 64  # points along each axis of the sampler's slice, at most


@dataclass(frozen=True)
class Start:
    """How an engine began: `seconds` until its first gradient was there, Warp modules `compiled` on the way.

    What was not compiled came from the cache; Taichi does not say. `bytes_per_episode` is what its CUDA device says was
    taken, by rows that a full batch has.
    """

    seconds: float
    compiled: int | None
    bytes_per_episode: int | None


@dataclass(frozen=True)
class Rate:
    """The best of some repetitions: `seconds` for a whole batch, and what that is per second."""

    seconds: float
    episodes_per_second: float
    work_per_second: float

    @classmethod
    def of(cls, env: Environment, batch: int, seconds: float) -> Rate:
        """Return the rate of a batch that took so many seconds."""
        return cls(seconds, batch / seconds, batch * env.work().count / seconds)


def bench(
    make: Callable[[str], Environment],
    engine: str,
    *,
    against: str | None = None,
    batches: Sequence[int] = (),
    seconds: float = 10.0,
    follow: Callable[[str], None] = lambda stage: None,
) -> dict[str, Any]:
    """Measure the environment that `make` returns for an engine, in turn with another engine if `against` names one.

    Each of `batches` (default: 1 and the preferred one) is timed for about so many `seconds`; `follow` hears what is
    done. `ratio_forward` and `ratio_with_gradient` say how many times as fast as the other the engine is in this run:
    in each row of `rates` that batch's, on top the largest batch's (None without another engine).
    """
    envs, starts = _started(make, engine, against, follow)
    env = envs[engine]
    rates = []
    for batch in batches:
        require("batch", batch, partial(_need, env))
    for batch in batches or sorted({1, env.preferred_batch}):
        follow(f"timing batches of {batch}")
        rates += _rates(envs, _points(env, batch), seconds)
    follow("timing kernels")
    kernels = _kernels(env) if find_engine(engine).profiled else None
    follow("timing the sampler")
    quickest = max(row["with_gradient"]["episodes_per_second"] for row in rates if row["engine"] == engine)
    return {
        **_subject(env),
        "against": against,
        "start": {name: asdict(start) for name, start in starts.items()},
        "memory": {"estimated": env.memory(), "measured": starts[engine].bytes_per_episode},
        **{f"ratio_{way}": _ratio(rates, way) for way in WAYS},
        "rates": rates,
        "kernels": kernels,
        "sampler": _sampler(env, quickest * seconds / 2),
    }


def _need(env: Environment, batch: int) -> Need:
    """Return what a batch takes: its points and gradients, some copies of them, and the episodes that run at once."""
    return Need(8.0 * 8 * batch * env.space.dim + env.memory() * min(batch, env._rows_per_part(batch) * env.threads))


def _ratio(rates: Sequence[Mapping[str, Any]], way: str) -> float | None:
    """Return the ratio of the largest batch."""
    compared = [row for row in rates if f"ratio_{way}" in row]
    return max(compared, key=lambda row: row["batch"])[f"ratio_{way}"] if compared else None


def _started(
    make: Callable[[str], Environment], engine: str, against: str | None, follow: Callable[[str], None]
) -> tuple[dict[str, Environment], dict[str, Start]]:
    """Return environments by engine, each made when the one before has taken what it takes of a GPU."""
    if engine == against:
        raise ValueError(f"two engines are compared; got {engine} against {against}")
    envs, starts = {engine: make(engine)}, {}
    if against is not None:
        envs[engine].check_engine(against)
    for name in (engine,) if against is None else (engine, against):
        follow(f"starting {name}")
        if name not in envs:
            envs[name] = make(name)
        starts[name] = _start(envs[name])
    return envs, starts


def _subject(env: Environment) -> dict[str, Any]:
    return {
        "env": env.name,
        "fidelity": env.fidelity.name,
        "options": asdict(env.options),
        "device": env.device,
        "hardware": device_names()[0] if env.device == "cuda" else f"{cores()} cores",
        "engine": env.engine,
        "deterministic": env.deterministic,
        "work": asdict(env.work()),
    }


def _start(env: Environment) -> Start:
    """Make an environment's first gradient, then on CUDA a full batch of them, and say what that took."""
    cached, began = count_compiled_modules(), time.perf_counter()
    free = _free(env)
    env.prepare()
    env.evaluate(_points(env, 1))
    seconds = time.perf_counter() - began
    compiled = count_compiled_modules() - cached if env.capabilities.profiled else None
    if env.device != "cuda":
        return Start(seconds, compiled, None)
    env.evaluate(_points(env, env.preferred_batch))
    return Start(seconds, compiled, (free - _free(env)) // env.preferred_batch)


def _free(env: Environment) -> int:
    if env.device != "cuda":
        return 0
    torch.ones(1, device=env.device).sum()  # what a process takes once is no episode's
    return free_memory()


def _points(env: Environment, count: int) -> Float[Tensor, "count dim"]:
    """Return well-spread points of the box, the same for every engine."""
    sobol = torch.quasirandom.SobolEngine(env.space.dim, scramble=True, seed=0)  # type: ignore[no-untyped-call]
    return env.space.from_unit(sobol.draw(count, dtype=torch.float64))


def _rates(envs: Mapping[str, Environment], points: Tensor, seconds: float) -> list[dict[str, Any]]:
    """Time one batch on every engine in turn, forward and with gradient; the first engine's row holds the ratios."""
    failed = {name: int((env.evaluate(points).status != Status.OK).sum()) for name, env in envs.items()}  # warms up too
    calls = {
        (name, grad): partial(env.evaluate, points, grad=grad) for grad in WAYS.values() for name, env in envs.items()
    }
    times = alternated(calls, seconds)
    rows: list[dict[str, Any]] = []
    for name, env in envs.items():
        rates = {way: Rate.of(env, len(points), min(times[name, grad])) for way, grad in WAYS.items()}
        row = {"engine": name, "batch": len(points), "failed": failed[name], "repetitions": len(times[name, True])}
        row |= {way: asdict(rate) for way, rate in rates.items()}
        rows.append({**row, "gradient_costs": rates["with_gradient"].seconds / rates["forward"].seconds})
    for other in rows[1:]:
        rows[0] |= {f"ratio_{way}": other[way]["seconds"] / rows[0][way]["seconds"] for way in WAYS}
    return rows


def alternated(calls: Mapping[K, Callable[[], object]], seconds: float) -> dict[K, list[float]]:
    """Return the seconds that calls took, made in turn (a, b, a, b, ...) until the next round would end too late."""
    times: dict[K, list[float]] = {key: [] for key in calls}
    start, rounds = time.perf_counter(), 0
    while rounds < LEAST or (time.perf_counter() - start) * (rounds + 1) / rounds < seconds:
        for key, call in calls.items():
            began = time.perf_counter()
            call()
            times[key].append(time.perf_counter() - began)
        rounds += 1
    return times


def _kernels(env: Environment) -> dict[str, Any]:
    """Return the time by kernel, forward and with gradient, of the rows that one solver takes at once.

    They run on one thread: what several launch at a time adds up to more than the time that passes.
    """
    points = _points(env, env._rows_per_part(env.preferred_batch))
    env._simulate(points, grad=True)
    found = {}
    for way, grad in WAYS.items():
        with time_kernels(env.device) as times:
            began = time.perf_counter()
            env._simulate(points, grad=grad)
            wall = time.perf_counter() - began
        slowest = sorted(times.items(), key=lambda item: -item[1].seconds)
        rows = [{"name": name, **asdict(spent), "share": spent.seconds / wall} for name, spent in slowest]
        found[way] = {"batch": len(points), "seconds": wall, "kernels": rows}
    return found


class _Clocked:
    """An environment that adds up the seconds spent in `evaluate`."""

    def __init__(self, env: Environment) -> None:
        self.name, self.space, self.preferred_batch = env.name, env.space, env.preferred_batch
        self._env, self.seconds = env, 0.0

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Evaluate, and note how long it took."""
        began = time.perf_counter()
        result = self._env.evaluate(x, grad=grad)
        self.seconds += time.perf_counter() - began
        return result


def _sampler(env: Environment, points: float) -> dict[str, Any]:
    """Return what share of the time of sampling a slice to disk, of about so many points, is not simulation."""
    dims = env.space.names[:2]
    resolution = max(2, min(SMALL, int(points ** (1 / len(dims)))))
    plane = Plane.through(env.space, env.space.center, dims, resolution=resolution)
    clocked = _Clocked(env)
    with tempfile.TemporaryDirectory() as folder:
        store = SliceStore.create(Path(folder) / "slice.zarr", plane, env.space, identity={"objective": env.name})
        began = time.perf_counter()
        sample(clocked, plane, store)
        wall = time.perf_counter() - began
    return {"points": math.prod(plane.resolution), "seconds": wall, "share": 1.0 - clocked.seconds / wall}
