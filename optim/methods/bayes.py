"""Bayesian optimisation: alone, followed by gradient descents, with gradients, and in a trust region (TuRBO-1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

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
from linear_operator.utils.cholesky import psd_safe_cholesky
from torch import Tensor

from ...landscapes.space import sobol
from ..base import Kind, Optimizer, Points, Proposal
from ..lockstep import Asking, compute_drawing
from ..memory import FLOAT, SearchSize
from ..options import MANY, MethodOptions, number
from .descent import Descent, DescentOptions
from .process import GradientCovariance, with_parameters
from .surrogate import (
    ARRAYS,
    NEAR,
    SPREAD,
    Rows,
    Surrogate,
    SurrogateOptions,
    exclusive,
    select,
    surrogate_memory,
    unit,
)

ROWS, MIN_POINTS = 1000, 20  # losses and slopes that are modelled; points of them at least: so many parameters at most
FIT_ROWS = 400  # of them that hyper-parameters are fitted to
STEEPEST = 1e3  # deviations of the losses per width of the box, that a slope counts as at most
LONGEST, PERTURBED = 1.6, 20  # of a region's side, in widths of the box; parameters of a candidate that differ
IMPROVEMENT = 1e-3  # of the best loss, that a success lowers it by at least
TURBO = "its authors' (Eriksson et al. 2019)"  # whose choice a default is
MODELLED = SurrogateOptions(kernel="matern", initial=1)


class BO(Optimizer):
    """Evaluate the point that minimises the lower confidence bound of a Gaussian process over all losses.

    It evaluates one point after the other, without gradients. The first `initial` points are random, because a process
    without data is the same everywhere. The process is our own code, because BoTorch's takes five times as long.
    """

    name = "bo"
    Options: ClassVar[type[MethodOptions]] = SurrogateOptions
    surrogate: Surrogate

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate the memory of the process [bytes]."""
        return surrogate_memory(options["max_points"], size)

    def _setup(self) -> None:
        self.surrogate = Surrogate(self.space.dim, self.options)

    def learn(self, z: Points, loss: Points) -> None:
        """Model these points, too."""
        self.surrogate.add(z, loss)

    def _ask(self) -> Asking[Proposal]:
        kind = Kind.ACQUISITION if self.surrogate.informed else Kind.RANDOM
        z = yield from self.surrogate.minimise(self.random)
        return Proposal(torch.from_numpy(z[None]), kind, grad=self.needs_grad)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        self.surrogate.add(z, loss)


@dataclass(frozen=True)
class BODescentsOptions(SurrogateOptions, DescentOptions):
    """The options of the process and of each descent."""

    method = "bo-descents"


class BODescents(BO):
    """Descend from the minimum of the lower confidence bound; the process learns the loss of every iterate.

    The first starts are random. Only the descents use gradients: the process uses losses.
    """

    name = "bo-descents"
    Options = BODescentsOptions
    needs_grad = True

    def _setup(self) -> None:
        super()._setup()
        self.descent = Descent(np.zeros(self.space.dim), self.options, done=True)

    def _ask(self) -> Asking[Proposal]:
        kind = Kind.DESCENT
        if self.descent.done:
            kind = Kind.ACQUISITION if self.surrogate.informed else Kind.RANDOM
            self.descent = Descent((yield from self.surrogate.minimise(self.random)), self.options)
        return Proposal(torch.from_numpy(self.descent.at[None]), kind, grad=True)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        assert grad is not None  # as asked
        self.surrogate.add(z, loss)
        self.descent.tell(float(loss[0]), grad[0])


@dataclass(frozen=True)
class BOGradientOptions(MethodOptions):
    """Options for the balance of exploration and exploitation.

    `coefficient` is the number of standard deviations of the bound below the mean. Points are random until `initial` of
    them are known.
    """

    method = "bo-gradient"

    coefficient: float = number(1.0, 0, 1e6)
    initial: int = number(10, 2, MANY)


class BOGradient(BO):
    """Evaluate the point that minimises the lower confidence bound of a process over losses and gradients.

    The process has GPyTorch's squared-exponential covariance of a function and its derivatives (`RBFKernelGrad`). A
    point with its gradient in d parameters makes d + 1 rows, and the cost grows with the cube of the rows. So at most
    1000 rows are modelled: half of the points have the lowest losses, the others are spread over the run. The method is
    for few parameters. With 10 it models 90 points. With more than 49 it could model only 20 points, and refuses. A
    point with a loss but no gradient is one row. Where losses jump, gradients mislead it. The process is our own code,
    because GPyTorch's takes ten times as long.
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
        if points < MIN_POINTS:
            raise ValueError(
                f"{self.name} models gradients in at most {ROWS // MIN_POINTS - 1} parameters; this space has "
                f"{self.space.dim}"
            )
        self.surrogate = SlopeSurrogate(self.space.dim, self.options, points)

    def learn(self, z: Points, loss: Points) -> None:
        """Model these points, too, without gradients."""
        self.surrogate.learn(z, loss, np.full_like(z, np.nan))

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        assert grad is not None  # as asked
        self.surrogate.learn(z, loss, grad)


class SlopeSurrogate(Surrogate):
    """Model losses and their gradients by one process; see `Surrogate`."""

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
        chosen = select(self.loss, max(MIN_POINTS, FIT_ROWS // (1 + self.z.shape[1])))
        rows = torch.from_numpy(standardised(self.loss, self.grad)[chosen])
        return with_parameters(GradientProcess(self._places(chosen), rows), self._hyper)

    def _places(self, rows: Rows) -> Float[Tensor, "point column"]:
        """Return points of [0, 1]^dim, with a column that marks missing gradients if there are any."""
        lacking = np.isnan(self.grad[rows]).any(axis=1, keepdims=True)
        return torch.from_numpy(np.hstack([unit(self.z[rows]), lacking])) if lacking.any() else unit(self.z[rows])

    def _covariance(self) -> GradientCovariance:
        return GradientCovariance(torch.from_numpy(self._hyper["scale"]))

    def _values(self, rows: Rows) -> Points:
        return standardised(self.loss, self.grad)[rows].ravel()


class GradientProcess(ExactGP, GPyTorchModel):  # type: ignore[misc]
    """A Gaussian process of a function with zero mean and its derivatives, at points in [0, 1]^dim."""

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
        """Return the distribution of the function and its derivatives at points."""
        return MultitaskMultivariateNormal(self.mean_module(u), self.covar_module(u))


def standardised(loss: Points, grad: Points) -> Points:
    """Return losses with mean 0 and deviation 1 and their derivatives along [0, 1]^dim, shape (point, 1 + dim).

    A failure counts as the worst loss so far, with zero derivatives; missing derivatives are zero, too.
    """
    grad = np.where(np.isnan(grad), 0.0, grad)
    finite = np.isfinite(loss)
    known = np.where(finite, loss, loss[finite].max())
    large = max(1.0, float(np.abs(known).max()), float(np.abs(grad).max()))  # their squares might be no numbers
    spread = float((known / large).std()) * large or 1.0
    slopes = np.clip(2.0 * (grad / spread), -STEEPEST, STEEPEST)  # z is twice as wide as the unit box
    return np.concatenate([((known - known.mean()) / spread)[:, None], slopes], axis=1)


@dataclass(frozen=True)
class TuRBOOptions(MethodOptions):
    """How the trust region changes; lengths and successes are those of Eriksson et al. 2019.

    The side of a region is initially `length` box widths. It doubles after `successes` batches in a row that improve
    the best loss. It halves after consecutive batches without improvement that together have as many points as there
    are parameters, and at least four. When it is shorter than `shortest`, the search starts again. Each batch has
    `batch_size` points. Each of them minimises a sample of the process among `candidates` points of the region. 0 means
    100 for each parameter, at most 2000: more cost much and gain little.
    """

    method = "turbo"

    length: float = number(0.8, 1e-6, LONGEST, TURBO)
    shortest: float = number(0.5**7, 1e-12, 1, TURBO)
    successes: int = number(3, 1, MANY, TURBO)
    batch_size: int = number(4, 1, 1000)
    candidates: int = number(0, 0, 100_000)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shortest >= self.length:
            raise ValueError(
                f"{self.method} option shortest must be below the length {self.length}; got {self.shortest}"
            )


class TuRBO(Optimizer):
    """Search a trust region around the best point of a Gaussian process of its own (Eriksson et al., NeurIPS 2019).

    A search begins with 2 dim uniformly random points. The first search shares as many of them as it can with other
    methods of its seed; the paper uses a Latin hypercube. A process with a Matern-5/2 kernel is then fitted to all its
    points. The region is a box around the best of them, longer where the length-scales are longer. Each point of a
    batch minimises another sample of the process (Thompson sampling) among Sobol points of the region. These differ
    from the best point in at most 20 parameters on average. When the region becomes too short, the search is abandoned
    and another begins. The process is our own code, because BoTorch's takes twice as long.
    """

    name = "turbo"
    Options: ClassVar[type[TuRBOOptions]] = TuRBOOptions

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate the memory of process and samples [bytes]."""
        candidates = candidates_of(options["candidates"], size.dim)
        samples = 8 * FLOAT * (candidates**2 + candidates * size.dim)
        return float(surrogate_memory(MODELLED.max_points, size) + samples + 4 * FLOAT * size.dim**2)

    first: Points

    def _setup(self) -> None:
        self.failures = math.ceil(max(4.0, self.space.dim) / self.options.batch_size)
        self._begin()

    def learn(self, z: Points, loss: Points) -> None:
        """Begin with these points instead of random ones."""
        self.surrogate.add(z, loss)
        self.first, self.best = self.first[:0], float(loss.min())

    def _begin(self) -> None:
        self.surrogate = Surrogate(self.space.dim, MODELLED)
        self.length, self.best = self.options.length, math.inf
        self.succeeded = self.failed = 0
        self.first = self.random.uniform(-1.0, 1.0, (2 * self.space.dim, self.space.dim))

    def _ask(self) -> Asking[Proposal]:
        if len(self.first):
            return Proposal(torch.from_numpy(self.first[: self.options.batch_size].copy()), Kind.RANDOM)
        if not np.isfinite(self.surrogate.loss).any():
            z = self.random.uniform(-1.0, 1.0, (self.options.batch_size, self.space.dim))
            return Proposal(torch.from_numpy(z), Kind.RANDOM)
        z, learnt = yield from compute_drawing(self.random, _sample, self.surrogate, self.options, self.length)
        self.surrogate.restore(learnt)
        return Proposal(torch.from_numpy(z), Kind.ACQUISITION)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        self.surrogate.add(z, loss)
        least = float(loss.min())
        if len(self.first):
            self.first, self.best = self.first[len(z) :], min(self.best, least)
            return
        if least < self.best - IMPROVEMENT * abs(self.best):
            self.succeeded, self.failed = self.succeeded + 1, 0
        else:
            self.succeeded, self.failed = 0, self.failed + 1
        self.best = min(self.best, least)
        if self.succeeded == self.options.successes:
            self.length, self.succeeded = min(2.0 * self.length, LONGEST), 0
        elif self.failed == self.failures:
            self.length, self.failed = self.length / 2.0, 0
        if self.length < self.options.shortest:
            self._begin()


def _sample(
    surrogate: Surrogate, options: TuRBOOptions, length: float, random: np.random.Generator
) -> tuple[Points, dict[str, Any]]:
    """Return a batch of points of the region, and the present knowledge of the process."""
    with exclusive():
        process = surrogate.process()
        scales, count = process.covariance.scale.numpy(), candidates_of(options.candidates, surrogate.z.shape[1])
        candidates = torch.from_numpy(region(surrogate, scales, length, count, random))
        mean, covariance = process.posterior(candidates)
        drawn = torch.from_numpy(random.standard_normal((count, options.batch_size)))
        samples = (mean[:, None] + psd_safe_cholesky(covariance) @ drawn).numpy()
    chosen = candidates.numpy()[samples.argmin(axis=0)]
    return 2.0 * chosen - 1.0, surrogate.state()


def candidates_of(option: int, dim: int) -> int:
    """Return the number of candidates that an option gives in this dimension."""
    return option or min(100 * dim, 2000)


def region(surrogate: Surrogate, scales: Points, length: float, count: int, random: np.random.Generator) -> Points:
    """Return candidates of the trust region in [0, 1]^dim, shape (count, dim): the best point, partly exchanged."""
    dim = surrogate.z.shape[1]
    best = (surrogate.z[np.argmin(surrogate.loss)] + 1.0) / 2.0
    weights = scales / scales.mean()
    weights = weights / np.prod(weights ** (1.0 / dim))
    low, high = (np.clip(best + sign * weights * length / 2.0, 0.0, 1.0) for sign in (-1.0, 1.0))
    drawn = low + (high - low) * sobol(count, dim, seed=int(random.integers(1 << 31))).numpy()
    exchanged = random.uniform(size=(count, dim)) <= min(PERTURBED / dim, 1.0)
    exchanged[np.arange(count), random.integers(dim, size=count)] |= ~exchanged.any(axis=1)
    return np.asarray(np.where(exchanged, drawn, best))
