"""Anyone's function as an objective, with one line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from .objective import Evaluation, Objective, Status
from .space import ParameterSpace

TorchFunction = Callable[[Tensor], Tensor]
Losses = NDArray[np.floating]
NumpyFunction = Callable[[NDArray[np.float64]], Losses | tuple[Losses, Losses]]


def from_torch(fn: TorchFunction, space: ParameterSpace, *, name: str | None = None) -> Objective:
    """Make an objective of a torch function from points, shape (batch, dim), to losses, shape (batch,).

    Gradients come by autograd. Each loss may depend on its own row only.
    """
    return _TorchObjective(fn, space, name or _name(fn))


def from_numpy(
    fn: NumpyFunction, space: ParameterSpace, *, name: str | None = None, differences: float | None = None
) -> Objective:
    """Make an objective of a numpy function from points, shape (batch, dim), to losses, shape (batch,).

    The function may return (losses, gradients) instead, gradients of shape (batch, dim). If it returns losses only,
    `differences` makes gradients by central differences with that step, a fraction of each parameter's range.
    """
    if differences is not None and not differences > 0:
        raise ValueError(f"from_numpy takes differences as a positive fraction of the bounds; got {differences}")
    return _NumpyObjective(fn, space, name or _name(fn), differences)


def within_box(objective: Objective) -> Objective:
    """Evaluate an objective inside its box only; points beyond it have left the domain (status ESCAPED)."""
    return _BoxedObjective(objective)


@dataclass(frozen=True)
class _TorchObjective:
    fn: TorchFunction
    space: ParameterSpace
    name: str

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked, at points `x` in the parameters' own units."""
        x = _points(x, self.space, self.name).clone().requires_grad_(grad)
        if len(x) == 0:
            return Evaluation.empty(self.space.dim, grad=grad)
        with torch.set_grad_enabled(grad):
            loss = self.fn(x)
        if not isinstance(loss, Tensor):
            raise ValueError(f"{self.name} must return a tensor; got {type(loss).__name__}")
        _check_shape(tuple(loss.shape), (len(x),), "losses", self.name)
        if not grad:
            return Evaluation.judged(loss.detach().cpu().double(), None)
        if not loss.requires_grad:
            raise ValueError(
                f"{self.name} returned losses that carry no gradient; compute them from x with torch operations, "
                "or sample with grad=False (--no-gradients)"
            )
        (gradient,) = torch.autograd.grad(loss.sum(), x)
        return Evaluation.judged(loss.detach().cpu().double(), gradient)


@dataclass(frozen=True)
class _NumpyObjective:
    fn: NumpyFunction
    space: ParameterSpace
    name: str
    differences: float | None

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked, at points `x` in the parameters' own units."""
        points = _points(x, self.space, self.name)
        if len(points) == 0:
            return Evaluation.empty(self.space.dim, grad=grad)
        loss, gradient = self._call(points)
        if not grad:
            return Evaluation.judged(loss, None)
        return Evaluation.judged(loss, self._differences(points) if gradient is None else gradient)

    def _call(self, x: Float[Tensor, "batch dim"]) -> tuple[Tensor, Tensor | None]:
        result = self.fn(x.numpy().copy())
        loss, gradient = result if isinstance(result, tuple) else (result, None)
        _check_shape(np.shape(loss), (len(x),), "losses", self.name)
        if gradient is not None:
            _check_shape(np.shape(gradient), tuple(x.shape), "gradients", self.name)
        return _tensor(loss), None if gradient is None else _tensor(gradient)

    def _differences(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch dim"]:
        if self.differences is None:
            raise ValueError(
                f"{self.name} returned losses without gradients; return (losses, gradients), pass differences=1e-4 "
                "to from_numpy, or sample with grad=False (--no-gradients)"
            )
        step = self.differences * (self.space.upper - self.space.lower)
        slopes = []
        for axis in range(self.space.dim):
            shift = torch.zeros_like(step)
            shift[axis] = step[axis]
            slopes.append((self._call(x + shift)[0] - self._call(x - shift)[0]) / (2 * step[axis]))
        return torch.stack(slopes, dim=1)


class _BoxedObjective:
    """What the objective knows of itself beside, such as its preferred batch, is passed on."""

    ROUNDING = 1e-9  # of the box; points that far beyond it are moved back

    def __init__(self, objective: Objective) -> None:
        self.objective, self.space = objective, objective.space

    def __getattr__(self, name: str) -> Any:
        if name == "objective":  # not made yet, while it is copied
            raise AttributeError(name)
        return getattr(self.objective, name)

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        x = _points(x, self.space, getattr(self.objective, "name", type(self.objective).__name__))
        unit = self.space.to_unit(x)
        inside = ((unit >= -self.ROUNDING) & (unit <= 1 + self.ROUNDING)).all(dim=1)
        found = self.objective.evaluate(torch.clamp(x[inside], self.space.lower, self.space.upper), grad=grad)
        loss = x.new_full((len(x),), torch.nan)
        slope = torch.full_like(x, torch.nan) if grad else None
        status = torch.full((len(x),), Status.ESCAPED, dtype=torch.int8)
        loss[inside], status[inside] = found.loss.to(loss), found.status.to(status)
        if slope is not None and found.grad is not None:
            slope[inside] = found.grad.to(slope)
        return Evaluation(loss, slope, status)


def _name(fn: Callable[..., object]) -> str:
    return str(getattr(fn, "__name__", type(fn).__name__))


def _tensor(values: Losses) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float64)


def _points(x: Tensor, space: ParameterSpace, name: str) -> Float[Tensor, "batch dim"]:
    if x.ndim != 2 or x.shape[1] != space.dim:
        raise ValueError(f"{name} takes {space.dim} parameters; got x of shape {tuple(x.shape)}")
    return x.detach().to("cpu", torch.float64)


def _check_shape(got: tuple[int, ...], wanted: tuple[int, ...], what: str, name: str) -> None:
    if got != wanted:
        raise ValueError(f"{name} must return {what} of shape {wanted}; got shape {got}")
