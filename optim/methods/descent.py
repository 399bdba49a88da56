"""Gradient descent: one descent as a state machine, and a search by descents from random starts."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from ..base import Kind, Optimizer, Part, Points, Proposal
from ..memory import FLOAT, SearchSize
from ..options import LIBRARY, MANY, PAPER, MethodOptions, number


@dataclass(frozen=True)
class DescentOptions(MethodOptions):
    """How a descent moves in the box scaled to [-1, 1], and when it ends.

    `step` [scaled parameter^2 / loss unit] multiplies the gradient. A move whose largest component exceeds `max_step`
    is shortened to it; smaller moves are unchanged. Both shrink by the factor `shrink` whenever the loss has risen (1:
    never). Otherwise one step could not suit scenes whose gradients differ by a factor of a thousand. A descent ends
    after `steps` iterates, or when the loss has failed more than `patience` times in a row to fall below the best so
    far by `tolerance`, a fraction of it.
    """

    method = "a descent"

    step: float = number(1.0, 1e-300, 1e300)
    max_step: float = number(0.2, 1e-12, 1000)
    shrink: float = number(0.5, 1e-12, 1)
    steps: int = number(20, 1, MANY)
    patience: int = number(3, 0, MANY, PAPER)
    tolerance: float = number(1e-4, 0, 1)


def lacks(grad: Points) -> bool:
    """Whether a point with a loss has no gradient."""
    return bool(np.isnan(grad).any())


class Descending(Part, ABC):
    """A descent in the scaled box: `at` is the next iterate to evaluate, until `done`; `best` is the lowest loss.

    By its options it ends after `steps` iterates, or after more than `patience` in a row that have not lowered the best
    loss by `tolerance`, a fraction of it. An iterate without a gradient (NaN) ends it, because no direction is known.
    """

    def __init__(self, start: Points, options: Any, *, done: bool = False) -> None:
        self.options = options
        self.at = np.clip(start, -1.0, 1.0)
        self.best, self.done = math.inf, done
        self._evaluated = self._stalled = 0

    @abstractmethod
    def tell(self, loss: float, grad: Points) -> None:
        """Take the iterate's loss, +inf where the episode failed, and gradient, shape (dim,); move on or end."""

    def _ends_with(self, loss: float) -> bool:
        """Count an iterate with this loss; return whether it is the last."""
        self._evaluated += 1
        improved = math.isinf(self.best) or loss < self.best - self.options.tolerance * abs(self.best)
        self._stalled = 0 if improved else self._stalled + 1
        self.best = min(self.best, loss)
        return bool(self._stalled > self.options.patience or self._evaluated >= self.options.steps)


class Descent(Descending):
    """Follow gradients from `start`, by steps along them.

    Every iterate is evaluated once, and both its loss and its gradient are used. The one that ends the descent stays in
    `at`, even without a gradient. If its episode failed, the previous one stays, the last with a loss.
    """

    def __init__(self, start: Points, options: DescentOptions, *, done: bool = False) -> None:
        super().__init__(start, options, done=done)
        self._last, self._last_loss = self.at, math.inf
        self._scale = 1.0

    def tell(self, loss: float, grad: Points) -> None:
        """Take in the iterate's loss, +inf where the episode failed, and gradient, shape (dim,); move on or end."""
        if not math.isfinite(loss):
            self.at, self.done = self._last, True
            return
        last = self._ends_with(loss)
        if lacks(grad):
            self.done = True
            return
        self._scale *= self.options.shrink if loss > self._last_loss else 1.0
        moved = self._move(grad)
        self.done = last or np.array_equal(moved, self.at)  # at a stationary point, or pushed against the border
        if not self.done:
            self._last, self._last_loss, self.at = self.at, loss, moved

    def _move(self, grad: Points) -> Points:
        """Return z - step * gradient, kept inside the box."""
        with np.errstate(over="ignore"):
            move = -self.options.step * grad
            excess = float(np.abs(move).max()) / self.options.max_step
        if not math.isfinite(excess):  # too long to be counted: its direction is all that matters
            finite = np.nan_to_num(grad)
            move, excess = -self.options.max_step * (finite / np.abs(finite).max()), 1.0
        return np.asarray(np.clip(self.at + self._scale * move / max(excess, 1.0), -1.0, 1.0))


@dataclass(frozen=True)
class DescentsOptions(DescentOptions):
    """`batch_size` descents are evaluated as one batch; 1 runs them one after the other."""

    method = "descents"

    batch_size: int = number(4, 1, 10_000)


class Descents(Optimizer):
    """Descend from uniformly random starts; where one descent ends the next begins, until the budget is spent."""

    name = "descents"
    Options: ClassVar[type[Any]] = DescentsOptions
    Descent: ClassVar[type[Any]] = Descent
    held: ClassVar[int] = 1000  # by a descent of no parameters [bytes]
    needs_grad = True

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate the memory of the descents of a batch [bytes]."""
        return float(options["batch_size"] * (cls.held + 20 * FLOAT * size.dim))

    def _setup(self) -> None:
        self.descents = [self._begin() for _ in range(self.options.batch_size)]

    def _ask(self) -> Proposal:
        return Proposal(torch.from_numpy(np.stack([one.at for one in self.descents])), Kind.DESCENT, grad=True)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        assert grad is not None  # as asked
        for descent, one_loss, one_grad in zip(self.descents, loss, grad, strict=True):
            descent.tell(float(one_loss), one_grad)
        self.descents = [self._begin() if one.done else one for one in self.descents]

    def learn(self, z: Points, loss: Points) -> None:
        """Begin the first descents at the best points."""
        best = z[np.argsort(loss, kind="stable")[: len(self.descents)]]
        self.descents[: len(best)] = [self.Descent(start, self.options) for start in best]

    def _begin(self) -> Descending:
        descent: Descending = self.Descent(self.random.uniform(-1.0, 1.0, self.space.dim), self.options)
        return descent


@dataclass(frozen=True)
class AdamOptions(MethodOptions):
    """How a descent moves in the box scaled to [-1, 1], and when it ends.

    `rate` is the learning rate, about the size of the first steps in each parameter. `beta1` and `beta2` set how slowly
    the means of gradients and of their squares forget (torch's defaults). A descent ends after `steps` iterates, or
    when the loss has failed more than `patience` times in a row to fall below the best so far by `tolerance`, a
    fraction of it. `batch_size` descents are evaluated as one batch.
    """

    method = "adam"

    rate: float = number(0.05, 1e-12, 1000)
    beta1: float = number(0.9, 0, 0.999999, LIBRARY.format("torch"))
    beta2: float = number(0.999, 0, 0.999999, LIBRARY.format("torch"))
    steps: int = number(100, 1, MANY)
    patience: int = number(20, 0, MANY)
    tolerance: float = number(1e-4, 0, 1)
    batch_size: int = number(4, 1, 10_000)


class AdamDescent(Descending):
    """Follow gradients by torch's Adam from `start`, inside the box, until an episode fails or has no gradient."""

    def __init__(self, start: Points, options: AdamOptions) -> None:
        super().__init__(start, options)
        self._z = torch.from_numpy(self.at.copy())
        self._adam = torch.optim.Adam([self._z], lr=options.rate, betas=(options.beta1, options.beta2), foreach=False)

    def tell(self, loss: float, grad: Points) -> None:
        """Take in the iterate's loss, +inf where the episode failed, and gradient, shape (dim,); move on or end."""
        if not math.isfinite(loss):
            self.done = True
            return
        self.done = self._ends_with(loss) or lacks(grad)
        if lacks(grad):
            return
        self._z.grad = torch.from_numpy(np.nan_to_num(grad))
        self._adam.step()
        self.at = self._z.clamp_(-1.0, 1.0).numpy().copy()

    def state(self) -> dict[str, Any]:
        """Return the state of the descent, as data."""
        moments = {name: value.numpy() for name, value in self._adam.state[self._z].items()}
        kept = {name: value for name, value in super().state().items() if name not in ("_z", "_adam")}
        return kept | {"moments": moments}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a result of `state`."""
        super().restore({name: value for name, value in state.items() if name != "moments"})
        self._z.copy_(torch.from_numpy(self.at))
        if state["moments"]:
            self._adam.state[self._z] = {
                name: torch.from_numpy(np.array(value)) for name, value in state["moments"].items()
            }


class Adam(Descents):
    """Descend by torch's Adam from uniformly random starts; where one descent ends the next begins."""

    name = "adam"
    Options = AdamOptions
    Descent = AdamDescent
    held = 10_000
