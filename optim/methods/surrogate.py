"""A Gaussian process over the losses seen so far, and where its lower confidence bound is least."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, get_args, get_type_hints

import numpy as np
import torch
from botorch.models import SingleTaskGP
from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
from botorch.optim.fit import fit_gpytorch_mll_scipy
from gpytorch.means import ZeroMean
from gpytorch.mlls import ExactMarginalLogLikelihood
from gpytorch.models import ExactGP
from numpy.typing import NDArray
from torch import Tensor

from ..base import Points
from ..memory import FLOAT, SearchSize
from ..options import MANY, MethodOptions, number
from ..processes import compute_drawing
from .bound import NEAR, SPREAD, LowerBound, exclusive, least_point, unit
from .magnitude import tame
from .radial import Radial, marginal_likelihood

Rows = NDArray[np.intp]
Process = TypeVar("Process", bound=ExactGP)

ARRAYS = 16  # of points x points: ten that a process makes (measured with BoTorch 0.16), and factors kept
GROWTH = 1.1  # hyper-parameters are fitted anew when there are this many times more points than at the last fit
FIT_STEPS = 30  # of L-BFGS, from where the last fit ended
FIT_POINTS = 300  # points to fit them to, evenly spread over the run: each step's cost grows with their cube
WORTH = 100  # points of a process from which on handing it to another process is worth while


@dataclass(frozen=True)
class SurrogateOptions(MethodOptions):
    """How losses are modelled, and how much is ventured where little is known.

    `coefficient` is how many standard deviations the bound lies below the mean. `kernel` is squared-exponential or
    Matern-5/2, with a length-scale per parameter. Points are drawn at random until `initial` of them are known: fewer
    say nothing about length-scales, and the search would settle on what they suggest. `max_points` points are
    modelled: of more, the half with the least losses, and as many of the others, spread evenly over the run.
    """

    method = "bo"

    coefficient: float = number(1.0, 0, 1e6)
    kernel: Literal["rbf", "matern"] = "rbf"
    initial: int = number(10, 1, MANY)
    max_points: int = number(1000, 2, MANY)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kernel not in (known := get_args(get_type_hints(SurrogateOptions)["kernel"])):
            raise ValueError(f"{self.method} option kernel takes {' or '.join(known)}; got {self.kernel}")


class Surrogate:
    """Model losses over the box scaled to [-1, 1] by an exact Gaussian process, float64, whose mean is zero.

    Losses are standardised before, so that zero is their average and one their spread: a raw zero mean would promise
    low losses everywhere to a search that has seen none below a hundred. Hyper-parameters (length-scales and noise)
    maximise the marginal likelihood times BoTorch's priors, which scale with the dimension (Hvarfner et al. 2024): with
    fewer points than dimensions the likelihood alone would decide nothing. They are fitted to at most 300 points,
    evenly spread over the run, and anew whenever the data have grown by a tenth; the process itself holds all points.
    """

    def __init__(self, dim: int, options: SurrogateOptions) -> None:
        self.options = options
        self.z: Points = np.empty((0, dim))
        self.loss: Points = np.empty(0)
        self._fitted = 0  # points at the last fit
        self._hyper: dict[str, Points] = {}

    @property
    def informed(self) -> bool:
        """Whether there are points enough to ask the process, and a loss among them."""
        return len(self.loss) >= self.options.initial and bool(np.isfinite(self.loss).any())

    def add(self, z: Points, loss: Points) -> None:
        """Take in points, shape (count, dim), and their losses, shape (count,), +inf where an episode failed."""
        self.z = np.concatenate([self.z, z])
        self.loss = np.concatenate([self.loss, loss])

    def state(self) -> dict[str, Any]:
        """Return what the process knows, as data."""
        return {"z": self.z, "loss": self.loss, "fitted": self._fitted, "hyper": self._hyper}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take back what `state` returned."""
        self.z, self.loss = state["z"].reshape(-1, self.z.shape[1]), state["loss"]
        self._fitted, self._hyper = int(state["fitted"]), dict(state["hyper"])

    def minimise(self, random: np.random.Generator) -> Points:
        """Return where mean - coefficient * standard deviation is least, shape (dim,); a random point before."""
        if not self.informed:
            return np.asarray(random.uniform(-1.0, 1.0, self.z.shape[1]))
        if len(self.loss) < WORTH:
            return _minimise(self, random)[0]
        least, learnt = compute_drawing(random, _minimise, self)
        self.restore(learnt)
        return least

    def model(self) -> SingleTaskGP:
        """Return the process over [0, 1]^dim given the points, its hyper-parameters fitted if that is due."""
        with exclusive():
            count = len(self.loss)
            if self._fitted == 0 or count >= GROWTH * self._fitted:
                self._hyper = fitted(self._condition(_thin(np.arange(count), FIT_POINTS)))
                self._fitted = count
            return self._condition(select(self.loss, self.options.max_points)).eval()

    @property
    def first(self) -> int | None:
        """How many of the points, the first, it was fitted to last; None where it no longer holds all of them."""
        return self._fitted if len(self.loss) <= self.options.max_points else None

    def _condition(self, rows: Rows) -> SingleTaskGP:
        """Return the process given some of the points, with the hyper-parameters of the last fit."""
        finite = np.isfinite(self.loss)
        loss = tame(np.where(finite, self.loss, self.loss[finite].max()))  # a failure counts as the worst so far
        dim = self.z.shape[1]
        model = SingleTaskGP(
            unit(self.z[rows]),
            torch.from_numpy(loss[rows])[:, None],
            mean_module=ZeroMean(),
            covar_module=get_covar_module_with_dim_scaled_prior(dim, use_rbf_kernel=self.options.kernel == "rbf"),
        )
        return with_parameters(model, self._hyper)


def _minimise(surrogate: Surrogate, random: np.random.Generator) -> tuple[Points, dict[str, Any]]:
    """Return where the bound of a surrogate is least, and what it knows then."""
    with exclusive():
        bound = LowerBound(surrogate.model(), surrogate.options.coefficient, surrogate.first)
        return least_point(bound, surrogate.z, surrogate.loss, random), surrogate.state()


def surrogate_memory(max_points: int, size: SearchSize) -> float:
    """Return what the process takes at the end of a search [bytes]."""
    points = min(max_points, size.budget)
    return float(FLOAT * (ARRAYS * points**2 + 20 * (SPREAD + NEAR + points) * size.dim))


def _thin(rows: Rows, count: int) -> Rows:
    """Return at most so many of the rows, evenly spread."""
    return rows if len(rows) <= count else rows[np.linspace(0, len(rows) - 1, count).astype(int)]


def select(loss: Points, count: int) -> Rows:
    """Return which points are modelled: all, or half those with the least losses and half of the others, spread."""
    if len(loss) <= count:
        return np.arange(len(loss))
    best, others = np.split(np.argsort(loss, kind="stable"), [count // 2])
    return np.sort(np.concatenate([best, _thin(np.sort(others), count - len(best))]))


def fitted(model: ExactGP) -> dict[str, Points]:
    """Return the parameters at which marginal likelihood times priors is largest, from where they are, by name."""
    likelihood = ExactMarginalLogLikelihood(model.likelihood, model).train()
    how: dict[str, Any] = {"closure": closure_of(likelihood)} if isinstance(model, SingleTaskGP) else {}
    fit_gpytorch_mll_scipy(likelihood, dict(likelihood.named_parameters()), options={"maxiter": FIT_STEPS}, **how)
    return {name: value.detach().numpy().copy() for name, value in model.named_parameters()}


def closure_of(likelihood: ExactMarginalLogLikelihood) -> Callable[[], tuple[Tensor, list[Tensor]]]:
    """Return what gives minus the logarithm of likelihood times priors, for each point, and its slopes by parameters.

    It is what BoTorch's closure gives for a process without mean whose parameters are not transformed.
    """
    model = likelihood.model
    u, values, parameters = model.train_inputs[0], model.train_targets, list(likelihood.parameters())

    def closure() -> tuple[Tensor, list[Tensor]]:
        kernel, noise = model.covar_module, model.likelihood.noise
        with torch.no_grad():
            found = marginal_likelihood(Radial.of(kernel), float(noise), u, values)
        # what is linear in the parameters with these slopes has the likelihood's slopes
        linear = (kernel.lengthscale.reshape(-1) * found.scale).sum() + (noise * found.noise).sum()
        priors = sum(prior.log_prob(of(module)).sum() for _, module, prior, of, _ in model.named_priors())
        slopes = torch.autograd.grad(-(linear + priors) / len(values), parameters)
        return -(found.value + priors.detach()) / len(values), list(slopes)

    return closure


def with_parameters(model: Process, parameters: Mapping[str, Points]) -> Process:
    """Return a process, those of its parameters that are named set to these."""
    with torch.no_grad():
        for name, value in model.named_parameters():
            if name in parameters:
                value.copy_(torch.from_numpy(parameters[name]))
    return model
