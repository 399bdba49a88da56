"""What can be evaluated at a batch of points, and what an evaluation says."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .space import ParameterSpace


class Status(IntEnum):
    """Say how the evaluation of one point ended; a NaN result is not a missing one."""

    MISSING = 0
    OK = 1
    NONFINITE = 2
    ESCAPED = 3
    ERROR = 4


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Hold the result of evaluating a batch of points.

    `loss` [objective's unit], float64, shape (batch,); `grad` [loss unit / parameter unit], float64, shape
    (batch, dim), or None where it was not asked for; `status`, int8, shape (batch,). Where the status is not OK, loss
    and gradient are NaN.
    """

    loss: Float[Tensor, " batch"]
    grad: Float[Tensor, "batch dim"] | None
    status: Int[Tensor, " batch"]

    @classmethod
    def judged(
        cls,
        loss: Float[Tensor, " batch"],
        grad: Float[Tensor, "batch dim"] | None,
        failed: Int[Tensor, " batch"] | None = None,
    ) -> Evaluation:
        """Make an evaluation from raw results: mark non-finite rows, keep what `failed` says, blank every failure.

        `failed` holds a Status per row, OK where nothing is known to have gone wrong.
        """
        status = (
            torch.full(loss.shape, Status.OK, dtype=torch.int8) if failed is None else failed.to(torch.int8).clone()
        )
        finite = loss.isfinite() if grad is None else loss.isfinite() & grad.isfinite().all(dim=1)
        status[(status == Status.OK) & ~finite] = Status.NONFINITE
        blank = status != Status.OK
        loss = loss.masked_fill(blank, torch.nan)
        grad = None if grad is None else grad.masked_fill(blank[:, None], torch.nan)
        return cls(loss, grad, status)

    @classmethod
    def empty(cls, dim: int, *, grad: bool) -> Evaluation:
        """Return the evaluation of no points at all."""
        loss = torch.zeros(0, dtype=torch.float64)
        return cls.judged(loss, loss.new_zeros(0, dim) if grad else None)


@runtime_checkable
class Objective(Protocol):
    """Anything with a parameter space that can be evaluated at a batch of points."""

    @property
    def space(self) -> ParameterSpace:
        """The parameters and their box."""

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked, at points `x` in the parameters' own units."""


def evaluated(objective: Objective, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
    """Evaluate an objective, hold the result against the protocol, and blank every failure."""
    raw = objective.evaluate(x, grad=grad)
    who, count = name_of(objective), len(x)
    wanted: dict[str, tuple[Tensor, tuple[int, ...]]] = {"loss": (raw.loss, (count,)), "status": (raw.status, (count,))}
    if grad:
        wanted["grad"] = (_present(raw.grad, who), tuple(x.shape))
    for field, (tensor, shape) in wanted.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(
                f"{who} must return {field} of shape {shape} for x of shape {tuple(x.shape)}; got {tuple(tensor.shape)}"
            )
    if bool((raw.status == Status.MISSING).any()):
        raise ValueError(f"{who} must say how every point ended; got status MISSING")
    loss, status = (tensor.detach().cpu() for tensor in (raw.loss, raw.status))
    gradient = wanted["grad"][0].detach().cpu().double() if grad else None
    return Evaluation.judged(loss.double(), gradient, status)


def name_of(objective: Objective) -> str:
    """Return what an objective is called."""
    return str(getattr(objective, "name", type(objective).__name__))


def _present(grad: Tensor | None, who: str) -> Tensor:
    if grad is None:
        raise ValueError(
            f"{who} was asked for gradients and returned none; sample with grad=False (--no-gradients), "
            "or search with a method that needs none"
        )
    return grad
