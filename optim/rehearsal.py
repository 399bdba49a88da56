"""What a method takes itself in a search, found out by letting it search a made-up landscape a little."""

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
from .processes import seconds_computed
from .runs.store import RunStore
from .search import SearchProgress, search

BLOCK = 128  # episodes that are rehearsed of a method that remembers, with each number of episodes known before
MOMENT = 1.5  # seconds that each of these takes, about; at least one proposal is rehearsed
LOADING = 16  # episodes after which whatever is loaded at first use has been
LEAST = 32  # episodes known at the first place after the beginning
FARTHER = 3  # times as many episodes known as at the place before


@dataclass(frozen=True)
class Pace:
    """Say what an episode takes [s] where so many are `known`: `here`, and `apart` in what processes would compute."""

    known: float
    here: float
    apart: float


@dataclass(frozen=True)
class Rehearsal:
    """What a method was seen to take: its paces, episodes in a proposal, and the share of them with a gradient.

    Between the paces, what an episode takes is interpolated; beyond them it stays the same.
    """

    paces: tuple[Pace, ...]
    together: float
    gradients: float

    def seconds(self, first: int, budget: int) -> tuple[float, float]:
        """Return what episodes from the `first` to a budget take [s]: here, and apart."""
        known = np.arange(first, budget)
        at = [pace.known for pace in self.paces]
        here, apart = (
            float(np.interp(known, at, [getattr(pace, part) for pace in self.paces]).sum())
            for part in ("here", "apart")
        )
        return here, apart


class MadeUp(ObjectiveWrapper):
    """A landscape with the box of an objective, and whatever else that one says of itself, at no cost.

    Its loss is a bowl with waves over the box scaled to [0, 1]. `asked` counts points, and those with a gradient.
    """

    def __init__(self, objective: Objective) -> None:
        super().__init__(objective)
        self.name = "made up"
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


class _Enough(Exception):  # noqa: N818 -- nothing went wrong
    """Stop a rehearsal."""


def rehearse(objective: Objective, make: Callable[[], Optimizer], budget: int, folder: Path) -> Rehearsal:
    """Let a method search a made-up landscape, its runs kept in an empty `folder` as those of a race are.

    A method that remembers is rehearsed where more and more is known, by points drawn at random, up to the budget.
    """
    made_up, paces, proposals = MadeUp(objective), [], 0
    _advance(MadeUp(objective), make(), LOADING)
    for known in places(budget) if make().remembers else [0]:
        optimizer = make()
        if known:
            x = objective.space.uniform(known, seed=0)
            optimizer.inform(x, MadeUp(objective).evaluate(x, grad=optimizer.needs_grad))
            _advance(MadeUp(objective), optimizer, 1)  # it learns anew, which it does not at every proposal
        length = min(BLOCK, budget) if optimizer.remembers else budget
        pace, asks = _pace(made_up, optimizer, known, length, folder / f"{known}.zarr")
        paces.append(pace)
        proposals += asks
    total = sum(made_up.asked.values())
    return Rehearsal(tuple(paces), total / proposals, made_up.asked[True] / total)


def _advance(made_up: MadeUp, optimizer: Optimizer, episodes: int) -> None:
    """Let an optimiser go on by so many episodes, untimed."""
    while sum(made_up.asked.values()) < episodes:
        proposal = optimizer.ask()
        optimizer.tell(proposal.x, made_up.evaluate(proposal.x, grad=proposal.grad))


def places(budget: int) -> list[int]:
    """Return how many episodes are known where a method that remembers is rehearsed: none, then more and more."""
    found, known = [0], budget * 7 // 8
    while known >= LEAST:
        found.insert(1, known)
        known //= FARTHER
    return found


def _pace(made_up: MadeUp, optimizer: Optimizer, known: int, episodes: int, path: Path) -> tuple[Pace, int]:
    """Search for so many episodes, or as many as fit into a moment, and return what one took and the proposals."""
    seen: list[tuple[int, float, float]] = []  # episodes done, and both clocks, after each proposal

    def follow(now: SearchProgress) -> None:
        seen.append((now.done, time.perf_counter(), seconds_computed()))
        if now.done and seen[-1][1] - seen[0][1] > MOMENT:
            raise _Enough

    run = RunStore.create(path, made_up.space, identity={"method": optimizer.name, "seed": 0}, budget=episodes)
    with suppress(_Enough):
        search(made_up, optimizer, run, budget=episodes, gradient_cost=1.0, progress=follow)
    (_, began, before), (done, ended, after) = seen[0], seen[-1]
    apart = (after - before) / done
    return Pace(known + done / 2, max(0.0, (ended - began) / done - apart), apart), len(seen) - 1
