"""Bayesian optimisation, alone and followed by gradient descents."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from ..base import Kind, Optimizer, Points, Proposal
from ..lockstep import Asking
from ..memory import SearchSize
from ..options import MethodOptions
from .descent import Descent, DescentOptions
from .surrogate import Surrogate, SurrogateOptions, surrogate_memory


class BO(Optimizer):
    """Evaluate where the lower confidence bound of a Gaussian process over all losses so far is least.

    One point at a time, without gradients. The first `initial` are drawn at random: a process without data is the same
    everywhere. The process is written here, since BoTorch's takes five times as long and finds no more.
    """

    name = "bo"
    Options: ClassVar[type[MethodOptions]] = SurrogateOptions
    surrogate: Surrogate

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate what the process takes [bytes]."""
        return surrogate_memory(options["max_points"], size)

    def _setup(self) -> None:
        self.surrogate = Surrogate(self.space.dim, self.options)

    def _ask(self) -> Asking[Proposal]:
        kind = Kind.ACQUISITION if self.surrogate.informed else Kind.RANDOM
        z = yield from self.surrogate.minimise(self.random)
        return Proposal(torch.from_numpy(z[None]), kind, grad=self.needs_grad)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        self.surrogate.add(z, loss)

    def _inform(self, z: Points, loss: Points, grad: Points | None) -> None:
        self.surrogate.add(z, loss)


@dataclass(frozen=True)
class BODescentsOptions(SurrogateOptions, DescentOptions):
    """The options of the process and of each descent."""

    method = "bo-descents"


class BODescents(Optimizer):
    """Descend from where the lower confidence bound is least; the process learns the loss of every iterate.

    The first starts are drawn at random. Gradients steer the descents only: the process sees losses.
    """

    name = "bo-descents"
    Options = BODescentsOptions
    needs_grad = True

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate what the process takes [bytes]."""
        return surrogate_memory(options["max_points"], size)

    def _setup(self) -> None:
        self.surrogate = Surrogate(self.space.dim, self.options)
        self.descent = Descent(np.zeros(self.space.dim), self.options, done=True)

    def _ask(self) -> Asking[Proposal]:
        kind = Kind.DESCENT
        if self.descent.done:
            kind = Kind.ACQUISITION if self.surrogate.informed else Kind.RANDOM
            self.descent = Descent((yield from self.surrogate.minimise(self.random)), self.options)
        return Proposal(torch.from_numpy(self.descent.at[None]), kind, grad=True)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        assert grad is not None  # as asked
        self.surrogate.add(z, loss)
        self.descent.tell(float(loss[0]), grad[0])

    def _inform(self, z: Points, loss: Points, grad: Points | None) -> None:
        self.surrogate.add(z, loss)
