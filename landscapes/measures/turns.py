"""Answers and times of two objectives that are compared: the same points, and batches timed in turn."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..cost import measure_seconds
from ..objective import Evaluation, Objective, evaluate
from .fidelity import Array, Bootstrap, Sample, median_of

ROUNDS, MOST_ROUNDS = 9, 49  # least and most rounds in which two objectives are timed in turn
LASTING = 8.0  # least seconds that the rounds take together, up to the most
ENOUGH = 0.2  # seconds that a batch should take to be timed


@dataclass(frozen=True, eq=False)
class Answers:
    """Hold what an objective says at the points of a study.

    `loss` [objective's unit], shape (point,); `grad` [loss unit / width of the box], shape (point, dim); `status`,
    shape (point,).
    """

    loss: Array
    grad: Array
    status: NDArray[np.int8]

    def again(self, repeats: int) -> Answers:
        """Return the answers of the same points so many times, one after the other."""
        return Answers(*(np.concatenate([whole] * repeats) for whole in (self.loss, self.grad, self.status)))

    def sample(self, turns: Turns | None = None) -> Sample:
        """Return them with the least times of the second of two objectives; without any, times are zero."""
        if turns is None:
            return Sample(self.loss, self.grad, self.status, 0.0, 0.0, 0)
        forward, with_gradient = map(float, turns.second.min(axis=1))
        return Sample(self.loss, self.grad, self.status, forward, with_gradient, int(turns.batch))


@dataclass(frozen=True, eq=False)
class Turns:
    """Hold the seconds per episode of two objectives timed in turn, each without and with gradient, shape (2, round).

    `batch` is how many episodes were timed at once.
    """

    first: Array
    second: Array
    batch: int

    def ratio(self, *, grad: bool, seed: int) -> Bootstrap:
        """Estimate the ratio of the second's time to the first's: the median of the rounds'."""
        return Bootstrap.of(median_of, self.second[int(grad)] / self.first[int(grad)], seed=seed)


def ask(
    objective: Objective, x: Float[Tensor, "point dim"], *, follow: Callable[[int], None] = lambda done: None
) -> Answers:
    """Evaluate an objective at the points of a study; `follow` hears how many points are done."""
    parts, done = list[Evaluation](), 0
    for part in torch.split(x, objective.preferred_batch):
        parts.append(evaluate(objective, part, grad=True))
        follow(done := done + len(part))
    whole = Evaluation.join(parts, dim=objective.space.dim, grad=True)
    grad = cast("Tensor", whole.grad) * (objective.space.upper - objective.space.lower)
    return Answers(whole.loss.numpy(), grad.numpy(), whole.status.numpy())


def take_turns(first: Objective, second: Objective, x: Float[Tensor, "point dim"]) -> Turns:
    """Time two objectives in turn at the same points, so that whatever else keeps the machine busy disturbs both alike.

    Each round times both without gradient, then both with it; which is first changes from round to round.
    """
    both = (first, second)
    batch = _batch(both, x)
    seconds: dict[bool, list[list[float]]] = {False: [], True: []}
    began, rounds = time.perf_counter(), 0
    while rounds < ROUNDS or (rounds < MOST_ROUNDS and time.perf_counter() - began < LASTING):
        order = (0, 1) if rounds % 2 == 0 else (1, 0)
        for grad, found in seconds.items():
            taken = {number: measure_seconds(both[number], batch, grad=grad) / len(batch) for number in order}
            found.append([taken[0], taken[1]])
        rounds += 1
    table = np.array([seconds[False], seconds[True]])
    return Turns(table[..., 0], table[..., 1], len(batch))


def _batch(both: tuple[Objective, Objective], x: Float[Tensor, "point dim"]) -> Float[Tensor, "batch dim"]:
    """Return as many points as take both long enough to be timed, from as many as there are threads; warm both up."""
    most = min(len(x), *(one.preferred_batch for one in both))
    whole = both[0].device == "cuda"  # takes all at once: of one point most would be launches
    rows = most if whole else min(most, max(one.threads for one in both))
    while True:
        for one in both:
            measure_seconds(one, x[:rows], grad=True)
        if rows == most or min(measure_seconds(one, x[:rows], grad=False) for one in both) >= ENOUGH:
            return x[:rows]
        rows = min(2 * rows, most)
