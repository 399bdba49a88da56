"""The cost of a job, by arithmetic: its episodes times the time of one, and the size of its files."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..landscapes.capacity import peak_memory
from ..landscapes.cost import seconds_per_episode, start_seconds
from .watch import PREPARING, Watch, Work

if TYPE_CHECKING:
    from ..landscapes.objective import Objective

MEASURED = "measured now on this machine"


@dataclass(frozen=True)
class PlannedWork:
    """Record the cost of one objective's part of a job: seconds per episode of each kind, and bytes.

    `rate` says where the seconds come from. `compiling` is the time before the first episode [s], and `repeating` the
    time of repetitions for timing [s].
    """

    env: str
    fidelity: str
    device: str
    losses: int
    gradients: int
    seconds_per_loss: float
    seconds_per_gradient: float
    rate: str
    memory: int
    gpu_memory: int
    disk: int
    compiling: float = 0.0
    repeating: float = 0.0

    @property
    def seconds(self) -> float:
        """The time to compile and simulate all of it [s]."""
        episodes = self.losses * self.seconds_per_loss + self.gradients * self.seconds_per_gradient
        return self.compiling + episodes + self.repeating


@dataclass(frozen=True)
class Plan:
    """Record the cost of a job on one device: episodes, seconds of simulation, bytes of memory and of disk.

    The time of search methods and pictures themselves is not included.
    """

    command: str
    parts: tuple[PlannedWork, ...]
    episodes: int
    gradients: int
    seconds: float
    device_hours: float
    memory: int
    gpu_memory: int
    disk: int

    @classmethod
    def of(cls, command: str, parts: tuple[PlannedWork, ...]) -> Plan:
        """Add up what the parts take; of memory the largest counts."""
        gradients, seconds = sum(part.gradients for part in parts), sum(part.seconds for part in parts)
        return cls(
            command,
            parts,
            episodes=sum(part.losses for part in parts) + gradients,
            gradients=gradients,
            seconds=seconds,
            device_hours=seconds / 3600,
            memory=max((part.memory for part in parts), default=0),
            gpu_memory=max((part.gpu_memory for part in parts), default=0),
            disk=sum(part.disk for part in parts),
        )


def plan_work(works: Sequence[Work], command: str, watch: Watch, *, device: str | None = None) -> Plan:
    """Time a few episodes of each objective, and return what all of the work takes.

    A `device` that is not here is planned by the rates that a study of the fidelities has kept of it. Raises ValueError
    where none is kept.
    """
    parts = []
    for same in {id(work.objective): work.objective for work in works}.values():
        mine = [work for work in works if work.objective is same]
        whole = Work(
            same,
            losses=sum(work.losses for work in mine),
            gradients=sum(work.gradients for work in mine),
            disk=sum(work.disk for work in mine),
            memory=max(work.memory for work in mine),
            others=sum(work.others for work in mine),
            repeats=lambda each, mine=mine: sum(work.repeats(each) for work in mine),  # type: ignore[misc]
        )
        with watch.busy(f"{same.name}: {PREPARING}"):
            parts.append(_plan_part(whole, device))
    return Plan.of(command, tuple(parts))


def simulation_seconds(objective: Objective, losses: int, gradients: int, rows: int) -> float:
    """Measure what so many episodes without and with gradient take, so many `rows` in a batch [s]."""
    objective.prepare()
    x = objective.space.uniform(max(1, min(rows, objective.preferred_batch)), seed=0)
    counts = {False: losses, True: gradients}
    return sum(n * seconds_per_episode(objective, x, grad=grad, count=n) for grad, n in counts.items() if n)


def _plan_part(work: Work, device: str | None) -> PlannedWork:
    objective, identity = work.objective, work.objective.identity()
    counts, rate, compiling = {False: work.losses, True: work.gradients}, MEASURED, 0.0
    if device is not None:
        from ..envs.registry import as_environment
        from .scene import find_variant

        variant, path = find_variant(as_environment(objective), device)
        kept = variant.comparison.seconds
        each, rate = {False: kept.forward, True: kept.with_gradient}, f"stored in {path}"
    else:
        compiling = _compiling_seconds(objective, work)
        each = {grad: _seconds(objective, count, grad=grad) for grad, count in counts.items()}
    episodes = objective.memory() * objective.preferred_batch
    on_gpu = (device or objective.device) == "cuda"
    return PlannedWork(
        env=objective.name,
        fidelity=str(identity.get("fidelity", "")),
        device=device or objective.device,
        losses=work.losses,
        gradients=work.gradients,
        seconds_per_loss=each[False],
        seconds_per_gradient=each[True],
        rate=rate,
        memory=round(peak_memory() + work.memory),
        gpu_memory=episodes if on_gpu else 0,
        disk=round(work.disk),
        compiling=compiling,
        repeating=work.repeats(each[True]),
    )


def _compiling_seconds(objective: Objective, work: Work) -> float:
    """Measure what comes before the first episode [s], of the objective and of the others of its kind."""
    began = time.perf_counter()
    objective.prepare()
    prepared = time.perf_counter() - began
    rows = max(1, min(objective.preferred_batch, work.losses + work.gradients))
    start = start_seconds(objective, objective.space.uniform(rows, seed=0), grad=work.gradients > 0)
    return prepared + (1 + work.others) * start


def _seconds(objective: Objective, count: int, *, grad: bool) -> float:
    """Return what one of so many episodes takes [s], 0 where there is none."""
    if not count:
        return 0.0
    x = objective.space.uniform(min(objective.preferred_batch, count), seed=0)
    return seconds_per_episode(objective, x, grad=grad, count=count)
