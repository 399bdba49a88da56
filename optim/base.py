"""Ask/tell optimisation inside a parameter space's box."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from enum import IntEnum
from functools import partial
from typing import Any, ClassVar, Self, final

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..landscapes.capacity import Need, require
from ..landscapes.objective import Evaluation, Objective
from ..landscapes.options import NoOptions as NoOptions
from ..landscapes.space import ParameterSpace, as_whole
from .lockstep import Asking, answer_alone
from .memory import FLOAT, SearchSize

Points = NDArray[np.float64]
COMMON = {  # attributes of every optimiser
    *("space", "seed", "options", "random", "worst", "objective", "needs_grad", "remark", "_told_any"),
}


LARGE = 1e100  # a loss: the squares of a billion of them still have a sum


class Kind(IntEnum):
    """Say what a point was evaluated for."""

    RANDOM = 0
    POPULATION = 1
    DESCENT = 2
    ACQUISITION = 3
    POLICY = 4
    MEASUREMENT = 5


@dataclass(frozen=True, eq=False)
class Proposal:
    """Points to evaluate next: `x` in the parameters' units, shape (count, dim), and whether gradients are needed."""

    x: Float[Tensor, "count dim"]
    kind: Kind
    grad: bool = False


class Part:
    """A part of an optimiser whose attributes are data, except its `options`."""

    def state(self) -> dict[str, Any]:
        """Return its present state, as data."""
        return {name: value for name, value in vars(self).items() if name != "options"}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a result of `state`. Raises ValueError for an unknown attribute."""
        for name, value in state.items():
            if name not in vars(self):
                raise ValueError(f"{name} is no attribute of a {type(self).__name__}")
            setattr(self, name, value)


class Optimizer(abc.ABC):
    """Search a box for the least loss: `ask` for points, evaluate them, `tell` the results, and repeat.

    A new method derives from this class. Its hooks use the box scaled to [-1, 1] in every dimension, as numpy arrays.
    `_ask` proposes points. `_tell` takes their losses (+inf where an episode failed) and, if requested, gradients with
    respect to the scaled parameters. These are zero where an episode failed, and NaN where it has a loss but no
    gradient. All random numbers come from `self.random`, so a seed decides everything.

    Between `tell` and `ask` an optimiser is its `state`: `from_state` continues it bit for bit. That works by itself if
    the attributes of a method are numbers, strings, arrays, lists and mappings of them, or parts (`Part`) made in
    `_setup`. Any other method converts its data in `_state` and `_restore`.
    """

    name: ClassVar[str]
    method_version: ClassVar[int] = 1  # raised by hand when other points are asked for of the same seed
    Options: ClassVar[type[Any]]  # a frozen dataclass: every unstated choice with its default
    needs_grad: bool = False  # `_setup` may set it by the options

    def __init__(self, space: ParameterSpace, *, seed: int = 0, options: Any = None) -> None:
        self.space, self.seed = space, as_whole(seed, f"the seed of {self.name}")
        self.options = self.Options() if options is None else options
        self.random = np.random.default_rng(seed)
        self.worst = 0.0  # the largest finite loss so far
        self.remark = ""  # what it has to say of this search, which the run keeps
        self._told_any = False
        self.objective: Objective | None = None
        self._setup()

    @classmethod
    def on(cls, objective: Objective, *, seed: int = 0, options: Any = None) -> Self:
        """Return the optimiser for an objective; most methods need only its box."""
        return cls(objective.space, seed=seed, options=options)

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate the largest memory of a search [bytes]; `options` has a value for each option of the method."""
        return 100 * FLOAT * size.dim

    @final
    @classmethod
    def require_memory(cls, options: Any, size: SearchSize) -> None:
        """Refuse options that need more memory than there is; `options` is the method's dataclass.

        The dimension is checked first, with the method's defaults, then one option after the other, so that the error
        names the setting that is too large. Raises TooLargeError.
        """
        known = asdict(type(options)())
        number = f"{cls.name}: number of parameters"
        require(number, size.dim, lambda dim: Need(cls.memory(known, replace(size, dim=dim))))
        for name, value in asdict(options).items():
            if type(value) is int and value > 0:
                require(f"{cls.name} option {name}", value, partial(cls._need_with, known, size, name))
            known[name] = value

    @classmethod
    def require_budget(cls, options: Any, budget: int) -> None:
        """Refuse a budget with which the method cannot search. Raises ValueError."""
        return

    @classmethod
    def _need_with(cls, options: Mapping[str, Any], size: SearchSize, option: str, value: int) -> Need:
        return Need(float(cls.memory({**options, option: value}, size)))

    def attach(self, objective: Objective) -> None:
        """Attach the objective, for methods that need more than its points; `search` calls it, also after a restart."""
        self.objective = objective

    @final
    def ask(self) -> Proposal:
        """Return the points to evaluate next, inside the box."""
        return answer_alone(self.asking(), self.objective)

    @final
    def asking(self) -> Asking[Proposal]:
        """Return the result of `ask`, after yielding the computations it needs."""
        found = self._ask()
        proposal = found if isinstance(found, Proposal) else (yield from found)
        unit = (proposal.x.clamp(-1.0, 1.0) + 1.0) / 2.0
        x = torch.clamp(self.space.from_unit(unit), self.space.lower, self.space.upper)
        return Proposal(x, proposal.kind, proposal.grad)

    @final
    def tell(self, x: Float[Tensor, "count dim"], evaluation: Evaluation) -> None:
        """Take the results at the requested points; `x` are all of them, in their order."""
        ok = evaluation.has_loss.numpy()
        loss = np.where(ok, evaluation.loss.numpy(), math.inf)
        if ok.any():
            highest = float(loss[ok].max())
            self.worst = max(self.worst, highest) if self._told_any else highest
            self._told_any = True
        half = ((self.space.upper - self.space.lower) / 2).numpy()
        grad = None if evaluation.grad is None else np.where(ok[:, None], evaluation.grad.numpy() * half, 0.0)
        self._tell((2.0 * self.space.to_unit(x) - 1.0).numpy(), loss, grad)

    @final
    def state(self) -> dict[str, Any]:
        """Return the complete state, as data that `optim.runs.store.encode` writes."""
        return {
            "method": self.name,
            "seed": self.seed,
            "options": asdict(self.options),
            "random": self.random.bit_generator.state,
            "worst": self.worst,
            "told": self._told_any,
            "own": self._state(),
        }

    @final
    @classmethod
    def from_state(cls, objective: Objective, state: Mapping[str, Any]) -> Self:
        """Return the optimiser with this state, attached to the objective.

        A state that does not fit raises KeyError, TypeError, ValueError or another error.
        """
        optimizer = cls.on(objective, seed=state["seed"], options=cls.Options(**state["options"]))
        optimizer.attach(objective)
        optimizer._restore(state["own"])
        optimizer.worst, optimizer._told_any = float(state["worst"]), bool(state["told"])
        optimizer.random.bit_generator.state = state["random"]  # last, since it may have drawn meanwhile
        return optimizer

    def penalise(self, loss: Points) -> Points:
        """Return losses for models that need finite numbers: a failure counts as the worst loss so far."""
        return np.where(np.isfinite(loss), loss, self.worst)

    def _setup(self) -> None:  # noqa: B027 -- nothing, for the simplest methods
        """Prepare the first `_ask`."""

    def _state(self) -> dict[str, Any]:
        """Return the state of the method itself; `self.random` is restored to its state after the last draw."""
        return {name: _to_data(value) for name, value in vars(self).items() if name not in COMMON}

    def _restore(self, own: Mapping[str, Any]) -> None:
        """Restore a result of `_state`, after `_setup` and `attach`; the random state is restored afterwards."""
        for name, value in own.items():
            if hasattr(type(self), name):
                raise ValueError(f"{name} is no attribute in the state of {self.name}")
            setattr(self, name, _from_data(value, getattr(self, name, None)))

    def learn(self, z: Points, loss: Points) -> None:  # noqa: B027 -- nothing, for a method that remembers nothing
        """Take points of the scaled box that were evaluated before the search; at least one has a loss.

        Their shapes are (count, dim) and (count,); losses are +inf where an episode failed. A descent starts at the
        best of them, a model takes all of them.
        """

    @abc.abstractmethod
    def _ask(self) -> Proposal | Asking[Proposal]:
        """Propose points of the scaled box; points outside it are moved to its border before evaluation.

        A generator can yield requests before it returns the proposal: heavy computations, and observations of episodes.
        """

    @abc.abstractmethod
    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        """Take points as evaluated, with shapes (count, dim), (count,) and (count, dim)."""


def _to_data(value: Any) -> Any:
    """Return the state of a part, or of each part in a list, and any other value unchanged."""
    if isinstance(value, list):
        return [_to_data(one) for one in value]
    return value.state() if isinstance(value, Part) else value


def _from_data(data: Any, now: Any) -> Any:
    """Return the original of a result of `_to_data`; `now` are the parts to restore, if any."""
    if isinstance(now, Part):
        now.restore(data)
        return now
    if isinstance(now, list) and any(isinstance(one, Part) for one in now):
        return [_from_data(*pair) for pair in zip(data, now, strict=True)]
    return data


def tame(loss: Points) -> Points:
    """Return finite losses, divided by a common power of two if their sum of squares would overflow."""
    largest = float(np.abs(loss).max())
    return loss if largest < LARGE else np.ldexp(loss, -int(np.frexp(largest)[1]))
