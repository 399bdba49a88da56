"""Adapters that make an objective of a torch or numpy function."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from .objective import Evaluation, Objective, evaluate_inside, name_of
from .space import ParameterSpace, as_tensor

TorchFunction = Callable[[Tensor], Tensor]
NumpyFunction = Callable[[NDArray[np.float64]], Any]
LEAST_STEP = 1e-12  # of differences: losses are rounded to 1e-16 of themselves, and their difference is divided by it


def from_torch(
    fn: TorchFunction,
    space: ParameterSpace,
    *,
    name: str | None = None,
    loss_unit: str = "",
    vectorized: bool = True,
) -> Objective:
    """Make an objective of a torch function from points, shape (batch, dim), to losses, shape (batch,).

    Gradients come by autograd. Each loss may depend on its own row only. With `vectorized=False` the function takes a
    single point, shape (dim,), and returns one loss.
    """
    return _TorchObjective(fn if vectorized else _Pointwise(fn, _stack), space, name or function_name(fn), loss_unit)


def from_numpy(
    fn: NumpyFunction,
    space: ParameterSpace,
    *,
    name: str | None = None,
    loss_unit: str = "",
    differences: float | None = None,
    vectorized: bool = True,
) -> Objective:
    """Make an objective of a numpy function from points, shape (batch, dim), to losses, shape (batch,).

    The function may return (losses, gradients) instead, gradients of shape (batch, dim). If it returns losses only,
    `differences` makes gradients by central differences with that step, a fraction of each parameter's range; at the
    bounds they are one-sided, since the function is not asked beyond them. With `vectorized=False` the function takes a
    single point, shape (dim,), and returns one loss, or that and its gradient.

    Raises ValueError where `differences` is no fraction of the bounds, or lost in rounding beside them.
    """
    differences = None if differences is None else _step(differences, space)
    return _NumpyObjective(
        fn if vectorized else _Pointwise(fn, list), space, name or function_name(fn), loss_unit, differences
    )


def within_box(objective: Objective) -> Objective:
    """Evaluate an objective inside its box only, though it may invite points beyond: these have status ESCAPED."""
    return _BoxedObjective(objective)


@dataclass(frozen=True)
class _Pointwise:
    """Call a function of one point at each of a batch; what it raises says at which."""

    fn: Callable[[Any], Any]
    join: Callable[[Sequence[Any]], Any]

    def __call__(self, x: Any) -> Any:
        found = [self._at(point) for point in x]
        if found and isinstance(found[0], tuple):
            return tuple(self.join(column) for column in zip(*found, strict=True))
        return self.join(found)

    def _at(self, point: Any) -> Any:
        try:
            return self.fn(point)
        except Exception as error:
            error.add_note(f"at x = {point.tolist()}")
            raise


@dataclass(frozen=True)
class _TorchObjective:
    fn: TorchFunction
    space: ParameterSpace
    name: str
    loss_unit: str

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked, at points `x` in the parameters' own units."""
        x = check_points(x, self.space, self.name).clone().requires_grad_(grad)
        if len(x) == 0:
            return Evaluation.empty(self.space.dim, grad=grad)
        with torch.set_grad_enabled(grad):
            loss = self.fn(x)
        if not isinstance(loss, Tensor):
            raise ValueError(f"{self.name} must return a tensor; got {type(loss).__name__}")
        check_shape(tuple(loss.shape), (len(x),), "losses", self.name)
        losses = as_tensor(loss, f"the loss of {self.name}")
        return Evaluation.from_results(losses, self._gradient(loss, x) if grad else None)

    def _gradient(self, loss: Float[Tensor, " batch"], x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch dim"]:
        (gradient,) = torch.autograd.grad(loss.sum(), x, allow_unused=True) if loss.requires_grad else (None,)
        if gradient is None:
            raise ValueError(
                f"{self.name} returned losses that carry no gradient; compute them from x with torch operations, "
                "or sample with gradients=0 (--no-gradients)"
            )
        return gradient


@dataclass(frozen=True)
class _NumpyObjective:
    fn: NumpyFunction
    space: ParameterSpace
    name: str
    loss_unit: str
    differences: float | None

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if asked, at points `x` in the parameters' own units."""
        points = check_points(x, self.space, self.name)
        if len(points) == 0:
            return Evaluation.empty(self.space.dim, grad=grad)
        loss, gradient = self._call(points)
        if not grad:
            return Evaluation.from_results(loss, None)
        return Evaluation.from_results(loss, self._differences(points) if gradient is None else gradient)

    def _call(self, x: Float[Tensor, "batch dim"]) -> tuple[Tensor, Tensor | None]:
        result = self.fn(x.numpy().copy())
        loss, gradient = result if isinstance(result, tuple) else (result, None)
        losses = as_tensor(loss, f"the loss of {self.name}")
        check_shape(tuple(losses.shape), (len(x),), "losses", self.name)
        slope = None if gradient is None else as_tensor(gradient, f"the gradient of {self.name}")
        if slope is not None:
            check_shape(tuple(slope.shape), tuple(x.shape), "gradients", self.name)
        return losses, slope

    def _differences(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch dim"]:
        if self.differences is None:
            raise ValueError(
                f"{self.name} returned losses without gradients; return (losses, gradients), pass differences=1e-4 "
                "to from_numpy, or sample with gradients=0 (--no-gradients)"
            )
        lower, upper = self.space.lower, self.space.upper
        slopes = []
        for axis in range(self.space.dim):
            step = torch.zeros_like(lower)
            step[axis] = self.differences * (upper - lower)[axis]
            ahead, behind = torch.minimum(x + step, upper), torch.maximum(x - step, lower)
            apart = (ahead - behind)[:, axis]
            slopes.append((self._call(ahead)[0] - self._call(behind)[0]) / apart)
        return torch.stack(slopes, dim=1)


class _BoxedObjective:
    """What the objective knows of itself beside, such as its preferred batch, is passed on."""

    beyond_box = False

    def __init__(self, objective: Objective) -> None:
        self.objective, self.space = objective, objective.space

    def __getattr__(self, name: str) -> Any:
        if name == "objective":  # not made yet, while it is copied
            raise AttributeError(name)
        return getattr(self.objective, name)

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        return evaluate_inside(self.objective, check_points(x, self.space, name_of(self.objective)), grad=grad)


def _step(differences: object, space: ParameterSpace) -> float:
    """Return a step, a fraction of the bounds, that is no larger than they are and not lost in rounding."""
    fraction = float(as_tensor(differences, "from_numpy's differences"))
    if not LEAST_STEP <= fraction <= 1:
        raise ValueError(
            f"from_numpy takes differences from {LEAST_STEP:g} to 1, a fraction of the bounds; got {fraction}"
        )
    farthest = torch.maximum(space.lower.abs(), space.upper.abs())
    lost = (farthest + fraction * (space.upper - space.lower) == farthest).tolist()
    if any(lost):
        name = space.names[lost.index(True)]
        raise ValueError(f"from_numpy's differences of {fraction:g} are lost in rounding beside the bounds of {name}")
    return fraction


def _stack(found: Sequence[Any]) -> Any:
    """Return losses of single points as one tensor; what is none is returned for the objective to refuse."""
    return torch.stack(list(found)) if all(isinstance(one, Tensor) for one in found) else found[0]


def function_name(fn: Callable[..., object]) -> str:
    """Return what a function is called, or its type where it has no name."""
    return str(getattr(fn, "__name__", type(fn).__name__))


def check_points(x: object, space: ParameterSpace, name: str) -> Float[Tensor, "batch dim"]:
    """Return points as a tensor. Raises ValueError where they are no points of the space."""
    points = as_tensor(x, name)
    if points.ndim != 2 or points.shape[1] != space.dim:
        raise ValueError(f"{name} takes {space.dim} parameters; got x of shape {tuple(points.shape)}")
    return points


def check_shape(got: tuple[int, ...], wanted: tuple[int, ...], what: str, name: str) -> None:
    """Raise ValueError where what a function returned has another shape than it must have."""
    if got != wanted:
        raise ValueError(
            f"{name} must return {what} of shape {wanted}; got shape {got} (a function of one point: vectorized=False)"
        )
