"""What an executor's workers do for a race: a run each, written to its place, and the time of an episode."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import cloudpickle

from ..commands.search_report import give_torch_one_thread, made
from .workers import recipe

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..envs.base import Environment
    from ..landscapes.cost import EpisodeCost
    from ..optim.race import Entry
    from ..optim.search import Progress


def search_all(
    executor: Executor, env: Environment, entries: Sequence[Entry], *, budget: int, ratio: float | None
) -> Iterator[tuple[Entry, Progress]]:
    """Let workers fill runs, and yield each with how far it came as it ends."""
    from ..landscapes.sampling.distribution import run_tasks

    there = cloudpickle.dumps(recipe(env))
    tasks = [(number, there, *_told(entry), budget, ratio) for number, entry in enumerate(entries)]
    for number, now in run_tasks(executor, _search, tasks):
        yield entries[number], now


def cost(executor: Executor, env: Environment, *, grad: bool) -> EpisodeCost:
    """Return what an episode takes a worker."""
    from ..landscapes.sampling.distribution import run_tasks

    (found,) = run_tasks(executor, _cost, [(cloudpickle.dumps(recipe(env)), grad)])
    return found


def _told(entry: Entry) -> tuple[str, dict[str, Any]]:
    """Return the path of a run, and how its optimiser is made."""
    options = entry.made.keywords["options"]  # type: ignore[attr-defined]
    return str(entry.run.path), {"method": entry.method, "seed": entry.seed, "options": dict(options)}


def _search(
    number: int, there: bytes, path: str, how: dict[str, Any], budget: int, ratio: float | None
) -> tuple[int, Progress]:
    from ..landscapes.sampling.distribution import make_objective
    from ..optim.run import Run
    from ..optim.search import search

    give_torch_one_thread()
    env: Any = make_objective(there).objective
    seen: list[Progress] = []
    optimizer = made(how["method"], env, seed=how["seed"], options=how["options"])
    search(env, optimizer, Run.open(path), budget=budget, gradient_cost=ratio, progress=seen.append)
    return number, seen[-1]


def _cost(there: bytes, grad: bool) -> EpisodeCost:
    from ..landscapes.cost import episode_cost
    from ..landscapes.sampling.distribution import make_objective

    return episode_cost(make_objective(there).objective, grad=grad)
