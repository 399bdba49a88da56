"""What a race will take, found out by letting each method search a made-up landscape a little."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from ..landscapes.cost import duration, seconds_per_episode
from ..landscapes.space import as_whole
from ..landscapes.threads import one_torch_thread
from ..optim.dry_run import BLOCK, DryRun, dry_run
from ..optim.memory import SearchSize, run_need
from ..optim.processes import workers_worth
from ..optim.race import MAX_ABREAST
from ..optim.registry import optimizer_class
from .methods import able_methods, check_methods, require_room
from .plan import HERE, make_here
from .scene import SceneSpec
from .search import make_optimizer
from .slice import peak_memory
from .watch import Watch

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..optim.base import Optimizer

Options = Mapping[str, Mapping[str, Any]]  # method -> name -> value, which may be text


@dataclass(frozen=True)
class Rate:
    """Say what an episode takes in a batch of a race [s], `forward` and with its gradient, and `said`, where from."""

    forward: float
    gradient: float
    said: str = HERE


@dataclass(frozen=True)
class MethodOverhead:
    """The time a method takes itself over all its runs [s]: `serial`, and `parallel`, shared by so many `processes`."""

    serial: float
    parallel: float
    processes: int

    @property
    def wall(self) -> float:
        """The wall time [s]."""
        return self.serial + self.parallel / self.processes


@dataclass(frozen=True)
class Workload:
    """What a race simulates: episodes without gradient and with, number of batches and rows per batch."""

    forward: int
    gradient: int
    batches: int

    @property
    def rows(self) -> tuple[int, int]:
        """Points of a batch on average, without gradient and with."""
        return -(-self.forward // self.batches), -(-self.gradient // self.batches)

    @classmethod
    def of(cls, seen: Mapping[str, DryRun], left: Mapping[str, Sequence[int]]) -> Workload:
        """Add up what the runs of methods have `left`: in lockstep, so that the one with most proposals lasts longest.

        At most `MAX_ABREAST` runs go on at a time.
        """
        whole = {method: sum(left[method]) for method in left}
        gradient = sum(round(whole[method] * seen[method].gradient_share) for method in left)
        waves = -(-sum(map(len, left.values())) // MAX_ABREAST)
        longest = max(max(left[method], default=0) / seen[method].proposal_size for method in left)
        return cls(sum(whole.values()) - gradient, gradient, max(1, waves * round(longest)))


@dataclass(frozen=True)
class RacePlan:
    """Say what a race takes, in seconds and bytes.

    `start` is what passes until the first episode that counts, `own` what methods take by themselves, keeping their
    runs included. `memory` is of the host, `gpu` of the device, `disk` what results take.
    """

    load: Workload
    rate: Rate
    own: Mapping[str, MethodOverhead]
    start: float = 0.0
    memory: int = 0
    gpu: int = 0
    disk: int = 0

    @property
    def episodes(self) -> int:
        """All episodes."""
        return self.load.forward + self.load.gradient

    @property
    def simulating(self) -> float:
        """How long a device simulates [s]."""
        return self.load.forward * self.rate.forward + self.load.gradient * self.rate.gradient

    @property
    def searching(self) -> float:
        """How long the methods themselves take [s]: nothing is simulated meanwhile."""
        return sum(one.wall for one in self.own.values())

    @property
    def wall(self) -> float:
        """Seconds from start to end, but for the picture."""
        return self.start + self.simulating + self.searching

    @property
    def share(self) -> float:
        """The methods' share of the time."""
        return self.searching / (self.simulating + self.searching)

    def outcome(self) -> str:
        """Say in a line what it takes."""
        dear = max(self.own, key=lambda method: self.own[method].wall)
        most = f", {duration(self.own[dear].wall)} of them {dear}" if len(self.own) > 1 else ""
        return (
            f"about {duration(self.simulating + self.searching)}: {duration(self.simulating)} of simulating in batches "
            f"of {sum(self.load.rows)}, {duration(self.searching)} the methods' own{most}"
        )

    def record(self) -> dict[str, Any]:
        """Return all of it as plain JSON."""
        return {
            **{"episodes": self.episodes, "with_gradient": self.load.gradient, "batches": self.load.batches},
            **{"wall": self.wall, "methods_share": self.share},
            "seconds": {"start": self.start, "simulating": self.simulating, "methods": self.searching},
            "methods": {name: {**asdict(one), "wall": one.wall} for name, one in self.own.items()},
            **{"device_hours": self.simulating / 3600, "rate": asdict(self.rate)},
            **{"memory": {"host": self.memory, "device": self.gpu}, "disk": {"bytes": self.disk}},
        }


@dataclass(frozen=True)
class RaceForecast:
    """Hold a `plan` and the race it is of; fields are called as `landscape plan --json` has them."""

    env: str
    fidelity: str
    device: str
    engine: str
    seeds: int
    budget: int
    workers: int
    plan: RacePlan

    def record(self) -> dict[str, Any]:
        """Return all of it as plain JSON."""
        about = ("env", "fidelity", "device", "engine", "seeds", "budget", "workers")
        return {name: getattr(self, name) for name in about} | self.plan.record()


@dataclass(frozen=True)
class RacePlanJob:
    """A race to foretell, of the methods that are named or all that can search the scene; nothing of it is kept."""

    scene: SceneSpec
    methods: Sequence[str]
    seeds: int
    budget: int
    workers: int = 1
    options: Options = field(default_factory=dict)

    def run(self, watch: Watch | None = None, *, began: float | None = None) -> RaceForecast:
        """Rehearse it, and foretell what it takes.

        `began` is when its command would have begun, on the clock of `time.perf_counter`; now, by default. For a CUDA
        device that is not here, what `landscape tradeoff` kept of one counts. Raises ValueError for what the scene or a
        method does not have, and where nothing is known of the device that is asked for; TooLargeError for a race that
        would not fit this machine.
        """
        began = time.perf_counter() if began is None else began
        watch, seeds = watch or Watch(), as_whole(self.seeds, "a number of seeds", least=1)
        budget, workers = as_whole(self.budget, "a budget", least=1), as_whole(self.workers, "workers", least=1)
        named = check_methods(self.methods)
        env, device = make_here(self.scene)
        methods = named or able_methods(env, watch)
        require_room(env, methods, self.options, seeds=seeds, budget=budget, folder=Path())
        with watch.busy(f"{env.name}: rehearsing {env.fidelity.name} episodes and {', '.join(methods)}"):
            env.prepare()
            start = time.perf_counter() - began
            left = {method: [budget] * seeds for method in methods}
            makers = {name: partial(make_optimizer, name, env, options=self.options.get(name)) for name in methods}
            how: dict[str, Any] = {"workers": workers, "start": start, "device": device}
            plan = plan_race(env, makers, left, budget, **how)
        return RaceForecast(env.name, env.fidelity.name, device, env.engine, seeds, budget, workers, plan)


@one_torch_thread()
def plan_race(
    env: Environment,
    makers: Mapping[str, Callable[[], Optimizer]],
    left: Mapping[str, Sequence[int]],
    budget: int,
    *,
    workers: int = 1,
    start: float = 0.0,
    device: str | None = None,
) -> RacePlan:
    """Plan a race whose runs have so many episodes `left` of a budget, method -> one number for each run.

    `makers` make each method. Raises ValueError where nothing is known of a `device` other than the environment's.
    """
    workers = workers_worth(workers, max((max(runs, default=0) for runs in left.values()), default=0))
    with TemporaryDirectory() as folder:
        seen = {}
        for method, make in makers.items():
            (Path(folder) / method).mkdir()
            seen[method] = dry_run(env, make, budget, Path(folder) / method)
    load = Workload.of(seen, left)
    rate, gpu = _rate(env, load, device or env.device)
    need = run_need(env.space.dim, budget).times(sum(map(len, left.values())))
    size = SearchSize(env.space.dim, env.decisions, budget)
    model = max(type(made).memory(asdict(made.options), size) for made in (make() for make in makers.values()))
    processes = peak_memory() * (
        workers if workers > 1 and any(step.parallel for one in seen.values() for step in one.steps) else 0
    )
    own = {method: own_time(seen[method], left[method], budget, workers) for method in left}
    memory = round(peak_memory() + need.memory + workers * model) + processes
    return RacePlan(load, rate, own, start, memory, gpu, round(need.disk))


def outlook(
    env: Environment,
    makers: Mapping[str, Callable[[], Optimizer]],
    left: Mapping[str, Sequence[int]],
    budget: int,
    *,
    workers: int,
) -> str:
    """Say in a line what `plan_race` foretells, or what the simulator takes where rehearsing would be much of the race.

    There all episodes of a method that asks for gradients are counted with.
    """
    if worth_rehearsing(left):
        return plan_race(env, makers, left, budget, workers=workers).outcome()
    rows = min(sum(map(len, left.values())), env.preferred_batch)
    needs = {method: optimizer_class(method).needs_grad for method in left}
    whole = 0.0
    for grad in (False, True):
        if count := sum(sum(left[method]) for method in left if needs[method] == grad):
            whole += count * seconds_per_episode(env, env.space.uniform(rows, seed=0), grad=grad)
    return f"{duration(whole)} in batches of one point a run, and what the methods take"


def worth_rehearsing(left: Mapping[str, Sequence[int]]) -> bool:
    """Return whether a rehearsal of a race is little of it: four blocks of each method at least are left."""
    return bool(left) and sum(map(sum, left.values())) >= 4 * BLOCK * len(left)


def own_time(seen: DryRun, left: Sequence[int], budget: int, workers: int) -> MethodOverhead:
    """Return what a method's runs take of their own, that have so many episodes left of a budget."""
    parts = [seen.seconds(budget - episodes, budget) for episodes in left]
    processes = max(1, min(workers, len(left)))
    return MethodOverhead(sum(serial for serial, _ in parts), sum(parallel for _, parallel in parts), processes)


def _rate(env: Environment, load: Workload, device: str) -> tuple[Rate, int]:
    """Return what an episode takes in the batches of a race on a device, and the device's memory for one."""
    from .tolerance import find_variant

    if device != env.device:
        variant, path = find_variant(env, device)
        seconds, many = variant.comparison.seconds, variant.comparison.batch
        said = f"kept by `landscape tradeoff` in {path}, of batches of {many}; the methods {HERE}"
        return Rate(seconds.forward, seconds.with_gradient, said), variant.memory or 0
    each = [
        seconds_per_episode(env, env.space.uniform(min(rows, env.preferred_batch), seed=0), grad=grad) if rows else 0.0
        for grad, rows in zip((False, True), load.rows, strict=True)
    ]
    rows = min(sum(load.rows), env.preferred_batch)
    return Rate(each[0], each[1]), env.memory() * rows if env.device == "cuda" else 0
