"""Searches in lockstep: all ask, their requests are computed together, and all are told.

A search is a generator. It yields a `Request` for everything it needs and is sent the `Answer`. Points of several
searches make one batch; computations run in parallel in worker processes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from ..landscapes.objective import Evaluation, Objective
from ..landscapes.sampling.memory import MemoryBound
from .processes import WorkerProcesses

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True, eq=False)
class Evaluate:
    """Request losses at points, shape (count, dim), and gradients if `grad`."""

    x: Float[Tensor, "count dim"]
    grad: bool

    @property
    def kind(self) -> tuple[str, int]:
        """What requests answered in one batch have in common; kinds are computed in this order."""
        return "evaluate", int(self.grad)

    def answer(self, objective: Objective, x: Float[Tensor, "batch dim"]) -> Callable[[slice], Any]:
        """Return a function that returns the results of some rows of `x`, of which this request is a part."""
        return objective.evaluate(x, grad=self.grad).rows

    def own(self, found: Evaluation) -> Evaluation:
        """Return the requested part of an evaluation, which can have gradients that were not requested."""
        return found if self.grad else found.without_gradients()


@dataclass(frozen=True, eq=False)
class Observe:
    """Request a policy's observations at points, shape (count, dim), before a decision."""

    x: Float[Tensor, "count dim"]
    decision: int

    @property
    def kind(self) -> tuple[str, int]:
        """What requests answered in one batch have in common; kinds are computed in this order."""
        return "observe", self.decision

    def answer(self, objective: Objective, x: Float[Tensor, "batch dim"]) -> Callable[[slice], Any]:
        """Return a function that returns the results of some rows of `x`, of which this request is a part."""
        return objective.observe(x, self.decision).__getitem__


@dataclass(frozen=True, eq=False)
class Compute:
    """Request the result of a function of a module, wherever it is computed."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]

    def result(self) -> tuple[Any, float]:
        """Return the result of the function, and its time in seconds."""
        began = time.perf_counter()
        found = self.function(*self.arguments)
        return found, time.perf_counter() - began


class Answer(NamedTuple):
    """The answer to a request; `now` [s] is the search's own clock.

    It runs while the search itself works, while something is computed for it, and for its share of each batch.
    """

    value: Any
    now: float


Request: TypeAlias = Evaluate | Observe | Compute
Result = TypeVar("Result")
Asking: TypeAlias = Generator[Request, Answer, Result]  # yields requests, and returns a result


def compute_drawing(random: np.random.Generator, function: Callable[..., Result], *arguments: Any) -> Asking[Result]:
    """Return what function(*arguments, random) returns; `random` draws the same numbers wherever it is computed."""
    (result, state), _ = yield Compute(_draw, (random, function, arguments))
    random.bit_generator.state = state
    found: Result = result
    return found


def _draw(
    random: np.random.Generator, function: Callable[..., Result], arguments: tuple[Any, ...]
) -> tuple[Result, Any]:
    result = function(*arguments, random)
    return result, random.bit_generator.state


class Lockstep:
    """Run searches of an objective, whose rows must not depend on their batch.

    Computations are spread over `workers` processes, which start at the first request; with one worker they run here.
    Results are the same to the last bit. `computed` counts the seconds that they took.
    """

    def __init__(self, objective: Objective, *, workers: int = 1) -> None:
        self.objective, self.workers, self.computed = objective, workers, 0.0
        self._bound = MemoryBound(objective)

    def run(self, searches: Sequence[Asking[Any]]) -> list[Any]:
        """Return the result of each search. Any error of a search or of the objective ends all of them."""
        self._searches, self._clocks = searches, [0.0] * len(searches)
        self._asked: dict[int, Request] = {}
        self._results: dict[int, Any] = {}
        self._computing: dict[int, Callable[[], tuple[Any, float]]] = {}
        with WorkerProcesses(self.workers) as self._processes:
            for number in range(len(searches)):
                self._advance(number, None)
            while self._asked:
                self._compute()
                self._evaluate()
        return [self._results[number] for number in range(len(searches))]

    def _advance(self, number: int, answer: Answer | None) -> None:
        """Let a search continue to its next request, or to its end."""
        began = time.perf_counter()
        try:
            request = self._searches[number].send(answer)  # type: ignore[arg-type] # None starts it
        except StopIteration as end:
            self._results[number] = end.value
        else:
            self._asked[number] = request
            if isinstance(request, Compute):
                self._computing[number] = self._processes.submit(number, request.result)
        self._clocks[number] += time.perf_counter() - began

    def _answer(self, number: int, value: Any, seconds: float) -> None:
        del self._asked[number]
        self._clocks[number] += seconds
        self._advance(number, Answer(value, self._clocks[number]))

    def _compute(self) -> None:
        """Answer computations until none is requested."""
        while computing := sorted(self._computing):
            for number in computing:
                value, seconds = self._computing.pop(number)()
                self.computed += seconds
                self._answer(number, value, seconds)

    def _evaluate(self) -> None:
        """Answer requests to the objective, a batch for each kind, or losses with the gradients of others."""
        asked = {n: one for n, one in sorted(self._asked.items()) if not isinstance(one, Compute)}
        answers = dict[int, tuple[Any, float]]()
        for group in self._batches(asked):
            x, began = torch.cat([one.x for one in group.values()]), time.perf_counter()
            first = max(group.values(), key=lambda one: one.kind)  # which asks for gradients, if one does
            take, start = first.answer(self._bound, x), 0
            seconds = (time.perf_counter() - began) / len(x)
            for number, one in group.items():
                found = take(slice(start, start := start + len(one.x)))
                answers[number] = one.own(found) if isinstance(one, Evaluate) else found, seconds * len(one.x)
        for number in sorted(answers):
            self._answer(number, *answers[number])

    def _batches(self, asked: Mapping[int, Evaluate | Observe]) -> list[dict[int, Evaluate | Observe]]:
        """Return the requests of each batch: one kind, or on a GPU with free capacity all losses together.

        On such a GPU that saves a sequence of launches, and gradients that nobody requested take no extra time.
        """
        evaluated = [one for one in asked.values() if isinstance(one, Evaluate)]
        rows = sum(len(one.x) for one in evaluated)
        together = self.objective.device == "cuda" and rows <= self.objective.preferred_batch
        kinds = {
            number: one.kind[:1] if together and isinstance(one, Evaluate) else one.kind
            for number, one in asked.items()
        }
        return [
            {number: asked[number] for number, kind in kinds.items() if kind == one}
            for one in sorted(set(kinds.values()))
        ]


def answer_alone(asking: Asking[Result], objective: Objective | None) -> Result:
    """Return the result of a search that runs alone, its requests answered one by one."""
    answer: Any = None
    while True:
        try:
            request = asking.send(answer)
        except StopIteration as end:
            found: Result = end.value
            return found
        if isinstance(request, Compute):
            answer = Answer(*request.result())
        else:
            assert objective is not None  # as methods see to that look at episodes
            answer = Answer(request.answer(objective, request.x)(slice(None)), 0.0)
