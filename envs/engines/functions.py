"""What objectives of functions in other libraries have in common: they take a batch a part at a time."""

from __future__ import annotations

import abc
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes.adapters import check_points
from ...landscapes.objective import Evaluation
from ...landscapes.space import ParameterSpace

ROWS = 256  # at most in one call, unless said otherwise


@dataclass(eq=False)
class FunctionObjective(abc.ABC):
    """An objective of a function that computes in a `precision`, with `preferred_batch` points in one call at most."""

    fn: Callable[[Any], Any]
    space: ParameterSpace
    name: str
    loss_unit: str
    precision: str
    preferred_batch: int

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked, at points `x` in the parameters' own units."""
        x = check_points(x, self.space, self.name)
        parts = [self._evaluate(part, grad=grad) for part in torch.split(x, self.preferred_batch) if len(part)]
        return Evaluation.join(parts, dim=self.space.dim, grad=grad)

    @abc.abstractmethod
    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        """Evaluate at least one point, and no more than are in one call."""
