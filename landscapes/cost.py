"""Measure the seconds of an episode on the objective itself; all estimates use it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from .objective import Objective
from .sampling.memory import MemoryBound

MOMENT = 0.5  # seconds to spend on measuring what an episode alone costs
LONG = 5.0  # seconds from which the first, which warms things up, must do
ENOUGH = 1.0  # seconds that a batch must take to be an estimate
PICTURE_SECONDS = 2.0  # of the first picture, with what is imported for it
FRAME_SECONDS = 0.3  # of each frame of a film
WARM_UP = 10.0  # seconds from which a first batch, which may compile, is not repeated


@dataclass(frozen=True)
class EpisodeCost:
    """The cost of an episode [s], alone, without and with gradient; the latter NaN where it was not measured."""

    forward: float
    gradient: float

    @property
    def ratio(self) -> float:
        """The cost of an episode with gradient, in episodes without."""
        return self.gradient / self.forward


def episode_cost(objective: Objective, *, grad: bool = True) -> EpisodeCost:
    """Measure one random episode, without and with gradient in turn: the best of those that fit into a moment."""
    objective.prepare()
    x = objective.space.uniform(1, seed=0)
    best = {False: float("inf"), True: float("inf") if grad else float("nan")}
    ways = (False, True) if grad else (False,)
    for way in ways if objective.own_programs else ():
        objective.evaluate(x, grad=way)  # compiles it, however long that takes
    began, rounds = time.perf_counter(), 0
    while time.perf_counter() - began < (MOMENT if rounds > 1 else LONG):
        for way in ways:
            best[way] = min(best[way], measure_seconds(objective, x, grad=way))
        rounds += 1
    return EpisodeCost(best[False], best[True])


def seconds_per_episode(
    objective: Objective, points: Float[Tensor, "batch dim"], *, grad: bool, count: float = math.inf
) -> float:
    """Measure the cost of an episode in large batches, at points similar to the planned ones [s].

    As many points as there are threads are timed, twice, because the first time is longer. More points follow until
    they take long, or until all `count` planned ones would be quick, which need no better estimate. A GPU takes a whole
    batch at once, because for one point most of the time would be launches. So does an engine with `whole_batches`,
    where one point costs as much as a batch. If the batch does not fit into its memory, parts of it are timed, as they
    will be computed. Raises MemoryError where one point does not fit.
    """
    bound = MemoryBound(objective)
    whole = objective.device == "cuda" or objective.whole_batches
    rows = len(points) if whole else min(len(points), objective.threads)
    seconds = measure_seconds(bound, points[:rows], grad=grad)
    if seconds < WARM_UP or objective.own_programs:
        seconds = measure_seconds(bound, points[:rows], grad=grad)
    while seconds < ENOUGH <= seconds / rows * count and rows < len(points):
        rows = min(round(max(4.0, ENOUGH / max(seconds, 1e-9)) * rows), len(points))  # they take no longer than enough
        if objective.own_programs:
            bound.evaluate(points[:rows], grad=grad)  # compiles what such a batch takes
        seconds = measure_seconds(bound, points[:rows], grad=grad)
    return seconds / rows


def start_seconds(objective: Objective, points: Float[Tensor, "batch dim"], *, grad: bool = True) -> float:
    """Measure the start-up time of an objective that compiles its own programs, for this number of points [s].

    It is 0 for others, because all objectives of their kind share compiled code.
    """
    if not objective.own_programs:
        return 0.0
    first, then = (measure_seconds(objective, points, grad=grad) for _ in range(2))
    return max(0.0, first - then)


def measure_seconds(objective: Objective, points: Float[Tensor, "batch dim"], *, grad: bool) -> float:
    """Return the time of one evaluation [s]."""
    start = time.perf_counter()
    objective.evaluate(points, grad=grad)
    return time.perf_counter() - start


def duration(seconds: float) -> str:
    """Return a time in words, to about two digits."""
    if seconds < 90:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
