"""The time a method takes itself, estimated by a short search of a synthetic landscape."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..landscapes.objective import Evaluation, Objective, ObjectiveWrapper
from .base import Optimizer
from .lockstep import Lockstep
from .runs.store import RunStore
from .search import SearchProgress, fill

BLOCK = 128  # episodes that a method is timed for at each number of known episodes
MAX_SECONDS = 1.5  # for each of these, about; at least one proposal is timed
WARM_UP = 16  # episodes, after which all libraries are loaded
MIN_KNOWN = 32  # episodes known at the first place after the beginning
KNOWN_RATIO = 3  # of the numbers of known episodes at successive places


@dataclass(frozen=True)
class StepTime:
    """Seconds per episode once so many are `known`: `serial`, and `parallel` in what worker processes would compute."""

    known: float
    serial: float
    parallel: float


@dataclass(frozen=True)
class DryRun:
    """What a method takes: times of a step, mean episodes of a proposal, and the share of episodes with a gradient.

    The time of an episode is interpolated between those of `steps`, and constant beyond them.
    """

    steps: tuple[StepTime, ...]
    proposal_size: float
    gradient_share: float

    def seconds(self, first: int, budget: int) -> tuple[float, float]:
        """Return what episodes from the `first` to a budget take [s]: serially, and in parallel."""
        known, at = np.arange(first, budget), [one.known for one in self.steps]
        serial = np.interp(known, at, [one.serial for one in self.steps])
        parallel = np.interp(known, at, [one.parallel for one in self.steps])
        return float(serial.sum()), float(parallel.sum())


class SyntheticObjective(ObjectiveWrapper):
    """Cheap synthetic objective with the same parameter space.

    Its loss is a bowl with waves over the box scaled to [0, 1]. `asked` counts points without and with a gradient.
    """

    def __init__(self, objective: Objective) -> None:
        super().__init__(objective)
        self.name = "synthetic"
        self.asked = {False: 0, True: 0}

    def prepare(self) -> None:
        """Do nothing: there is nothing to compile."""

    def evaluate(self, x: Float[Tensor, "count dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked."""
        self.asked[grad] += len(x)
        u = self.space.to_unit(x) - 0.3
        loss = (3.0 * u.square() + 0.3 * torch.sin(9.0 * u)).sum(dim=1)
        slopes = (6.0 * u + 2.7 * torch.cos(9.0 * u)) / (self.space.upper - self.space.lower)
        return Evaluation.from_results(loss, slopes if grad else None)


class _TimeIsUp(Exception):  # noqa: N818 -- nothing went wrong
    """End a dry run."""


def dry_run(objective: Objective, make: Callable[[], Optimizer], budget: int, folder: Path) -> DryRun:
    """Let a method search a synthetic landscape, its runs kept in an empty `folder` as those of a race are.

    A method that remembers is timed where more and more is known, by points drawn at random, up to the budget.
    """
    synthetic, steps, proposals = SyntheticObjective(objective), list[StepTime](), 0
    _advance(SyntheticObjective(objective), make(), WARM_UP)
    for known in places(budget) if make().remembers else [0]:
        optimizer = make()
        if known:
            x = objective.space.uniform(known, seed=0)
            optimizer.inform(x, SyntheticObjective(objective).evaluate(x, grad=optimizer.needs_grad))
            _advance(SyntheticObjective(objective), optimizer, 1)  # fits its model, which most proposals do not
        length = min(BLOCK, budget) if optimizer.remembers else budget
        step, asked = _time(synthetic, optimizer, known, length, folder / f"{known}.zarr")
        steps.append(step)
        proposals += asked
    total = sum(synthetic.asked.values())
    return DryRun(tuple(steps), total / proposals, synthetic.asked[True] / total)


def _advance(synthetic: SyntheticObjective, optimizer: Optimizer, episodes: int) -> None:
    """Let an optimiser go on by so many episodes, untimed."""
    while sum(synthetic.asked.values()) < episodes:
        proposal = optimizer.ask()
        optimizer.tell(proposal.x, synthetic.evaluate(proposal.x, grad=proposal.grad))


def places(budget: int) -> list[int]:
    """Return how many episodes are known where a method that remembers is timed: none, then more and more."""
    found, known = [0], budget * 7 // 8
    while known >= MIN_KNOWN:
        found.insert(1, known)
        known //= KNOWN_RATIO
    return found


def _time(
    synthetic: SyntheticObjective, optimizer: Optimizer, known: int, episodes: int, path: Path
) -> tuple[StepTime, int]:
    """Search for so many episodes, or as many as there is time for; return the time of one, and the proposals."""
    lockstep = Lockstep(synthetic)
    seen: list[tuple[int, float, float]] = []  # episodes done, seconds, and those of computations, after each proposal

    def follow(now: SearchProgress) -> None:
        seen.append((now.done, time.perf_counter(), lockstep.computed))
        if now.done and seen[-1][1] - seen[0][1] > MAX_SECONDS:
            raise _TimeIsUp

    run = RunStore.create(path, synthetic.space, identity={"method": optimizer.name, "seed": 0}, budget=episodes)
    with suppress(_TimeIsUp), run.lock():
        lockstep.run([fill(synthetic, optimizer, run, budget=episodes, gradient_cost=1.0, progress=follow)])
    (_, began, before), (done, ended, after) = seen[0], seen[-1]
    parallel = (after - before) / done
    return StepTime(known + done / 2, max(0.0, (ended - began) / done - parallel), parallel), len(seen) - 1
