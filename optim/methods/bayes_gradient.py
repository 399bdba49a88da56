"""Bayesian optimisation by a Gaussian process that learns from gradients, too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from botorch.acquisition.acquisition import AcquisitionFunction
from botorch.models.gpytorch import GPyTorchModel
from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
from botorch.optim.fit import fit_gpytorch_mll_scipy
from botorch.optim.optimize import optimize_acqf
from gpytorch.distributions import MultitaskMultivariateNormal
from gpytorch.kernels import RBFKernelGrad
from gpytorch.likelihoods import MultitaskGaussianLikelihood
from gpytorch.means import ConstantMeanGrad
from gpytorch.mlls import ExactMarginalLogLikelihood
from gpytorch.models import ExactGP
from jaxtyping import Float
from linear_operator.utils.cholesky import psd_safe_cholesky
from torch import Tensor

from ..base import Kind, Optimizer, Points, Proposal
from ..memory import FLOAT, SearchSize
from ..options import MANY, MethodOptions, number
from ..processes import compute
from .surrogate import ARRAYS, BOUND_STEPS, FIT_STEPS, GROWTH, JITTER, NEAR, SPREAD, STARTS, exclusive

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


class BOGradient(Optimizer):
    """Evaluate where the lower confidence bound of a process over losses and gradients is least.

    The process has GPyTorch's squared-exponential covariance of a function and its slopes (`RBFKernelGrad`). A point
    with its gradient in d parameters makes d + 1 rows, and the cost grows with the cube of the rows: 1000 are modelled
    at most, those of the points with the least losses for one half and points spread over the run for the other. So it
    is for few parameters: of 10 it models 90 points, and more than 49, of which it could model 20, are refused. Where
    losses jump, slopes mislead it.
    """

    name = "bo-gradient"
    Options: ClassVar[type[BOGradientOptions]] = BOGradientOptions
    needs_grad = True

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate what the process takes [bytes]."""
        return float(FLOAT * (ARRAYS * ROWS**2 + (SPREAD + NEAR) * ROWS * (size.dim + 1)))

    def _setup(self) -> None:
        self.points = ROWS // (self.space.dim + 1)
        if self.points < LEAST:
            raise ValueError(
                f"{self.name} models slopes of {ROWS // LEAST - 1} parameters at most; this space has {self.space.dim}"
            )
        self.z: Points = np.empty((0, self.space.dim))
        self.loss: Points = np.empty(0)
        self.grad: Points = np.empty((0, self.space.dim))
        self.fitted, self.hyper = 0, dict[str, Points]()

    def _ask(self) -> Proposal:
        if len(self.loss) < self.options.initial or not np.isfinite(self.loss).any():
            z = self.random.uniform(-1.0, 1.0, (1, self.space.dim))
            return Proposal(torch.from_numpy(z), Kind.RANDOM, grad=True)
        known = (self.z, self.loss, self.grad)
        drawn = self.random.bit_generator.state
        fit = self.fitted == 0 or len(self.loss) >= GROWTH * self.fitted
        z, self.hyper, drawn = compute(_minimise, *known, self.options.coefficient, self.hyper, fit, self.points, drawn)
        self.fitted = len(self.loss) if fit else self.fitted
        self.random.bit_generator.state = drawn
        return Proposal(torch.from_numpy(z[None]), Kind.ACQUISITION, grad=True)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        assert grad is not None  # as asked
        self.z, self.grad = np.concatenate([self.z, z]), np.concatenate([self.grad, grad])
        self.loss = np.concatenate([self.loss, loss])


class GradientProcess(ExactGP, GPyTorchModel):  # type: ignore[misc]
    """A Gaussian process of a function with zero mean and its slopes, of points in [0, 1]^dim."""

    num_outputs = 1

    def __init__(self, u: Float[Tensor, "point dim"], rows: Float[Tensor, "point 1+dim"]) -> None:
        dim = u.shape[1]
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


class NegativeGradientBound(AcquisitionFunction):
    """The lower confidence bound's negative of the function alone, in the unit of the standardised losses."""

    def __init__(self, model: GradientProcess, coefficient: float) -> None:
        super().__init__(model)
        self.coefficient = coefficient
        known: Any = model  # which of its parts are modules, torch's types do not say
        self.kernel, self.known = known.covar_module, known.train_inputs[0]
        with torch.no_grad():
            values = known.train_targets.reshape(-1, 1)
            one = torch.eye(len(values), dtype=torch.float64)
            root = psd_safe_cholesky(self.kernel(self.known).to_dense() + known.likelihood.noise * one)
            self.root = torch.linalg.solve_triangular(root, one, upper=False).T.contiguous()
            self.weights = torch.cholesky_solve(values, root)[:, 0]

    def forward(self, X: Float[Tensor, "count 1 dim"]) -> Float[Tensor, " count"]:
        """Return coefficient * standard deviation - mean."""
        x = X[:, 0]
        covariance = self.kernel(x, self.known).to_dense()[:: x.shape[1] + 1]
        variance = 1.0 - (covariance @ self.root).square().sum(dim=1)
        bound: Tensor = self.coefficient * variance.clamp_min(1e-20).sqrt() - covariance @ self.weights
        return bound


def _minimise(
    z: Points,
    loss: Points,
    grad: Points,
    coefficient: float,
    hyper: Mapping[str, Points],
    fit: bool,
    points: int,
    drawn: Mapping[str, Any],
) -> tuple[Points, dict[str, Points], Mapping[str, Any]]:
    """Return where the bound is least, the hyper-parameters, and the random numbers then."""
    random = np.random.default_rng(0)
    random.bit_generator.state = drawn
    rows = standardised(loss, grad)
    with exclusive():
        if fit:
            hyper = _fitted(z, rows, loss, hyper, max(LEAST, FIT_ROWS // rows.shape[1]))
        model = _condition(z, rows, select(loss, points), hyper).eval()
        bound = NegativeGradientBound(model, coefficient)
        best, _ = optimize_acqf(
            bound,
            bounds=torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(2, z.shape[1]),
            q=1,
            num_restarts=STARTS,
            batch_initial_conditions=_starts(bound, z, loss, random)[:, None],
            options={"maxiter": BOUND_STEPS},
            retry_on_optimization_warning=False,
        )
    return np.asarray(2.0 * best[0].numpy() - 1.0), dict(hyper), random.bit_generator.state


def standardised(loss: Points, grad: Points) -> Points:
    """Return losses with mean 0 and deviation 1 and their slopes along [0, 1]^dim, shape (point, 1 + dim).

    A failure counts as the worst loss so far, with slopes of zero.
    """
    finite = np.isfinite(loss)
    known = np.where(finite, loss, loss[finite].max())
    large = max(1.0, float(np.abs(known).max()), float(np.abs(grad).max()))  # their squares might be no numbers
    spread = float((known / large).std()) * large or 1.0
    slopes = np.clip(2.0 * (grad / spread), -STEEPEST, STEEPEST)  # z is twice as wide as the unit box
    return np.concatenate([((known - known.mean()) / spread)[:, None], slopes], axis=1)


def select(loss: Points, count: int) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return which points are modelled: all, or half those with the least losses and half of the others, spread."""
    if len(loss) <= count:
        return np.arange(len(loss))
    best, others = np.split(np.argsort(loss, kind="stable"), [count // 2])
    spread = np.sort(others)[np.linspace(0, len(others) - 1, count - len(best)).astype(int)]
    return np.sort(np.concatenate([best, spread]))


def _condition(z: Points, rows: Points, chosen: Any, hyper: Mapping[str, Points]) -> GradientProcess:
    model = GradientProcess(torch.from_numpy((z[chosen] + 1.0) / 2.0), torch.from_numpy(rows[chosen]))
    with torch.no_grad():
        for name, value in model.named_parameters():
            if name in hyper:
                value.copy_(torch.from_numpy(hyper[name]))
    return model


def _fitted(z: Points, rows: Points, loss: Points, hyper: Mapping[str, Points], count: int) -> dict[str, Points]:
    model = _condition(z, rows, select(loss, count), hyper)
    fit_gpytorch_mll_scipy(ExactMarginalLogLikelihood(model.likelihood, model).train(), options={"maxiter": FIT_STEPS})
    return {name: value.detach().numpy().copy() for name, value in model.named_parameters()}


def _starts(
    bound: NegativeGradientBound, z: Points, loss: Points, random: np.random.Generator
) -> Float[Tensor, "start dim"]:
    """Return where the search for the least bound starts: the best of points all over, and near the best losses."""
    leaders = z[np.argsort(loss, kind="stable")[:8]]
    near = np.resize(leaders, (NEAR, z.shape[1])) + 2 * JITTER * random.standard_normal((NEAR, z.shape[1]))
    near[: len(leaders)] = leaders
    found = []
    for group in (random.uniform(-1.0, 1.0, (SPREAD, z.shape[1])), near.clip(-1.0, 1.0)):
        u = torch.from_numpy((group + 1.0) / 2.0)
        with torch.no_grad():
            found.append(u[bound(u[:, None]).topk(min(STARTS // 2, len(u))).indices])
    return torch.cat(found)
