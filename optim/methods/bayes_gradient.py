"""Bayesian optimisation by a Gaussian process that learns from gradients, too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from botorch.models.gpytorch import GPyTorchModel
from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
from gpytorch.distributions import MultitaskMultivariateNormal
from gpytorch.kernels import RBFKernelGrad
from gpytorch.likelihoods import MultitaskGaussianLikelihood
from gpytorch.means import ConstantMeanGrad
from gpytorch.models import ExactGP
from jaxtyping import Float
from torch import Tensor

from ..base import Points
from ..memory import FLOAT, SearchSize
from ..options import MANY, MethodOptions, number
from .bayes import BO
from .bound import NEAR, SPREAD, unit
from .fit import with_parameters
from .sloped import Sloped
from .surrogate import ARRAYS, Rows, Surrogate, SurrogateOptions, select

ROWS, LEAST = 1000, 20  # losses and slopes that are modelled; points of them at least: so many parameters at most
FIT_ROWS = 400  # of them that hyper-parameters are fitted to
STEEPEST = 1e3  # deviations of the losses per width of the box, that a slope counts as at most


@dataclass(frozen=True)
class BOGradientOptions(MethodOptions):
    """How much is ventured where little is known.

    `coefficient` is how many standard deviations the bound lies below the mean. Points are drawn at random until
    `initial` of them are known.
    """

    method = "bo-gradient"

    coefficient: float = number(1.0, 0, 1e6)
    initial: int = number(10, 2, MANY)


class BOGradient(BO):
    """Evaluate where the lower confidence bound of a process over losses and gradients is least.

    The process has GPyTorch's squared-exponential covariance of a function and its slopes (`RBFKernelGrad`). A point
    with its gradient in d parameters makes d + 1 rows, and the cost grows with the cube of the rows: 1000 are modelled
    at most, those of the points with the least losses for one half and points spread over the run for the other. So it
    is for few parameters: of 10 it models 90 points, and more than 49, of which it could model 20, are refused. A point
    that has a loss and no gradient is one row. Where losses jump, slopes mislead it. The process is written here, since
    GPyTorch's takes ten times as long and finds no more.
    """

    name = "bo-gradient"
    Options = BOGradientOptions
    surrogate: SlopeSurrogate
    needs_grad = True

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate what the process takes [bytes]."""
        return float(FLOAT * (ARRAYS * ROWS**2 + (SPREAD + NEAR) * ROWS * (size.dim + 1)))

    def _setup(self) -> None:
        points = ROWS // (self.space.dim + 1)
        if points < LEAST:
            raise ValueError(
                f"{self.name} models slopes of {ROWS // LEAST - 1} parameters at most; this space has {self.space.dim}"
            )
        self.surrogate = SlopeSurrogate(self.space.dim, self.options, points)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        assert grad is not None  # as asked
        self.surrogate.learn(z, loss, grad)

    def _inform(self, z: Points, loss: Points, grad: Points | None) -> None:
        self._tell(z, loss, grad)


class SlopeSurrogate(Surrogate):
    """Model losses and their slopes by a process of both; see `Surrogate`."""

    def __init__(self, dim: int, options: BOGradientOptions, most: int) -> None:
        super().__init__(dim, SurrogateOptions(options.coefficient, initial=options.initial, max_points=most))
        self.grad: Points = np.empty((0, dim))

    def learn(self, z: Points, loss: Points, grad: Points) -> None:
        """Take in points and gradients, shape (count, dim), NaN where one is missing, and losses, shape (count,).

        Losses are +inf where an episode failed.
        """
        self.add(z, loss)
        self.grad = np.concatenate([self.grad, grad])

    def _to_fit(self) -> GradientProcess:
        chosen = select(self.loss, max(LEAST, FIT_ROWS // (1 + self.z.shape[1])))
        rows = torch.from_numpy(standardised(self.loss, self.grad)[chosen])
        return with_parameters(GradientProcess(self._places(chosen), rows), self._hyper)

    def _places(self, rows: Rows) -> Float[Tensor, "point column"]:
        """Return points of [0, 1]^dim, with a column that says whose slopes are missing where some are."""
        lacking = np.isnan(self.grad[rows]).any(axis=1, keepdims=True)
        return torch.from_numpy(np.hstack([unit(self.z[rows]), lacking])) if lacking.any() else unit(self.z[rows])

    def _covariance(self) -> Sloped:
        return Sloped(torch.from_numpy(self._hyper["scale"]))

    def _values(self, rows: Rows) -> Points:
        return standardised(self.loss, self.grad)[rows].ravel()


class GradientProcess(ExactGP, GPyTorchModel):  # type: ignore[misc]
    """A Gaussian process of a function with zero mean and its slopes, of points in [0, 1]^dim."""

    num_outputs = 1

    def __init__(self, u: Float[Tensor, "point column"], rows: Float[Tensor, "point 1+dim"]) -> None:
        dim = rows.shape[1] - 1
        prior = get_covar_module_with_dim_scaled_prior(dim, use_rbf_kernel=True)
        super().__init__(u, rows, MultitaskGaussianLikelihood(num_tasks=dim + 1, rank=0, has_task_noise=False))
        self.mean_module = ConstantMeanGrad()
        self.mean_module.constant.requires_grad_(False)
        self.covar_module = RBFKernelGrad(ard_num_dims=dim, lengthscale_prior=prior.lengthscale_prior)
        self.covar_module.lengthscale = prior.lengthscale.detach()
        self.likelihood.noise = 1e-4
        self.double()

    def forward(self, u: Float[Tensor, "point dim"]) -> MultitaskMultivariateNormal:
        """Return the distribution of the function and its slopes at points."""
        return MultitaskMultivariateNormal(self.mean_module(u), self.covar_module(u))


def standardised(loss: Points, grad: Points) -> Points:
    """Return losses with mean 0 and deviation 1 and their slopes along [0, 1]^dim, shape (point, 1 + dim).

    A failure counts as the worst loss so far, with slopes of zero; slopes that are missing are zero, too.
    """
    grad = np.where(np.isnan(grad), 0.0, grad)
    finite = np.isfinite(loss)
    known = np.where(finite, loss, loss[finite].max())
    large = max(1.0, float(np.abs(known).max()), float(np.abs(grad).max()))  # their squares might be no numbers
    spread = float((known / large).std()) * large or 1.0
    slopes = np.clip(2.0 * (grad / spread), -STEEPEST, STEEPEST)  # z is twice as wide as the unit box
    return np.concatenate([((known - known.mean()) / spread)[:, None], slopes], axis=1)
