"""The lower confidence bound of a Gaussian process over [0, 1]^dim, and where it is least."""

from __future__ import annotations

import threading
import warnings
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
import torch
from botorch.exceptions.warnings import BotorchWarning
from botorch.optim.batched_lbfgs_b import fmin_l_bfgs_b_batched
from gpytorch.kernels import Kernel
from gpytorch.models import ExactGP
from gpytorch.utils.warnings import GPInputWarning
from jaxtyping import Float
from linear_operator.utils.cholesky import psd_safe_cholesky
from linear_operator.utils.warnings import NumericalWarning
from torch import Tensor

from ..base import Points
from .radial import Matrix, Pull, Radial

STEPS = 30  # of L-BFGS on the bound, from each start
STARTS, SPREAD, NEAR, JITTER = 6, 128, 32, 0.02  # of the search for its least value: see `_starts`
KEPT = 64  # factors; fewer than the searches that go on abreast would be lost before they are asked for again
# GPyTorch's settings and Python's warning filters belong to the process, not to a thread.
ONE_AT_A_TIME = threading.RLock()
_factors: OrderedDict[tuple[Any, ...], Tensor] = OrderedDict()  # by kernel and bytes of points, noise, parameters


class Covariance(Protocol):
    """What a bound asks of a kernel, of `rows` rows for each point."""

    def dense(self, u: Float[Tensor, "point dim"], v: Float[Tensor, "other dim"]) -> Matrix:
        """Return the covariances of all rows of points."""

    def across(self, u: Float[Tensor, "point dim"], v: Float[Tensor, "other dim"]) -> tuple[Matrix, Pull]:
        """Return those of the points' values with all rows of others, and what pulls slopes by them back to `u`."""


@dataclass(frozen=True)
class Differentiated:
    """Any kernel of GPyTorch, by reverse differentiation; the first of a point's rows is its value."""

    kernel: Kernel
    rows: int

    def dense(self, u: Float[Tensor, "point dim"], v: Float[Tensor, "other dim"]) -> Matrix:
        """Return the covariances of all rows of points."""
        return cast(Tensor, self.kernel(u, v).to_dense().detach())

    def across(self, u: Float[Tensor, "point dim"], v: Float[Tensor, "other dim"]) -> tuple[Matrix, Pull]:
        """Return those of the points' values with all rows of others, and what pulls slopes by them back to `u`."""
        with torch.enable_grad():
            at = u.detach().clone().requires_grad_()
            found = self.kernel(at, v).to_dense()[:: self.rows]
        return found.detach(), lambda weights: torch.autograd.grad(found, at, weights)[0]


class LowerBound:
    """The lower confidence bound of a process, in standard deviations of the losses from their average.

    It is that of BoTorch's `UpperConfidenceBound` with `maximize=False`, before the losses' scale is put back: of a
    model of one function, alone or with its slopes, with zero mean and a variance of one where nothing is known. What
    does not change from point to point is computed once: weights of what is known, and a factor of the covariance.
    That of the `first` points, which the process was fitted to, is kept for the next bound of the same process.
    """

    def __init__(self, model: ExactGP, coefficient: float, first: int | None = None) -> None:
        known: Any = model  # which of its parts are modules, torch's types do not say
        self.coefficient = coefficient
        self.known = known.train_inputs[0]
        values = known.train_targets.reshape(-1)
        rows = len(values) // len(self.known)
        with torch.no_grad():
            kernel, noise = known.covar_module, known.likelihood.noise.detach()
            self.covariance: Covariance = Radial.of(kernel) if rows == 1 else Differentiated(kernel, rows)
            parameters = list(kernel.state_dict().values())
            self.factor = Factor.of(self.covariance, self.known, noise, first, parameters)
            self.weights = self.factor.solve_whitened(self.factor.whiten(values[None]))[0]

    @torch.no_grad()
    def __call__(self, u: Float[Tensor, "count dim"]) -> Float[Tensor, " count"]:
        """Return mean - coefficient * standard deviation at points."""
        covariance = self.covariance.across(u, self.known)[0]
        deviation = _deviation(self.factor.whiten(covariance))
        return covariance @ self.weights - self.coefficient * deviation

    @torch.no_grad()
    def with_slope(self, u: Float[Tensor, "count dim"]) -> tuple[Float[Tensor, " count"], Float[Tensor, "count dim"]]:
        """Return the bound at points, and its slopes there."""
        covariance, pull = self.covariance.across(u, self.known)
        white = self.factor.whiten(covariance)
        deviation = _deviation(white)
        # variance = 1 - c K^-1 c, so that the deviation's slope by c is -K^-1 c / deviation
        by_covariance = self.weights + self.factor.solve_whitened(white) * (self.coefficient / deviation)[:, None]
        return covariance @ self.weights - self.coefficient * deviation, pull(by_covariance)


def _deviation(white: Matrix) -> Float[Tensor, " count"]:
    return (1.0 - white.square().sum(dim=1)).clamp_min(1e-20).sqrt()


@dataclass(frozen=True)
class Factor:
    """The Cholesky factor L of a covariance with noise, in blocks: `head` of the first rows, `across` and `own` below.

    To solve with it takes half as long as to multiply with its inverse, for the few points that a bound is asked of.
    """

    head: Matrix
    across: Matrix
    own: Matrix

    @classmethod
    def of(
        cls,
        covariance: Covariance,
        points: Float[Tensor, "point dim"],
        noise: Tensor,
        first: int | None,
        parameters: Sequence[Tensor],
    ) -> Factor:
        """Return the factor for points; that of the `first` is computed once for each process and so many of them.

        `parameters` are all that the covariance depends on beside the points.
        """
        head, tail = points[:first], points[len(points) if first is None else first :]
        keys = None if first is None else (head, noise, *parameters)
        known = _head_of(covariance, head, noise, keys)
        if not len(tail):
            return cls(known, known[:0], known[:0, :0])
        across = _solve(known, covariance.dense(head, tail)).T
        return cls(known, across, _factor_of(covariance.dense(tail, tail) - across @ across.T, noise))

    def whiten(self, rows: Matrix) -> Matrix:
        """Return L^-1 times the transpose of rows, transposed: their squares add up to what rows explain."""
        count = len(self.head)
        first = _solve(self.head, rows[:, :count].T)
        if not len(self.own):
            return first.T
        last = _solve(self.own, rows[:, count:].T - self.across @ first)
        return torch.cat([first, last]).T

    def solve_whitened(self, rows: Matrix) -> Matrix:
        """Return L^-T times the transpose of rows, transposed: of whitened rows, the inverse covariance times rows."""
        count = len(self.head)
        if not len(self.own):
            return _solve_transposed(self.head, rows.T).T
        last = _solve_transposed(self.own, rows[:, count:].T)
        first = _solve_transposed(self.head, rows[:, :count].T - self.across.T @ last)
        return torch.cat([first, last]).T


def _head_of(
    covariance: Covariance, points: Float[Tensor, "point dim"], noise: Tensor, keys: Sequence[Tensor] | None
) -> Matrix:
    """Return the factor for points, kept for the next time if there is something to know it by."""
    if keys is None:
        return _factor_of(covariance.dense(points, points), noise)
    kind = covariance.profile if isinstance(covariance, Radial) else type(covariance)
    key = (kind, *(array.detach().contiguous().numpy().tobytes() for array in keys))
    if key not in _factors:
        _factors[key] = _factor_of(covariance.dense(points, points), noise)
    _factors.move_to_end(key)
    if len(_factors) > KEPT:
        _factors.popitem(last=False)
    return _factors[key]


def _factor_of(covariance: Matrix, noise: Tensor) -> Matrix:
    covariance.diagonal().add_(noise)
    return cast(Tensor, psd_safe_cholesky(covariance))


def _solve(lower: Matrix, columns: Matrix) -> Matrix:
    return cast(Tensor, torch.linalg.solve_triangular(lower, columns, upper=False))


def _solve_transposed(lower: Matrix, columns: Matrix) -> Matrix:
    return cast(Tensor, torch.linalg.solve_triangular(lower.T, columns, upper=True))


def least_point(bound: LowerBound, z: Points, loss: Points, random: np.random.Generator) -> Points:
    """Return where in [-1, 1]^dim the bound is least, shape (dim,), given the points z and their losses so far."""

    def at(x: Points) -> tuple[Points, Points]:
        value, slope = bound.with_slope(torch.from_numpy(x))
        return value.numpy(), slope.numpy()

    starts = _starts(bound, z, loss, random).numpy()
    minimise: Any = fmin_l_bfgs_b_batched  # untyped
    found, least, _ = minimise(at, starts, bounds=[(0.0, 1.0)] * z.shape[1], maxiter=STEPS)
    return np.asarray(2.0 * found[np.argmin(least)] - 1.0)


def _starts(bound: LowerBound, z: Points, loss: Points, random: np.random.Generator) -> Float[Tensor, "start dim"]:
    """Return where the search for the least bound starts: the best of many points all over, and near the best."""
    leaders = z[np.argsort(loss, kind="stable")[:8]]
    near = np.resize(leaders, (NEAR, z.shape[1])) + 2 * JITTER * random.standard_normal((NEAR, z.shape[1]))
    near[: len(leaders)] = leaders
    groups = (random.uniform(-1.0, 1.0, (SPREAD, z.shape[1])), near.clip(-1.0, 1.0))
    return torch.cat([u[bound(u).topk(STARTS // 2, largest=False).indices] for u in map(unit, groups)])


def unit(z: Points) -> Float[Tensor, "count dim"]:
    """Return points of [-1, 1]^dim as points of [0, 1]^dim."""
    return torch.from_numpy((z + 1.0) / 2.0)


@contextmanager
def exclusive() -> Iterator[None]:
    """Keep other threads out, and quiet what is no news: iteration limits reached, jitter added to a covariance."""
    with ONE_AT_A_TIME, warnings.catch_warnings():
        for category in (BotorchWarning, NumericalWarning, GPInputWarning):
            warnings.simplefilter("ignore", category)
        yield
