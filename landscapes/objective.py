"""Objectives, which are evaluated at a batch of points, and the records of their results."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Protocol, overload, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .space import ParameterSpace, as_tensor

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    from numpy.typing import NDArray

ROUNDING = 1e-9  # of the box; points that are no farther beyond it are moved back


class Status(IntEnum):
    """Say how the evaluation of one point ended; a NaN result is not a missing one.

    INTERPOLATED is a point of a refined slice that was not evaluated, as those around it explain it: its loss is NaN.
    NO_GRADIENT has a finite loss, which is kept, and a gradient that is not finite and therefore NaN.
    """

    MISSING = 0
    OK = 1
    NONFINITE = 2
    ESCAPED = 3
    ERROR = 4
    INTERPOLATED = 5
    NO_GRADIENT = 6


NOT_EVALUATED = (Status.MISSING, Status.INTERPOLATED)
HAS_LOSS = (Status.OK, Status.NO_GRADIENT)
FAILED = (Status.NONFINITE, Status.ESCAPED, Status.ERROR)
LONGEST_ERROR = 200  # characters of a message that are shown


@overload
def has_loss(status: Tensor) -> Tensor: ...
@overload
def has_loss(status: xr.DataArray) -> xr.DataArray: ...
@overload
def has_loss(status: NDArray[Any]) -> NDArray[np.bool_]: ...
@overload
def has_loss(status: int) -> bool: ...
def has_loss(status: Any) -> Any:
    """Say which points have a finite loss; `status` is a tensor, an array or one Status."""
    return _is_any(status, HAS_LOSS)


@overload
def failed(status: Tensor) -> Tensor: ...
@overload
def failed(status: xr.DataArray) -> xr.DataArray: ...
@overload
def failed(status: NDArray[Any]) -> NDArray[np.bool_]: ...
@overload
def failed(status: int) -> bool: ...
def failed(status: Any) -> Any:
    """Say which points were evaluated and have no loss; `status` is a tensor, an array or one Status."""
    return _is_any(status, FAILED)


def describe_errors(count: int, first: str) -> str:
    """Say how many points raised and what the first of them said, in a line; nothing where none did."""
    if not count:
        return ""
    said = " ".join(first.split())
    shown = said if len(said) <= LONGEST_ERROR else f"{said[:LONGEST_ERROR]}..."
    return f"{count} point{'s' if count > 1 else ''} raised" + (f": first {shown!r}" if shown else "")


def _is_any(status: Any, kinds: tuple[Status, ...]) -> Any:
    found = status == kinds[0]
    for kind in kinds[1:]:
        found = found | (status == kind)
    return found


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Hold the result of evaluating a batch of points.

    `loss` [objective's unit], float64, shape (batch,); `grad` [loss unit / parameter unit], float64, shape
    (batch, dim), or None where it was not asked for; `status`, int8, shape (batch,). Where the status is not OK, the
    gradient is NaN, and so is the loss unless the status is NO_GRADIENT. `error` is what the first of the points with
    status ERROR raised. Arrays become tensors; raises ValueError for what is no real number, or no Status.
    """

    loss: Float[Tensor, " batch"]
    grad: Float[Tensor, "batch dim"] | None
    status: Int[Tensor, " batch"]
    error: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "loss", _real(self.loss, "a loss"))
        object.__setattr__(self, "grad", None if self.grad is None else _real(self.grad, "a gradient"))
        object.__setattr__(self, "status", _check_codes(self.status))

    @property
    def has_loss(self) -> Bool[Tensor, " batch"]:
        """Which points have a finite loss."""
        return has_loss(self.status)

    @property
    def has_gradient(self) -> Bool[Tensor, " batch"]:
        """Which points have a finite gradient; none where gradients were not asked for."""
        return (self.status == Status.OK) & (self.grad is not None)

    @property
    def failed(self) -> Bool[Tensor, " batch"]:
        """Which points have no loss."""
        return failed(self.status)

    @classmethod
    def from_results(
        cls,
        loss: Float[Tensor, " batch"],
        grad: Float[Tensor, "batch dim"] | None,
        failed: Int[Tensor, " batch"] | None = None,
        error: str = "",
    ) -> Evaluation:
        """Make an evaluation from raw results: mark non-finite rows, keep what `failed` says, blank what is missing.

        `failed` holds a Status per row, OK where nothing is known to have gone wrong. A row whose loss alone is finite
        keeps it and has status NO_GRADIENT; without gradients, none is missing, and its status is OK.

        Raises ValueError where results are no real numbers, or codes in `failed` mean no Status.
        """
        loss, grad = _real(loss, "a loss"), None if grad is None else _real(grad, "a gradient")
        status = torch.full(loss.shape, Status.OK, dtype=torch.int8)
        if failed is not None:
            status = _check_codes(failed).to(torch.int8).clone()
        there = has_loss(status)
        status[there & ~loss.isfinite()] = Status.NONFINITE
        loss = loss.masked_fill(~has_loss(status), torch.nan)
        if grad is None:
            status[status == Status.NO_GRADIENT] = Status.OK
            return cls(loss, None, status, error)
        status[(status == Status.OK) & ~grad.isfinite().all(dim=1)] = Status.NO_GRADIENT
        return cls(loss, grad.masked_fill((status != Status.OK)[:, None], torch.nan), status, error)

    judged = from_results  # its first name, which environments of others call it by

    @classmethod
    def join(cls, parts: Iterable[Evaluation], *, dim: int, grad: bool) -> Evaluation:
        """Return the evaluation of several batches, one after the other; of none, that of no points at all.

        Gradients are left out unless `grad` asks for them. Raises ValueError where a part has none of those asked for.
        """
        parts = list(parts)
        if not parts:
            return cls.empty(dim, grad=grad)
        slopes = [part.grad for part in parts if part.grad is not None] if grad else []
        if grad and len(slopes) < len(parts):
            raise ValueError(f"{len(parts) - len(slopes)} of {len(parts)} evaluations to join have no gradients")
        loss, status = torch.cat([part.loss for part in parts]), torch.cat([part.status for part in parts])
        error = next((part.error for part in parts if part.error), "")
        return cls(loss, torch.cat(slopes) if grad else None, status, error)

    def rows(self, rows: slice | Int[Tensor, " some"]) -> Evaluation:
        """Return the evaluation of some of the points; the error message stays with those that raised."""
        status = self.status[rows]
        error = self.error if bool((status == Status.ERROR).any()) else ""
        return Evaluation(self.loss[rows], None if self.grad is None else self.grad[rows], status, error)

    @classmethod
    def empty(cls, dim: int, *, grad: bool, error: str = "") -> Evaluation:
        """Return the evaluation of no points at all."""
        loss = torch.zeros(0, dtype=torch.float64)
        return cls.from_results(loss, loss.new_zeros(0, dim) if grad else None, error=error)


@runtime_checkable
class Objective(Protocol):
    """Anything with a parameter space that can be evaluated at a batch of points.

    It is never asked beyond its bounds unless it invites that by an attribute `beyond_box` that is true.
    """

    @property
    def space(self) -> ParameterSpace:
        """The parameters and their box."""

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked, at points `x` in the parameters' own units."""


def evaluate(objective: Objective, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
    """Evaluate an objective, hold the result against the protocol, and blank every failure.

    Points beyond its bounds have left the domain (status ESCAPED), unless the objective invites them.

    Raises ValueError where the objective's answer is not what the protocol says, and what it raises itself.
    """
    invited = getattr(objective, "beyond_box", False)
    raw = _ask(objective, x, grad=grad) if invited else evaluate_inside(objective, x, grad=grad)
    loss, status = (tensor.detach().cpu() for tensor in (raw.loss, raw.status))
    gradient = raw.grad.detach().cpu().double() if grad and raw.grad is not None else None
    return Evaluation.from_results(loss.double(), gradient, status, raw.error)


def evaluate_inside(objective: Objective, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
    """Evaluate an objective at those of the points that lie in its box; the others have left the domain.

    What is no point at all, of a wrong shape or not a number, is for the objective to refuse.

    Raises what `evaluate` does.
    """
    if x.ndim != 2 or x.shape[1] != objective.space.dim:
        return objective.evaluate(x, grad=grad)
    inside = in_box(objective.space, x)
    if bool(inside.all()):
        return _ask(objective, _clamp(objective.space, x), grad=grad)
    loss, slope = x.new_full((len(x),), torch.nan), torch.full_like(x, torch.nan) if grad else None
    status, error = torch.full((len(x),), Status.ESCAPED, dtype=torch.int8), ""
    if bool(inside.any()):
        found = _ask(objective, _clamp(objective.space, x[inside]), grad=grad)
        error = found.error
        loss[inside], status[inside] = found.loss.detach().to(loss), found.status.to(status)
        if slope is not None and found.grad is not None:
            slope[inside] = found.grad.detach().to(slope)
    return Evaluation(loss, slope, status, error)


def _ask(objective: Objective, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
    """Return what an objective says of points, held against the protocol."""
    found, who = objective.evaluate(x, grad=grad), name_of(objective)
    if not isinstance(found, Evaluation):
        raise ValueError(f"{who} must return an Evaluation; got {type(found).__name__}")
    count = len(x)
    wanted: dict[str, tuple[Tensor, tuple[int, ...]]] = {
        "loss": (found.loss, (count,)),
        "status": (found.status, (count,)),
    }
    if grad:
        wanted["grad"] = (_require_gradient(found.grad, who), tuple(x.shape))
    for field, (tensor, shape) in wanted.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(
                f"{who} must return {field} of shape {shape} for x of shape {tuple(x.shape)}; got {tuple(tensor.shape)}"
            )
    for status in NOT_EVALUATED:
        if bool((found.status == status).any()):
            raise ValueError(f"{who} must say how every point ended; got status {status.name}")
    return found


def in_box(space: ParameterSpace, x: Float[Tensor, "batch dim"]) -> Bool[Tensor, " batch"]:
    """Say which points lie nowhere beyond the bounds, to rounding."""
    unit = space.to_unit(x)
    return ~((unit < -ROUNDING) | (unit > 1 + ROUNDING)).any(dim=1)


def _clamp(space: ParameterSpace, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch dim"]:
    return torch.clamp(x, space.lower, space.upper)


def name_of(objective: Objective) -> str:
    """Return what an objective is called."""
    return str(getattr(objective, "name", type(objective).__name__))


def _real(values: object, what: str) -> Tensor:
    """Return a tensor of real numbers as it is, and one of what else holds some."""
    if isinstance(values, Tensor) and not values.is_complex() and values.dtype != torch.bool:
        return values
    return as_tensor(values, what)


def _check_codes(status: object) -> Tensor:
    """Return a tensor of statuses as it is, and refuse codes that mean none: as int8, 257 would be OK."""
    codes = _real(status, "a status")
    sound = (codes >= 0) & (codes <= max(Status)) & (codes % 1 == 0)
    if not bool(sound.all()):
        known = ", ".join(f"{kind.value} {kind.name}" for kind in Status)
        raise ValueError(f"a status is one of {known}; got {codes[~sound][0].item()}")
    return codes


def _require_gradient(grad: Tensor | None, who: str) -> Tensor:
    if grad is None:
        raise ValueError(
            f"{who} was asked for gradients and returned none; sample with gradients=0 (--no-gradients), "
            "or search with a method that needs none"
        )
    return grad
