"""The loop: ask, evaluate, keep, tell."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..landscapes.cost import episode_cost
from ..landscapes.identity import EPISODES_PER_POINT, StoreError
from ..landscapes.objective import Objective
from ..landscapes.space import as_whole
from .base import Optimizer
from .lockstep import Asking, Evaluate, Lockstep
from .registry import optimizer_class
from .runs.store import RunStore


@dataclass(frozen=True)
class SearchProgress:
    """The progress of a run: `done` of `total` episodes, `resumed` of them before; `best` is NaN before a success."""

    done: int
    total: int
    resumed: int
    failed: int
    best: float


def search(
    objective: Objective,
    method: Optimizer | str,
    run: RunStore | None = None,
    *,
    budget: int,
    gradient_cost: float | None = None,
    progress: Callable[[SearchProgress], None] | None = None,
) -> RunStore:
    """Let a method evaluate exactly `budget` episodes, and return the run; existing episodes are not repeated.

    A method is an optimiser or the name of one, made with the run's seed. Without a run, one is made in memory. You can
    stop it at any moment: the same call continues. Its rows are those of an uninterrupted run, except for their
    `seconds`, if rows of the objective do not depend on their batch. A proposal that exceeds the budget is cut short.
    `gradient_cost` is the cost of an episode with gradient in episodes without; it is measured if not given. Raises
    ValueError for an invalid budget, method or gradient cost, and StoreError for a run on disk that cannot be
    continued.
    """
    budget = as_whole(budget, "a budget", least=1)
    run = _in_memory(objective, method, budget) if run is None else run
    with run.lock():
        filling = fill(objective, method, run, budget=budget, gradient_cost=gradient_cost, progress=progress)
        Lockstep(objective).run([filling])
    return run


def fill(
    objective: Objective,
    method: Optimizer | str,
    run: RunStore,
    *,
    budget: int,
    gradient_cost: float | None = None,
    progress: Callable[[SearchProgress], None] | None = None,
) -> Asking[None]:
    """Return the search that fills a locked run up to a budget, its optimiser restored; raises as `search` does."""
    if gradient_cost is not None and not 0 < gradient_cost < math.inf:
        raise ValueError(f"search takes a gradient_cost above 0 and finite; got {gradient_cost}")
    optimizer = _begin(objective, method, run, gradient_cost) if run.count < budget else None
    resumed = run.count

    def report() -> None:
        if progress is not None:
            progress(SearchProgress(run.count, budget, resumed, run.failed, run.best_loss))

    report()
    if optimizer is not None:
        run.extend(budget)
    return _fill(optimizer, run, budget, report)


def _in_memory(objective: Objective, method: Optimizer | str, budget: int) -> RunStore:
    name, seed = (method, 0) if isinstance(method, str) else (method.name, method.seed)
    identity: dict[str, Any] = {"objective": objective.name, "method": name, "seed": seed}
    identity[EPISODES_PER_POINT] = objective.episodes_per_point
    return RunStore.in_memory(objective.space, identity=identity, budget=budget)


def _fill(optimizer: Optimizer | None, run: RunStore, budget: int, report: Callable[[], None]) -> Asking[None]:
    """Ask, have the points evaluated, tell and store them; without an optimiser there is nothing to do."""
    mark, complete, largest = 0.0, True, 0
    if optimizer is None:
        return
    while run.count < budget:
        if budget - run.count < largest:  # the next proposal may be cut short, and is proposed again by who continues
            run.stage(optimizer.state)
        proposal = yield from optimizer.asking()
        _check(optimizer, len(proposal.x), grad=proposal.grad)
        largest = max(largest, len(proposal.x))
        x = proposal.x[: budget - run.count]
        complete = len(x) == len(proposal.x)
        evaluation, now = yield Evaluate(x, proposal.grad)
        seconds, mark = now - mark, now
        if complete:
            optimizer.tell(x, evaluation)
            run.keep_remark(optimizer.remark)
        run.append(x, evaluation, proposal.kind, seconds, optimizer.state if complete else None)
        report()
    run.save(optimizer.state if complete else None)


def _begin(objective: Objective, method: Optimizer | str, run: RunStore, gradient_cost: float | None) -> Optimizer:
    """Return the optimiser with which the run continues, stored or new, and return the run to its state."""
    state = run.state()
    if state is not None:
        optimizer = _restore_optimizer(objective, method, run, state)
    else:
        seed = int(run.attributes["seed"])
        optimizer = optimizer_class(method).on(objective, seed=seed) if isinstance(method, str) else method
        optimizer.attach(objective)
    run.rewind()
    if state is None:
        run.save(optimizer.state)  # what to go back to
    objective.prepare()
    if optimizer.needs_grad and run.gradient_cost is None:
        run.set_gradient_cost(gradient_cost or episode_cost(objective).ratio)
    return optimizer


def _restore_optimizer(
    objective: Objective, method: Optimizer | str, run: RunStore, state: dict[str, Any]
) -> Optimizer:
    """Return the stored optimiser of a run, of the class of `method`."""
    kind = optimizer_class(method) if isinstance(method, str) else type(method)
    if state.get("method") != kind.name:
        raise ValueError(
            f"{run.path} contains a run of {state.get('method')}, not of {kind.name}; use another folder for "
            f"{kind.name}"
        )
    try:
        return kind.from_state(objective, state)
    except Exception as error:  # whatever the method stumbles upon
        raise StoreError(
            f"{run.path} has no state of {kind.name} that can be continued ({type(error).__name__}: {error}); start "
            "the run again in another folder"
        ) from error


def _check(optimizer: Optimizer, count: int, *, grad: bool) -> None:
    if not count:
        raise ValueError(f"{optimizer.name} proposed no point; a proposal needs at least one")
    if grad and not optimizer.needs_grad:
        raise ValueError(f"{optimizer.name} requests gradients, so its class must set needs_grad = True")
