"""A search that first measures the landscape, then uses the method advised for such landscapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from ...landscapes.measures.character import MIN_EVALUATIONS, CharacterSample
from ...landscapes.objective import Objective
from ..advice import EVALUATIONS, choose, raced_methods
from ..base import Kind, Optimizer, Points, Proposal
from ..lockstep import Asking
from ..memory import FLOAT, SearchSize
from ..options import MANY, MethodOptions, number
from ..registry import optimizer_class

TABLES = 40  # of points x points, that measures make


@dataclass(frozen=True)
class AutoOptions(MethodOptions):
    """`evaluations` measure the landscape before a method is chosen, a quarter of them with gradients.

    The cases behind the advice were measured with the default number.
    """

    method = "auto"

    evaluations: int = number(EVALUATIONS, MIN_EVALUATIONS, MANY)


class Auto(Optimizer):
    """Measure the landscape, then search with the method that `landscape advise` would advise.

    The measurements count as episodes, and the method begins with them: a descent at the best point, a model with all
    points. The run reports the chosen method, and the reason, as its `remark`. Measuring may take at most a tenth of
    the budget; a smaller budget is refused.
    """

    name = "auto"
    Options: ClassVar[type[Any]] = AutoOptions
    needs_grad = True

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate the memory of the measured points, and of tables of their distances [bytes]."""
        return float(FLOAT * options["evaluations"] * (TABLES * options["evaluations"] + 10 * size.dim))

    @classmethod
    def require_budget(cls, options: Any, budget: int) -> None:
        """Refuse a budget of which measuring would take more than a tenth."""
        if budget < 10 * options.evaluations:
            lower = f"or --option evaluations={budget // 10}" if budget >= 10 * MIN_EVALUATIONS else "or name a method"
            raise ValueError(
                f"auto first measures {options.evaluations} episodes, at most a tenth of the budget; got a budget of "
                f"{budget}: use {10 * options.evaluations} or more, {lower}"
            )

    def _setup(self) -> None:
        self.inner: Optimizer | None = None
        self.loss: Points = np.empty(0)
        self.slopes: Points = np.empty((0, self.space.dim))

    def attach(self, objective: Objective) -> None:
        """Attach the objective, also for the chosen method."""
        super().attach(objective)
        if self.inner is not None:
            self.inner.attach(objective)

    @property
    def _sample(self) -> CharacterSample:
        return CharacterSample(self.space.dim, self.options.evaluations, self.seed)

    def _ask(self) -> Proposal | Asking[Proposal]:
        if self.inner is not None:
            return self.inner._ask()
        grad = not len(self.loss)
        unit = self._sample.first if grad else self._sample.others(self.slopes)
        return Proposal(torch.from_numpy(2.0 * unit - 1.0), Kind.MEASUREMENT, grad=grad)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        if self.inner is not None:
            self.inner.worst, self.inner._told_any = self.worst, self._told_any
            self.inner._tell(z, loss, grad)
        elif grad is not None:
            self.loss, self.slopes = loss, 2.0 * grad  # by sides of the box
        else:
            self._choose(z, loss)

    def _choose(self, z: Points, others: Points) -> None:
        sample, able = self._sample, list(raced_methods())
        character = sample.measure(self.loss, self.slopes, others)
        while self.inner is None:
            found = choose(character, able)
            try:
                self.inner = self._begin(found.method)
            except ValueError:  # it cannot search such a space, or not here
                able.remove(found.method)
        self.remark = f"auto chose {found.method}: {found.reason}"
        loss = np.concatenate([self.loss, others])
        if np.isfinite(loss).any():
            self.inner.learn(np.concatenate([2.0 * sample.first - 1.0, z]), loss)

    def _begin(self, method: str) -> Optimizer:
        kind = optimizer_class(method)
        kind.require_memory(kind.Options(), SearchSize(self.space.dim))
        if self.objective is None:
            return kind(self.space, seed=self.seed)
        made = kind.on(self.objective, seed=self.seed)
        made.attach(self.objective)
        return made

    def _state(self) -> dict[str, Any]:
        own = {"loss": self.loss, "slopes": self.slopes, "remark": self.remark}
        return own | {"inner": None if self.inner is None else self.inner.state()}

    def _restore(self, own: Mapping[str, Any]) -> None:
        self.loss, self.slopes, self.remark = own["loss"], own["slopes"], own["remark"]
        if (inner := own["inner"]) is not None:
            kind = optimizer_class(inner["method"])
            assert self.objective is not None  # as from_state attaches it
            self.inner = kind.from_state(self.objective, inner)
