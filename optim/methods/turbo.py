"""TuRBO-1: Bayesian optimisation in a trust region."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from linear_operator.utils.cholesky import psd_safe_cholesky

from ...landscapes.space import sobol
from ..base import Kind, Optimizer, Points, Proposal
from ..lockstep import Asking, compute_drawing
from ..memory import FLOAT, SearchSize
from ..options import MANY, MethodOptions, number
from .bound import exclusive
from .surrogate import Surrogate, SurrogateOptions, surrogate_memory

LONGEST, PERTURBED = 1.6, 20  # of a region's side, in widths of the box; parameters of a candidate that differ
IMPROVEMENT = 1e-3  # of the best loss, that a success lowers it by at least


@dataclass(frozen=True)
class TuRBOOptions(MethodOptions):
    """How the trust region changes; the defaults are those of Eriksson et al. 2019.

    A region's side is `length` widths of the box at first. It doubles after `successes` batches in a row that improve
    the best loss, and halves after as many in a row that do not as hold a point for each parameter, or four points;
    where it is shorter than `shortest` the search begins anew. `batch_size` points are drawn at a time, each where a
    sample of the process is least among `candidates` points of the region, 0 for 100 for each parameter and at most
    2000: more cost much and gain little.
    """

    method = "turbo"

    length: float = number(0.8, 1e-6, LONGEST)
    shortest: float = number(0.5**7, 1e-12, 1)
    successes: int = number(3, 1, MANY)
    batch_size: int = number(4, 1, 1000)
    candidates: int = number(0, 0, 100_000)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shortest >= self.length:
            raise ValueError(
                f"{self.method} option shortest takes less than the length {self.length}; got {self.shortest}"
            )


class TuRBO(Optimizer):
    """Search a trust region around the best point of a Gaussian process of its own (Eriksson et al., NeurIPS 2019).

    A search begins with 2 dim uniformly random points, of which the first search shares as many as it can with other
    methods of its seed; the paper's are a Latin hypercube. Then a process with a Matern-5/2 kernel is fitted
    to all its points, the region is a box around the best of them, longer where the length-scales are, and each point
    of a batch is where another sample of the process is least (Thompson sampling) among Sobol points of the region,
    which differ from the best in 20 parameters at most on average. A search whose region has become too short is given
    up, and another begins. The process is written here, since BoTorch's takes twice as long and finds no more.
    """

    name = "turbo"
    Options: ClassVar[type[TuRBOOptions]] = TuRBOOptions

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate what process and samples take [bytes]."""
        candidates = candidates_of(options["candidates"], size.dim)
        samples = 8 * FLOAT * (candidates**2 + candidates * size.dim)
        return float(surrogate_memory(MODELLED.max_points, size) + samples + 4 * FLOAT * size.dim**2)

    def _setup(self) -> None:
        self.failures = math.ceil(max(4.0, self.space.dim) / self.options.batch_size)
        self._begin()

    def _begin(self) -> None:
        self.surrogate = Surrogate(self.space.dim, MODELLED)
        self.length, self.best = self.options.length, math.inf
        self.succeeded = self.failed = 0
        self.first: Points = self.random.uniform(-1.0, 1.0, (2 * self.space.dim, self.space.dim))

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


MODELLED = SurrogateOptions(kernel="matern", initial=1)


def _sample(
    surrogate: Surrogate, options: TuRBOOptions, length: float, random: np.random.Generator
) -> tuple[Points, dict[str, Any]]:
    """Return a batch of points of the region, and what the process knows then."""
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
    """Return how many candidates an option asks for in so many dimensions."""
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
