"""A Gaussian process with zero mean given points, and the Cholesky factor of their covariance."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import Any, Protocol, cast

import torch
from gpytorch.kernels import Kernel, RBFKernelGrad
from jaxtyping import Float
from linear_operator.utils.cholesky import psd_safe_cholesky
from torch import Tensor

from .radial import Matrix, Pull, Radial
from .sloped import Sloped

KEPT = 64  # factors; fewer than the searches that go on abreast would be lost before they are asked for again

PointsTensor = Float[Tensor, "point dim"]


class Covariance(Protocol):
    """What a process asks of a covariance, each of whose points has one row or more; the first is its value."""

    @property
    def profile(self) -> str:
        """Its name."""

    @property
    def scale(self) -> Float[Tensor, " dim"]:
        """Its length-scales in [0, 1]^dim: with its name, all that it depends on."""

    def dense(self, u: PointsTensor, v: PointsTensor) -> Matrix:
        """Return the covariances of all rows of points."""

    def across(self, u: PointsTensor, v: PointsTensor) -> tuple[Matrix, Pull]:
        """Return those of the points' values with all rows of others, and what pulls slopes by them back to `u`."""

    def within(self, u: PointsTensor) -> tuple[Matrix, Pull]:
        """Return those of points with one another, and what pulls slopes by them back to slopes by length-scales."""


def covariance_of(kernel: Kernel) -> Covariance:
    """Return what a kernel of GPyTorch computes, as it is now. Raises ValueError for one that is not known here."""
    return Sloped.of(kernel) if isinstance(kernel, RBFKernelGrad) else Radial.of(kernel)


@dataclass(frozen=True)
class Process:
    """A process over [0, 1]^dim with zero mean, given `values`, a number for each row of the points `u`.

    `noise` is the variance of what is added to each row. The factor of the `first` points is kept for the next process
    that begins with them.
    """

    covariance: Covariance
    noise: float
    u: PointsTensor
    values: Float[Tensor, " row"]
    first: int

    def factor(self) -> Factor:
        """Return the factor of the covariance of what is known, going on from one that is kept where there is one."""
        key = (self.covariance.profile, self.noise, *map(_bytes, (self.covariance.scale, self.u[: self.first])))
        found = _factors.get(key)
        if found is None:
            head = _cholesky(self.covariance.dense(self.u[: self.first], self.u[: self.first]), self.noise)
            found = Factor(self.u[: self.first], head, head[:0], head[:0, :0])
        elif not torch.equal(found.u, self.u[: len(found.u)]):
            found = found.first(self.first)
        for row in range(len(found.u), len(self.u)):
            found = found.extended(self.u[row : row + 1], self.covariance, self.noise)
        _factors[key] = found
        _factors.move_to_end(key)
        if len(_factors) > KEPT:
            _factors.popitem(last=False)
        return found

    @torch.no_grad()
    def posterior(self, u: PointsTensor) -> tuple[Float[Tensor, " point"], Matrix]:
        """Return mean and covariance of the values at points, given what is known, of points with one row each."""
        factor, cross = self.factor(), self.covariance.dense(u, self.u)
        white = factor.whiten(cross)
        return cross @ factor.weights(self.values), self.covariance.dense(u, u).addmm_(white, white.T, alpha=-1.0)


@dataclass(frozen=True)
class Factor:
    """The Cholesky factor L of the covariance of points with noise, in blocks: `head` of the first, the others below.

    Points are added one by one, so that what comes out is the same to the last bit whether an earlier factor was kept
    or not. To solve with it takes half as long as to multiply with its inverse, for the few points that a bound is
    asked of.
    """

    u: PointsTensor
    head: Matrix
    across: Matrix
    own: Matrix

    def first(self, count: int) -> Factor:
        """Return the factor of as many of the points as `head` is of."""
        return Factor(self.u[:count], self.head, self.across[:0], self.own[:0, :0])

    def extended(self, point: PointsTensor, covariance: Covariance, noise: float) -> Factor:
        """Return the factor of one point more."""
        white = self.whiten(covariance.dense(point, self.u))
        corner = _cholesky(covariance.dense(point, point) - white @ white.T, noise)
        below, count = torch.cat([white[:, len(self.head) :], corner], dim=1), len(corner)
        own = torch.cat([torch.nn.functional.pad(self.own, (0, count)), below])
        across = torch.cat([self.across, white[:, : len(self.head)]])
        return replace(self, u=torch.cat([self.u, point]), across=across, own=own)

    def whiten(self, rows: Matrix) -> Matrix:
        """Return L^-1 times the transpose of rows, transposed: their squares add up to what rows explain."""
        count = len(self.head)
        first = _solve(self.head, rows[:, :count].T)
        if not len(self.own):
            return first.T
        last = _solve(self.own, rows[:, count:].T - self.across @ first)
        return torch.cat([first, last]).T

    def weights(self, values: Float[Tensor, " row"]) -> Float[Tensor, " row"]:
        """Return the inverse covariance times a number for each row: what covariances make means with."""
        return self.solve_whitened(self.whiten(values[None]))[0]

    def solve_whitened(self, rows: Matrix) -> Matrix:
        """Return L^-T times the transpose of rows, transposed: of whitened rows, the inverse covariance times rows."""
        count = len(self.head)
        if not len(self.own):
            return _solve_transposed(self.head, rows.T).T
        last = _solve_transposed(self.own, rows[:, count:].T)
        first = _solve_transposed(self.head, rows[:, :count].T - self.across.T @ last)
        return torch.cat([first, last]).T


_factors: OrderedDict[tuple[Any, ...], Factor] = OrderedDict()  # by covariance, noise and the bytes of its first points


def _bytes(numbers: Tensor) -> bytes:
    return numbers.contiguous().numpy().tobytes()


def _cholesky(covariance: Matrix, noise: float) -> Matrix:
    covariance.diagonal().add_(noise)
    return cast(Tensor, psd_safe_cholesky(covariance))


def _solve(lower: Matrix, columns: Matrix) -> Matrix:
    return cast(Tensor, torch.linalg.solve_triangular(lower, columns, upper=False))


def _solve_transposed(lower: Matrix, columns: Matrix) -> Matrix:
    return cast(Tensor, torch.linalg.solve_triangular(lower.T, columns, upper=True))
