"""Ask/tell optimisation inside a parameter space's box."""

from __future__ import annotations

import abc
import math
import pickle
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, final

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..landscapes.objective import Evaluation, Objective, Status
from ..landscapes.space import ParameterSpace, whole

Points = NDArray[np.float64]


class Kind(IntEnum):
    """Say what a point was evaluated for."""

    RANDOM = 0
    POPULATION = 1
    DESCENT = 2
    ACQUISITION = 3
    POLICY = 4


@dataclass(frozen=True, eq=False)
class Proposal:
    """Points to evaluate next: `x` in the parameters' units, shape (count, dim), and whether gradients are needed."""

    x: Float[Tensor, "count dim"]
    kind: Kind
    grad: bool = False


@dataclass(frozen=True)
class NoOptions:
    """The options of a method that has none."""


class Optimizer(abc.ABC):
    """Search a box for the least loss: `ask` for points, evaluate them, `tell` what came out, and so on.

    A method is written by deriving from this class. Its hooks see the box scaled to [-1, 1] in every dimension, as
    numpy arrays: `_ask` proposes points there, `_tell` takes their losses (+inf where an episode failed) and, where it
    asked for them, gradients (zero where an episode failed) with respect to the scaled parameters. Randomness comes
    from `self.random` alone, so that a seed decides everything, and an optimiser can be pickled between `tell` and
    `ask`: what comes back goes on bit for bit.
    """

    name: ClassVar[str]
    Options: ClassVar[type[Any]]  # a frozen dataclass: every unstated choice with its default
    needs_grad: ClassVar[bool] = False

    def __init__(self, space: ParameterSpace, *, seed: int = 0, options: Any = None) -> None:
        self.space, self.seed = space, whole(seed, f"the seed of {self.name}")
        self.options = self.Options() if options is None else options
        self.random = np.random.default_rng(seed)
        self.worst = 0.0  # the largest finite loss so far
        self._told_any = False
        self._setup()

    @classmethod
    def on(cls, objective: Objective, *, seed: int = 0, options: Any = None) -> Optimizer:
        """Return the optimiser for an objective, of which most methods need no more than its box."""
        return cls(objective.space, seed=seed, options=options)

    def attach(self, objective: Objective) -> None:  # noqa: B027 -- most methods need no more than its box
        """Take the objective in hand, for methods that ask it for more; `search` calls it, after a restart too."""

    @final
    def ask(self) -> Proposal:
        """Return the points to evaluate next, inside the box."""
        proposal = self._ask()
        unit = (proposal.x.clamp(-1.0, 1.0) + 1.0) / 2.0
        x = torch.clamp(self.space.from_unit(unit), self.space.lower, self.space.upper)
        return Proposal(x, proposal.kind, proposal.grad)

    @final
    def tell(self, x: Float[Tensor, "count dim"], evaluation: Evaluation) -> None:
        """Take what the points that were asked for came out as; `x` are all of them, in their order."""
        ok = (evaluation.status == Status.OK).numpy()
        loss = np.where(ok, evaluation.loss.numpy(), math.inf)
        if ok.any():
            highest = float(loss[ok].max())
            self.worst = max(self.worst, highest) if self._told_any else highest
            self._told_any = True
        half = ((self.space.upper - self.space.lower) / 2).numpy()
        grad = None if evaluation.grad is None else np.where(ok[:, None], evaluation.grad.numpy() * half, 0.0)
        z = (2.0 * self.space.to_unit(x) - 1.0).numpy()
        self._tell(z, loss, grad)

    @final
    def state(self) -> bytes:
        """Return all there is to go on from."""
        return pickle.dumps(self)

    def penalised(self, loss: Points) -> Points:
        """Return losses for models that take finite numbers only: a failure counts as the worst loss so far."""
        return np.where(np.isfinite(loss), loss, self.worst)

    def _setup(self) -> None:  # noqa: B027 -- nothing, for the simplest methods
        """Prepare the first `_ask`."""

    @abc.abstractmethod
    def _ask(self) -> Proposal:
        """Propose points of the scaled box; those beyond it are moved to its border before they are evaluated."""

    @abc.abstractmethod
    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        """Take in points as they were evaluated, with shapes (count, dim), (count,) and (count, dim)."""


def restored(state: bytes) -> Optimizer:
    """Return the optimiser whose `state` was kept; only of a run of one's own, since unpickling runs what it says."""
    try:
        found = pickle.loads(state)
    except (AttributeError, EOFError, ImportError, pickle.UnpicklingError) as error:
        raise ValueError(f"the kept state of the optimiser cannot be read ({error}); begin the run anew") from error
    if not isinstance(found, Optimizer):
        raise ValueError(f"the kept state is that of a {type(found).__name__}, not of an optimiser; begin the run anew")
    return found
