"""Gaussian processes with zero mean: covariances, their factors, and fits of hyper-parameters.

Covariances are GPyTorch's `RBFKernel`, `MaternKernel` and `RBFKernelGrad` without their bookkeeping and without reverse
differentiation. For a process of a few hundred points, these take longer than the numbers themselves. Fits maximise the
marginal likelihood times priors by BoTorch's optimiser.
"""

from __future__ import annotations

import abc
import math
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import torch
from botorch.optim.fit import fit_gpytorch_mll_scipy
from gpytorch.kernels import Kernel, MaternKernel, RBFKernel, RBFKernelGrad
from gpytorch.mlls import ExactMarginalLogLikelihood
from gpytorch.models import ExactGP
from jaxtyping import Bool, Float
from linear_operator.utils.cholesky import psd_safe_cholesky
from torch import Tensor

from ..base import Points

Matrix = Float[Tensor, "row column"]
Pull = Callable[[Matrix], Tensor]
PointsTensor = Float[Tensor, "point dim"]
Model = TypeVar("Model", bound=ExactGP)

KEPT = 64  # factors; with fewer than there are searches in lockstep, each would be lost before its next use
GROWTH = 1.1  # hyper-parameters are fitted again when there are this many times more points than at the last fit
FIT_STEPS = 30  # of L-BFGS, from where the last fit ended
_factors: OrderedDict[tuple[Any, ...], Factor] = OrderedDict()  # by covariance, noise and the bytes of its first points


@dataclass(frozen=True)
class Covariance(abc.ABC):
    """A covariance of points of [0, 1]^dim, each of which has one row or more; the first is its value.

    It depends only on its class and its length-scales, `scale`.
    """

    scale: Float[Tensor, " dim"]

    @abc.abstractmethod
    def dense(self, u: PointsTensor, v: PointsTensor) -> Matrix:
        """Return the covariances of all rows of points."""

    @abc.abstractmethod
    def across(self, u: PointsTensor, v: PointsTensor) -> tuple[Matrix, Pull]:
        """Return those of the points' values with all rows of others, and what pulls slopes by them back to `u`."""

    @abc.abstractmethod
    def within(self, u: PointsTensor) -> tuple[Matrix, Pull]:
        """Return those of points with one another, and what pulls slopes by them back to slopes by length-scales."""


class Radial(Covariance):
    """A covariance k(s) where s = sum_j (u_j - v_j)^2 / scale_j^2."""

    @abc.abstractmethod
    def _value(self, squares: Matrix) -> Matrix:
        """Return k, written over s: matrices of thousands of points are to be made once."""

    @abc.abstractmethod
    def _both(self, squares: Matrix) -> tuple[Matrix, Matrix]:
        """Return k and dk/ds."""

    def between(self, u: Float[Tensor, "row dim"], v: Float[Tensor, "column dim"]) -> tuple[Matrix, Matrix]:
        """Return k of every pair of points of [0, 1]^dim, and dk/ds."""
        return self._both(self._squares(u, v))

    def dense(self, u: Float[Tensor, "row dim"], v: Float[Tensor, "column dim"]) -> Matrix:
        """Return k of every pair of points."""
        return self._value(self._squares(u, v))

    def _squares(self, u: Float[Tensor, "row dim"], v: Float[Tensor, "column dim"]) -> Matrix:
        u, v = (u - 0.5) / self.scale, (v - 0.5) / self.scale
        squares = u.square().sum(dim=1)[:, None] + v.square().sum(dim=1)
        return squares.addmm_(u, v.T, alpha=-2.0).clamp_min_(0.0)

    def across(self, u: Float[Tensor, "row dim"], v: Float[Tensor, "column dim"]) -> tuple[Matrix, Pull]:
        """Return k, and what pulls a function's slopes by k, shape (row, column), back to its slopes by `u`."""
        value, slope = self.between(u, v)

        def pull(weights: Matrix) -> Float[Tensor, "row dim"]:
            pulled = 2.0 * weights * slope
            return (u * pulled.sum(dim=1, keepdim=True) - pulled @ v) / self.scale.square()

        return value, pull

    def within(self, u: Float[Tensor, "row dim"]) -> tuple[Matrix, Pull]:
        """Return k of points with one another, and what pulls symmetric slopes by k back to slopes by length-scales.

        Of sum_ab M_ab (u_aj - u_bj)^2, with M = slopes times dk/ds, products of M with u are taken apart.
        """
        value, slope = self.between(u, u)

        def pull(weights: Matrix) -> Float[Tensor, " dim"]:
            moments, centred = weights * slope, u - 0.5
            spread = moments.sum(dim=1) @ centred.square() - (centred * (moments @ centred)).sum(dim=0)
            return -4.0 * spread / self.scale**3

        return value, pull


class SquaredExponential(Radial):
    """exp(-s / 2)."""

    def _value(self, squares: Matrix) -> Matrix:
        return squares.mul_(-0.5).exp_()

    def _both(self, squares: Matrix) -> tuple[Matrix, Matrix]:
        value = self._value(squares)
        return value, -0.5 * value


class Matern(Radial):
    """Matern's of smoothness 5/2 (Rasmussen & Williams 2006, eq. 4.17)."""

    def _value(self, squares: Matrix) -> Matrix:
        root = squares.mul_(5.0).sqrt_()
        polynomial = root.square().div_(3.0).add_(root).add_(1.0)
        return polynomial.mul_(root.neg_().exp_())

    def _both(self, squares: Matrix) -> tuple[Matrix, Matrix]:
        root = torch.sqrt(5.0 * squares)
        decay = torch.exp(-root)
        return (1.0 + root + 5.0 / 3.0 * squares) * decay, -5.0 / 6.0 * (1.0 + root) * decay


KERNELS: dict[str, type[Radial]] = {"rbf": SquaredExponential, "matern": Matern}


class GradientCovariance(Covariance):
    """The squared-exponential covariance k(u, v) = exp(-sum_j (u_j - v_j)^2 / scale_j^2 / 2), and its derivatives.

    Each point has 1 + dim rows, its value and its slopes (Rasmussen & Williams 2006, eq. 9.1). A point whose slopes are
    not known has 1 in a column after its coordinates, which others may be without: rows of such slopes depend on
    nothing, so that they change neither a mean nor a variance.
    """

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.scale)

    def _lacking(self, u: Float[Tensor, "point column"]) -> Bool[Tensor, " row"]:
        """Return which rows of points are slopes that are not known."""
        found = torch.zeros(len(u), 1 + self.dim, dtype=torch.bool)
        if u.shape[1] > self.dim:
            found[:, 1:] = u[:, self.dim :] == 1
        return found.flatten()

    def dense(self, u: Float[Tensor, "point dim"], v: Float[Tensor, "other dim"]) -> Matrix:
        """Return the covariances of all rows of points."""
        value, slope = self._between(u, v)
        curvature = torch.diag(self.scale**-2) - slope[..., :, None] * slope[..., None, :]
        block = torch.cat([torch.cat([torch.ones_like(value)[..., None], slope], dim=2)[..., None, :],
                           torch.cat([-slope[..., None], curvature], dim=3)], dim=2)  # fmt: skip
        rows = (block * value[..., None, None]).permute(0, 2, 1, 3).flatten(2).flatten(0, 1)
        left, right = self._lacking(u), self._lacking(v)
        if not (left.any() or right.any()):
            return rows
        apart = rows.masked_fill(left[:, None] | right, 0.0)
        same = (u[:, None] == v).all(dim=2).repeat_interleave(1 + self.dim, 0).repeat_interleave(1 + self.dim, 1)
        each = torch.eye(1 + self.dim, dtype=torch.bool).repeat(len(u), len(v))
        return torch.where(left[:, None] & right & same & each, 1.0, apart)

    def across(self, u: Float[Tensor, "point dim"], v: Float[Tensor, "other dim"]) -> tuple[Matrix, Pull]:
        """Return those of the points' values with all rows of others, and what pulls slopes by them back to `u`."""
        value, slope = self._between(u, v)
        rows = value[..., None] * torch.cat([torch.ones_like(value)[..., None], slope], dim=2)
        known = ~self._lacking(v).reshape(len(v), -1)
        rows = rows * known

        def pull(weights: Matrix) -> Float[Tensor, "point dim"]:
            each = weights.reshape(rows.shape) * known
            first = each[..., 0] + (each[..., 1:] * slope).sum(dim=2)
            return (value[..., None] * (each[..., 1:] / self.scale.square() - first[..., None] * slope)).sum(dim=1)

        return rows.flatten(1), pull

    def within(self, u: Float[Tensor, "point dim"]) -> tuple[Matrix, Pull]:
        """Return those of points with one another, and what pulls slopes by them back to slopes by length-scales."""
        with torch.enable_grad():
            scale = self.scale.clone().requires_grad_()
            value = GradientCovariance(scale).dense(u, u)
        return value.detach(), lambda weights: torch.autograd.grad(value, scale, weights)[0]

    def _between(
        self, u: Float[Tensor, "point dim"], v: Float[Tensor, "other dim"]
    ) -> tuple[Matrix, Float[Tensor, "point other dim"]]:
        """Return k, and its derivative by the second point divided by k."""
        apart = (u[:, None, : self.dim] - v[:, : self.dim]) / self.scale
        return torch.exp(-0.5 * apart.square().sum(dim=2)), apart / self.scale


def fitted(model: ExactGP) -> dict[str, Points]:
    """Return the parameters at which marginal likelihood times priors is largest, from their present values, by name.

    It also contains the derived values: the length-scales, `scale`, and the noise's variance, `noise`, shape (1,).
    """
    likelihood = ExactMarginalLogLikelihood(model.likelihood, model).train()
    parameters = {name: one for name, one in likelihood.named_parameters() if one.requires_grad}
    fit_gpytorch_mll_scipy(likelihood, parameters, closure=closure_of(likelihood), options={"maxiter": FIT_STEPS})
    found = {name: value.detach().numpy().copy() for name, value in model.named_parameters()}
    scale, noise = model.covar_module.lengthscale, model.likelihood.noise
    return found | {"scale": scale.detach().reshape(-1).numpy(), "noise": noise.detach().reshape(-1).numpy()}


def with_parameters(model: Model, parameters: Mapping[str, Points]) -> Model:
    """Return a process with the named parameters set to these values."""
    with torch.no_grad():
        for name, value in model.named_parameters():
            if name in parameters:
                value.copy_(torch.from_numpy(parameters[name]))
    return model


def closure_of(likelihood: ExactMarginalLogLikelihood) -> Callable[[], tuple[Tensor, list[Tensor]]]:
    """Return a function for minus the logarithm of likelihood times priors, and its derivatives by parameters.

    It returns them for each row, and equals BoTorch's closure for a process without mean.
    """
    model = likelihood.model
    u, values = model.train_inputs[0], model.train_targets.reshape(-1)
    parameters = [one for one in likelihood.parameters() if one.requires_grad]

    def closure() -> tuple[Tensor, list[Tensor]]:
        kernel, noise = model.covar_module, model.likelihood.noise
        with torch.no_grad():
            found = marginal_likelihood(covariance_of(kernel), float(noise), u, values)
        # what is linear in the parameters with these slopes has the likelihood's slopes
        linear = (kernel.lengthscale.reshape(-1) * found.scale).sum() + (noise * found.noise).sum()
        priors = sum(prior.log_prob(of(module)).sum() for _, module, prior, of, _ in model.named_priors())
        slopes = torch.autograd.grad(-(linear + priors) / len(values), parameters)
        return -(found.value + priors.detach()) / len(values), list(slopes)

    return closure


@dataclass(frozen=True)
class Likelihood:
    """The logarithm of a marginal likelihood, and its derivatives by length-scales and by the noise's variance."""

    value: float
    scale: Float[Tensor, " dim"]
    noise: float


def marginal_likelihood(
    covariance: Covariance, noise: float, u: Float[Tensor, "point dim"], values: Float[Tensor, " row"]
) -> Likelihood:
    """Return how likely values at points are under a process with zero mean (Rasmussen & Williams 2006, section 5.4.1).

    With W = alpha alpha^T - K^-1, alpha = K^-1 values, a derivative is tr(W dK) / 2 (eq. 5.9).
    """
    matrix, pull = covariance.within(u)
    matrix.diagonal().add_(noise)
    lower = psd_safe_cholesky(matrix)
    inverse = torch.cholesky_inverse(lower)
    alpha = inverse @ values
    value = -0.5 * (values @ alpha) - lower.diagonal().log().sum() - 0.5 * len(values) * math.log(2.0 * math.pi)
    weights = torch.outer(alpha, alpha).sub_(inverse)
    return Likelihood(float(value), 0.5 * pull(weights), 0.5 * float(weights.diagonal().sum()))


def covariance_of(kernel: Kernel) -> Covariance:
    """Return the present covariance of a kernel of GPyTorch. Raises ValueError for an unknown one."""
    scale = kernel.lengthscale.detach().reshape(-1).clone()
    if isinstance(kernel, RBFKernelGrad):
        return GradientCovariance(scale)
    if isinstance(kernel, RBFKernel):
        return SquaredExponential(scale)
    if isinstance(kernel, MaternKernel) and kernel.nu == 2.5:
        return Matern(scale)
    raise ValueError(f"covariance_of takes an RBFKernel, an RBFKernelGrad or a MaternKernel of 5/2; got {kernel}")


@dataclass(frozen=True)
class Process:
    """A process over [0, 1]^dim with zero mean, given `values`, a number for each row of the points `u`.

    `noise` is the variance of the noise of each row. The factor of the `first` points is kept for the next process that
    begins with them.
    """

    covariance: Covariance
    noise: float
    u: PointsTensor
    values: Float[Tensor, " row"]
    first: int

    def factor(self) -> Factor:
        """Return the factor of the covariance of the known points, extending a kept one if there is one."""
        key = (type(self.covariance), self.noise, *map(_bytes, (self.covariance.scale, self.u[: self.first])))
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
        """Return mean and covariance of the values at points, given the known ones, for points with one row each."""
        factor, cross = self.factor(), self.covariance.dense(u, self.u)
        white = factor.whiten(cross)
        return cross @ factor.weights(self.values), self.covariance.dense(u, u).addmm_(white, white.T, alpha=-1.0)


@dataclass(frozen=True)
class Factor:
    """The Cholesky factor L of the covariance of points with noise, in blocks: `head` of the first, the others below.

    Points are added one by one, so the result is the same to the last bit whether an earlier factor was kept or not.
    For the few points of a bound, solving takes half as long as multiplying with its inverse.
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


def _bytes(numbers: Tensor) -> bytes:
    return numbers.contiguous().numpy().tobytes()


def _cholesky(covariance: Matrix, noise: float) -> Matrix:
    covariance.diagonal().add_(noise)
    return cast(Tensor, psd_safe_cholesky(covariance))


def _solve(lower: Matrix, columns: Matrix) -> Matrix:
    return cast(Tensor, torch.linalg.solve_triangular(lower, columns, upper=False))


def _solve_transposed(lower: Matrix, columns: Matrix) -> Matrix:
    return cast(Tensor, torch.linalg.solve_triangular(lower.T, columns, upper=True))
