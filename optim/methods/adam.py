"""Adam from random starts, by torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from ..base import Kind, Optimizer, Points, Proposal
from ..memory import FLOAT, SearchSize
from ..options import MANY, MethodOptions, number


@dataclass(frozen=True)
class AdamOptions(MethodOptions):
    """How a descent moves in the box scaled to [-1, 1], and when it ends.

    `rate` is the learning rate, about what a parameter moves by in a step at first; `beta1` and `beta2` say how slowly
    the means of gradients and of their squares forget (torch's defaults). A descent ends after `steps` iterates, or
    when the loss has failed more than `patience` times in a row to fall below the best so far by `tolerance`, a
    fraction of it. `batch_size` descents are evaluated as one batch.
    """

    method = "adam"

    rate: float = number(0.05, 1e-12, 1000)
    beta1: float = number(0.9, 0, 0.999999)
    beta2: float = number(0.999, 0, 0.999999)
    steps: int = number(100, 1, MANY)
    patience: int = number(20, 0, MANY)
    tolerance: float = number(1e-4, 0, 1)
    batch_size: int = number(4, 1, 10_000)


class AdamDescent:
    """Follow gradients by torch's Adam from `start`: `at` is the iterate to evaluate next, until `done`.

    It stays inside the box. A failed episode ends it.
    """

    def __init__(self, start: Points, options: AdamOptions) -> None:
        self.options = options
        self._z = torch.from_numpy(start.copy())
        self._adam = torch.optim.Adam([self._z], lr=options.rate, betas=(options.beta1, options.beta2), foreach=False)
        self.best, self.done = math.inf, False
        self._evaluated = self._stalled = 0

    @property
    def at(self) -> Points:
        """The iterate to evaluate next, shape (dim,)."""
        return np.asarray(self._z.numpy().copy())

    def tell(self, loss: float, grad: Points) -> None:
        """Take in the iterate's loss, +inf where the episode failed, and gradient, shape (dim,); move on or end."""
        if not math.isfinite(loss):
            self.done = True
            return
        self._evaluated += 1
        improved = math.isinf(self.best) or loss < self.best - self.options.tolerance * abs(self.best)
        self._stalled = 0 if improved else self._stalled + 1
        self.best = min(self.best, loss)
        self._z.grad = torch.from_numpy(np.nan_to_num(grad))
        self._adam.step()
        self._z.clamp_(-1.0, 1.0)
        self.done = self._stalled > self.options.patience or self._evaluated >= self.options.steps

    def state(self) -> dict[str, Any]:
        """Return where the descent stands, as data."""
        moments = {name: value.numpy() for name, value in self._adam.state[self._z].items()}
        numbers = {"best": self.best, "done": self.done, "evaluated": self._evaluated, "stalled": self._stalled}
        return {"at": self.at, "moments": moments, **numbers}

    @classmethod
    def from_state(cls, state: Mapping[str, Any], options: AdamOptions) -> AdamDescent:
        """Return the descent that had this state."""
        descent = cls(state["at"], options)
        moments = {name: torch.from_numpy(np.array(value)) for name, value in state["moments"].items()}
        if moments:
            descent._adam.state[descent._z] = moments
        descent.best, descent.done = float(state["best"]), bool(state["done"])
        descent._evaluated, descent._stalled = int(state["evaluated"]), int(state["stalled"])
        return descent


class Adam(Optimizer):
    """Descend by torch's Adam from uniformly random starts; where one descent ends the next begins."""

    name = "adam"
    Options: ClassVar[type[AdamOptions]] = AdamOptions
    needs_grad = True

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate what the descents of a batch take [bytes]."""
        return float(options["batch_size"] * (10_000 + 20 * FLOAT * size.dim))

    def _setup(self) -> None:
        self.descents = [self._begin() for _ in range(self.options.batch_size)]

    def _ask(self) -> Proposal:
        return Proposal(torch.from_numpy(np.stack([one.at for one in self.descents])), Kind.DESCENT, grad=True)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        assert grad is not None  # as asked
        for descent, one_loss, one_grad in zip(self.descents, loss, grad, strict=True):
            descent.tell(float(one_loss), one_grad)
        self.descents = [self._begin() if one.done else one for one in self.descents]

    def _state(self) -> dict[str, Any]:
        return {"descents": [one.state() for one in self.descents]}

    def _restore(self, own: Mapping[str, Any]) -> None:
        self.descents = [AdamDescent.from_state(one, self.options) for one in own["descents"]]

    def _begin(self) -> AdamDescent:
        return AdamDescent(self.random.uniform(-1.0, 1.0, self.space.dim), self.options)
