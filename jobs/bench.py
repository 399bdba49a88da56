"""Measure an environment: rates by batch size, engine against engine, time by kernel, memory, a sampler's own cost."""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from ..envs.base import Environment, Work
from ..envs.engines import find_engine
from ..envs.engines.launches import count_compiled_modules, time_kernels
from ..envs.engines.runtime import cores, device_names, free_memory
from ..landscapes.capacity import Need, require
from ..landscapes.cost import duration
from ..landscapes.objective import Evaluation, ObjectiveWrapper
from ..landscapes.options import record_options
from ..landscapes.plane import Plane
from ..landscapes.sampling.fill import sample
from ..landscapes.storage.store import SliceStore
from .scene import SceneSpec
from .watch import Watch

K = TypeVar("K")
WAYS = {"forward": False, "with_gradient": True}
LEAST = 2  # repetitions of everything, whatever they take
ADAPTED = 256  # episodes that an engine's own program is timed for
SMALL = 64  # points along each axis of the sampler's slice, at most


@dataclass(frozen=True)
class Start:
    """Record how an engine started: `seconds` until its first gradient, and Warp modules `compiled` for it.

    Other modules came from the cache. `compiled` is None for engines that do not report it, such as Taichi.
    `bytes_per_episode` is the memory that a full batch takes on a CUDA device, per row, None elsewhere.
    """

    seconds: float
    compiled: int | None
    bytes_per_episode: int | None


@dataclass(frozen=True)
class Rate:
    """Record the median of some repetitions: `seconds` for a whole batch, and the rates per second."""

    seconds: float
    episodes_per_second: float
    work_per_second: float

    @classmethod
    def of(cls, env: Environment, batch: int, seconds: float) -> Rate:
        """Return the rate of a batch that took so many seconds."""
        return cls(seconds, batch / seconds, batch * env.work().count / seconds)


@dataclass(frozen=True)
class BatchRate:
    """Record the rates of an engine for one batch size, in which `failed` episodes failed.

    `gradient_costs` is the time of an episode with gradient, divided by that of one without. Ratios are the speed
    relative to the second engine, None without one, and None for the second engine itself.
    """

    engine: str
    batch: int
    failed: int
    repetitions: int
    forward: Rate
    with_gradient: Rate
    gradient_costs: float
    ratio_forward: float | None = None
    ratio_with_gradient: float | None = None

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON, which has ratios only where there are any."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True)
class MemoryUse:
    """Record the memory of an episode [bytes]: as the scene estimates it, and as measured on CUDA, None elsewhere."""

    estimated: int
    measured: int | None


@dataclass(frozen=True)
class SamplerShare:
    """Record the share of the time for sampling so many `points` to disk that is not simulation."""

    points: int
    seconds: float
    share: float


@dataclass(frozen=True)
class AdapterShare:
    """Record the share of a batch's time that is spent outside the compiled program of a third-party engine.

    The engine's program with gradient returns loss and gradient. gradscape also computes the loss alone, so the loss
    does not depend on the gradient to the last bit. This is part of the share.
    """

    batch: int
    forward: float
    with_gradient: float


@dataclass(frozen=True)
class KernelSeconds:
    """Record the launches of a kernel, its total seconds, and their share of the elapsed time."""

    name: str
    calls: int
    seconds: float
    share: float


@dataclass(frozen=True)
class KernelTable:
    """Record the kernels of one batch, slowest first, and the `seconds` of the whole batch."""

    batch: int
    seconds: float
    kernels: tuple[KernelSeconds, ...]


@dataclass(frozen=True)
class Bench:
    """Record the measurements of an environment, with the field names of `landscape bench --json`.

    `start` is by engine. `kernels` is by way (forward, with_gradient), None for engines other than Warp. Ratios are
    those of the largest batch, None without a second engine. `adapter` is None for engines whose programs are our own.
    Each repetition evaluated new points, unless `same_points` is true.
    """

    env: str
    fidelity: str
    options: dict[str, Any]
    device: str
    hardware: str
    engine: str
    deterministic: bool
    work: Work
    against: str | None
    same_points: bool
    start: dict[str, Start]
    memory: MemoryUse
    ratio_forward: float | None
    ratio_with_gradient: float | None
    rates: tuple[BatchRate, ...]
    kernels: dict[str, KernelTable] | None
    sampler: SamplerShare
    adapter: AdapterShare | None = None

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON."""
        return {**asdict(self), "rates": [rate.record() for rate in self.rates]}


@dataclass(frozen=True)
class BenchJob:
    """An environment to measure on an engine, in turn with another one if `against` names it.

    `make` returns the environment for an engine. Each of `batches` (1 and the preferred one by default) is timed for
    about so many `seconds`, at new points in each repetition: a search never evaluates a point twice, and some engines
    prepare for the positions of bodies. With `same_points` only kernels are compared.
    """

    make: Callable[[str], Environment]
    engine: str
    against: str | None = None
    batches: Sequence[int] = ()
    seconds: float = 10.0
    same_points: bool = False

    @classmethod
    def of(cls, scene: SceneSpec, **how: Any) -> BenchJob:
        """Measure a scene on its engine; another one is never asked to be deterministic, which Taichi cannot be."""
        against = how.get("against")

        def make(engine: str) -> Environment:
            return replace(scene, engine=engine, deterministic=scene.deterministic and engine != against).make()

        return cls(make, scene.engine or scene.kind.engines[0], **how)

    def run(self, watch: Watch | None = None) -> Bench:
        """Measure it, and return the record.

        Raises ValueError if the scene does not have an engine, TooLargeError if a batch does not fit in memory.
        """
        watch = watch or Watch()
        with watch.busy("preparing") as say:
            envs, starts = _start_engines(self.make, self.engine, self.against, say)
            env = envs[self.engine]
            for batch in self.batches:
                require("batch", batch, partial(_need, env))
            watch.note(f"{env.name}: timing each batch size takes {duration(self.seconds)} or more")
            rates = list[BatchRate]()
            for batch in self.batches or sorted({1, env.preferred_batch}):
                say(f"timing batches of {batch}")
                rates += _time_batch(envs, batch, self.seconds, same=self.same_points)
            say("timing kernels")
            part, profiled = _points(env, env._rows_per_part(env.preferred_batch)), find_engine(self.engine).profiled
            kernels = tabulate_kernels(env, part) if profiled else None
            adapter = _time_adapter(env, self.seconds)
            say("timing the sampler")
            own = [rate.with_gradient.episodes_per_second for rate in rates if rate.engine == self.engine]
            sampler = _time_sampler(env, max(own) * self.seconds / 2)
        largest = max((rate for rate in rates if rate.ratio_forward), key=lambda rate: rate.batch, default=None)
        return Bench(
            env=env.name,
            fidelity=env.fidelity.name,
            options=record_options(env.options),
            device=env.device,
            hardware=device_names()[0] if env.device == "cuda" else f"{cores()} cores",
            engine=env.engine,
            deterministic=env.deterministic,
            work=env.work(),
            against=self.against,
            same_points=self.same_points,
            start=starts,
            memory=MemoryUse(env.memory(), starts[self.engine].bytes_per_episode),
            ratio_forward=largest.ratio_forward if largest else None,
            ratio_with_gradient=largest.ratio_with_gradient if largest else None,
            rates=tuple(rates),
            kernels=kernels,
            sampler=sampler,
            adapter=adapter,
        )


def _need(env: Environment, batch: int) -> Need:
    """Return what a batch takes: its points and gradients, some copies of them, and the episodes that run at once."""
    return Need(8.0 * 8 * batch * env.space.dim + env.memory() * min(batch, env._rows_per_part(batch) * env.threads))


def _start_engines(
    make: Callable[[str], Environment], engine: str, against: str | None, follow: Callable[[str], None]
) -> tuple[dict[str, Environment], dict[str, Start]]:
    """Return environments by engine, each made when the one before has taken what it takes of a GPU."""
    if engine == against:
        raise ValueError(f"bench compares two different engines; got {engine} twice")
    envs, starts = {engine: make(engine)}, {}
    if against is not None:
        envs[engine].check_engine(against)
    for name in (engine,) if against is None else (engine, against):
        follow(f"starting {name}")
        if name not in envs:
            envs[name] = make(name)
        starts[name] = _start(envs[name])
    return envs, starts


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


def _points(env: Environment, count: int, seed: int = 0) -> Float[Tensor, "count dim"]:
    """Return well-spread points of the box, others for each seed, the same for every engine."""
    return env.space.sobol(count, seed=seed)


def _time_batch(envs: Mapping[str, Environment], batch: int, seconds: float, *, same: bool) -> list[BatchRate]:
    """Time a batch on every engine in turn, forward and with gradient, of other points in each round or of the same.

    The first engine's rate holds the ratios.
    """
    draw = partial(_points, next(iter(envs.values())), batch)
    points = draw(0)
    lost = {name: int(env.evaluate(points).failed.sum()) for name, env in envs.items()}  # warms up too
    calls = {(name, grad): partial(env.evaluate, grad=grad) for grad in WAYS.values() for name, env in envs.items()}
    times = alternate(calls, seconds, lambda number: points if same else draw(1 + number))
    found = []
    for name, env in envs.items():
        seconds_of = [statistics.median(times[name, grad]) for grad in WAYS.values()]
        forward, sloped = (Rate.of(env, len(points), one) for one in seconds_of)
        costs = sloped.seconds / forward.seconds
        found.append(BatchRate(name, len(points), lost[name], len(times[name, True]), forward, sloped, costs))
    for other in found[1:]:
        found[0] = replace(
            found[0],
            ratio_forward=other.forward.seconds / found[0].forward.seconds,
            ratio_with_gradient=other.with_gradient.seconds / found[0].with_gradient.seconds,
        )
    return found


def alternate(
    calls: Mapping[K, Callable[[Tensor], object]], seconds: float, draw: Callable[[int], Tensor]
) -> dict[K, list[float]]:
    """Return the seconds that calls took, made in turn (a, b, a, b, ...) until the next round would end too late.

    All calls of a round take what `draw` gives for its number, which is drawn before their time begins.
    """
    times: dict[K, list[float]] = {key: [] for key in calls}
    start, rounds = time.perf_counter(), 0
    while rounds < LEAST or (time.perf_counter() - start) * (rounds + 1) / rounds < seconds:
        points = draw(rounds)
        for key, call in calls.items():
            began = time.perf_counter()
            call(points)
            times[key].append(time.perf_counter() - began)
        rounds += 1
    return times


def tabulate_kernels(env: Environment, points: Float[Tensor, "count dim"]) -> dict[str, KernelTable]:
    """Return the time by kernel, forward and with gradient, of points that one solver takes at once.

    They run on one thread: what several launch at a time adds up to more than the time that passes.
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
        found[way] = KernelTable(len(points), wall, tuple(rows))
    return found


def _time_adapter(env: Environment, seconds: float) -> AdapterShare | None:
    """Time some 256 episodes against the engine's program alone, in turn; None where the program is our own."""
    points = _points(env, -(-ADAPTED // env.preferred_batch) * env.preferred_batch)
    shares = {}
    for way, grad in WAYS.items():
        engine = env.engine_call(points, grad=grad)
        if engine is None:
            return None
        calls: dict[str, Callable[[Tensor], object]] = {
            "ours": partial(env.evaluate, grad=grad),
            "engine": lambda _, program=engine: program(),  # type: ignore[misc] # of these points alone
        }
        for call in calls.values():
            call(points)
        times = alternate(calls, seconds, lambda _: points)
        shares[way] = max(0.0, 1 - min(times["engine"]) / min(times["ours"]))
    return AdapterShare(len(points), **shares)


class _Clocked(ObjectiveWrapper):
    """An environment that adds up the seconds spent in `evaluate`."""

    def __init__(self, env: Environment) -> None:
        super().__init__(env)
        self.seconds = 0.0

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Evaluate, and note how long it took."""
        began = time.perf_counter()
        result = self.objective.evaluate(x, grad=grad)
        self.seconds += time.perf_counter() - began
        return result


def _time_sampler(env: Environment, points: float) -> SamplerShare:
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
    return SamplerShare(math.prod(plane.resolution), wall, 1.0 - clocked.seconds / wall)
