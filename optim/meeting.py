"""A meeting of threads: what each asks of an objective is answered together, in one batch."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from ..landscapes.objective import Evaluation, Objective, ObjectiveWrapper
from ..landscapes.sampling.memory import MemoryBound
from .turns import Turns, aside

Key = tuple[str, int]  # what is asked, and of which kind
T = TypeVar("T")


class MeetingEnded(Exception):  # noqa: N818 -- no error: it ends those who still wait
    """End a thread that waits for an answer, because the meeting has come to its end."""


@dataclass(eq=False)
class _Question:
    """What a member asks, and what it gets: an answer, and its share of the seconds that the batch took.

    Each member waits for its own question to be `settled`: one condition for all would wake all at every question.
    """

    key: Key
    x: Float[Tensor, "count dim"]
    answer: Any = None
    seconds: float = 0.0
    settled: threading.Event = field(default_factory=threading.Event)


class Meeting(ObjectiveWrapper):
    """An objective for several threads, each of which asks for a few points at a time and waits for the answer.

    Once all `members` wait, the thread that calls `serve` answers them: it evaluates the points of all who want the
    same in one batch, in the order of the members' numbers, given an objective whose rows do not depend on their batch.
    So the objective itself is only ever used by that thread. A member says by `seat` who it is, and leaves when it has
    ended. Between its questions it works while the others wait.
    """

    def __init__(self, objective: Objective, members: int) -> None:
        super().__init__(objective)
        self._bound = MemoryBound(objective)
        self._present = members
        self._questions: dict[int, _Question] = {}
        self._own = threading.local()  # of each thread: its number, and how long it has waited for answers [s]
        self._turns = Turns()
        self._ended = False
        self._changed = threading.Condition()  # on which the thread that serves waits

    def seat(self, number: int) -> None:
        """Give the thread that calls this its number, by which points are ordered in a batch, and its first turn."""
        self._own.number, self._own.waited = number, 0.0
        self._turns.take()

    def leave(self) -> None:
        """Take the thread that calls this out of the meeting: nobody waits for it any more."""
        self._turns.give()
        with self._changed:
            self._present -= 1
            self._changed.notify_all()

    def end(self) -> None:
        """End the meeting: who waits for an answer, or asks again, gets `MeetingEnded`."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
            self._settle()

    def clock(self) -> float:
        """Return a time [s] that passes while the calling thread works, and by its share of what a batch takes."""
        return time.perf_counter() - float(self._own.waited) - self._turns.waited

    def prepare(self) -> None:
        """Do nothing: the thread that serves has prepared the objective."""

    def evaluate(self, x: Float[Tensor, "count dim"], *, grad: bool = True) -> Evaluation:
        """Wait until all members ask, and return losses, and gradients if asked, at points `x` of this one."""
        found: Evaluation = self._ask(("evaluate", int(grad)), x)
        return found

    def observe(self, x: Float[Tensor, "count dim"], decision: int) -> Tensor:
        """Wait until all members ask, and return what a policy sees before a decision, of an objective that says it."""
        found: Tensor = self._ask(("observe", decision), x)
        return found

    def serve(self) -> None:
        """Answer until all members have left, or one has ended the meeting.

        What the objective raises ends it, and an interrupt does, too.
        """
        try:
            while self._wait_for_all():
                for key in sorted({one.key for one in self._questions.values()}):
                    self._answer(key)
                with self._changed:
                    self._settle()
        finally:
            self.end()

    def _settle(self) -> None:
        """Let go all who wait; the lock is held."""
        settled = list(self._questions.values())
        self._questions.clear()
        for question in settled:
            question.settled.set()

    def _wait_for_all(self) -> bool:
        """Wait until every member asks; say whether there is anyone to answer."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or len(self._questions) == self._present)
            return not self._ended and self._present > 0

    def _answer(self, key: Key) -> None:
        asked = [self._questions[number] for number in sorted(self._questions) if self._questions[number].key == key]
        x, began = torch.cat([one.x for one in asked]), time.perf_counter()
        what, kind = key
        simulated: Any = self._bound if what == "evaluate" else self.objective
        found = simulated.evaluate(x, grad=bool(kind)) if what == "evaluate" else simulated.observe(x, kind)
        each, start = (time.perf_counter() - began) / len(x), 0
        for one in asked:
            rows = slice(start, start := start + len(one.x))
            one.seconds = each * len(one.x)
            one.answer = found.rows(rows) if what == "evaluate" else found[rows]

    def _ask(self, key: Key, x: Float[Tensor, "count dim"]) -> Any:
        question, began = _Question(key, x), time.perf_counter()
        with self._changed:
            if self._ended:
                raise MeetingEnded
            self._questions[self._own.number] = question
            if len(self._questions) == self._present:
                self._changed.notify_all()
        with aside():
            question.settled.wait()
            self._own.waited += time.perf_counter() - began - question.seconds
        if question.answer is None:
            raise MeetingEnded
        return question.answer


def work_abreast(objective: Objective, tasks: Sequence[Callable[[Meeting], T]]) -> list[T]:
    """Return what each task returns, given a meeting to ask in the objective's place; each has a thread.

    The objective is only used by the thread that calls this. What a task or the objective raises ends them all.
    """
    meeting = Meeting(objective, len(tasks))

    def work(number: int) -> T:
        meeting.seat(number)
        try:
            return tasks[number](meeting)
        except BaseException:
            meeting.end()  # the others are not to go on without it
            raise
        finally:
            meeting.leave()

    with ThreadPoolExecutor(len(tasks)) as threads:
        futures = [threads.submit(work, number) for number in range(len(tasks))]
        meeting.serve()
    broken = [error for error in (future.exception() for future in futures) if error is not None]
    for error in broken:
        if not isinstance(error, MeetingEnded):
            raise error
    return [future.result() for future in futures]
