"""A Gaussian process over the losses seen so far, and where its lower confidence bound is least."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args, get_type_hints

import numpy as np
import torch
from botorch.acquisition.acquisition import AcquisitionFunction
from botorch.exceptions.warnings import BotorchWarning
from botorch.models import SingleTaskGP
from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
from botorch.optim.fit import fit_gpytorch_mll_scipy
from botorch.optim.optimize import optimize_acqf
from gpytorch.means import ZeroMean
from gpytorch.mlls import ExactMarginalLogLikelihood
from gpytorch.utils.warnings import GPInputWarning
from jaxtyping import Float
from linear_operator.utils.cholesky import psd_safe_cholesky
from linear_operator.utils.warnings import NumericalWarning
from numpy.typing import NDArray
from torch import Tensor

from ..base import Points
from ..memory import FLOAT, SearchSize
from ..options import MANY, MethodOptions, number
from ..processes import compute
from .magnitude import tame

Rows = NDArray[np.intp]

ARRAYS = 10  # of points x points, that a Gaussian process makes (measured with BoTorch 0.16)
CANDIDATES = 600  # points from which the least value of its bound is looked for
GROWTH = 1.1  # hyper-parameters are fitted anew when there are this many times more points than at the last fit
FIT_STEPS = 30  # of L-BFGS, from where the last fit ended
BOUND_STEPS = 30  # of L-BFGS on the bound, from each start
FIT_POINTS = 300  # points to fit them to, evenly spread over the run: each step's cost grows with their cube
WORTH = 100  # points of a process from which on handing it to another process is worth while
STARTS, SPREAD, NEAR, JITTER = 6, 512, 64, 0.02  # of the search for the bound's least value: see `_starts`
# GPyTorch's settings and Python's warning filters belong to the process, not to a thread.
ONE_AT_A_TIME = threading.RLock()


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
            return self._minimise(random)
        dim, drawn = self.z.shape[1], random.bit_generator.state
        least, self._fitted, self._hyper, drawn = compute(_minimise_of, dim, self.options, self.state(), drawn)
        random.bit_generator.state = drawn
        return least

    def _minimise(self, random: np.random.Generator) -> Points:
        with exclusive():
            model = self.model()
            bound = NegativeBound(model, self.options.coefficient)
            best, _ = optimize_acqf(
                bound,
                bounds=torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(2, self.z.shape[1]),
                q=1,
                num_restarts=STARTS,
                batch_initial_conditions=self._starts(bound, random)[:, None],
                options={"maxiter": BOUND_STEPS},
                retry_on_optimization_warning=False,
            )
        return np.asarray(2.0 * best[0].numpy() - 1.0)

    def model(self) -> SingleTaskGP:
        """Return the process over [0, 1]^dim given the points, its hyper-parameters fitted if that is due."""
        with exclusive():
            count = len(self.loss)
            if self._fitted == 0 or count >= GROWTH * self._fitted:
                self._fit(_thin(np.arange(count), FIT_POINTS))
                self._fitted = count
            return self._condition(self._select()).eval()

    def _fit(self, rows: Rows) -> None:
        model = self._condition(rows)
        fit_gpytorch_mll_scipy(
            ExactMarginalLogLikelihood(model.likelihood, model).train(), options={"maxiter": FIT_STEPS}
        )
        self._hyper = {name: value.detach().numpy().copy() for name, value in model.named_parameters()}

    def _condition(self, rows: Rows) -> SingleTaskGP:
        """Return the process given some of the points, with the hyper-parameters of the last fit."""
        finite = np.isfinite(self.loss)
        loss = tame(np.where(finite, self.loss, self.loss[finite].max()))  # a failure counts as the worst so far
        dim = self.z.shape[1]
        model = SingleTaskGP(
            _unit(self.z[rows]),
            torch.from_numpy(loss[rows])[:, None],
            mean_module=ZeroMean(),
            covar_module=get_covar_module_with_dim_scaled_prior(dim, use_rbf_kernel=self.options.kernel == "rbf"),
        )
        with torch.no_grad():
            for name, value in model.named_parameters():
                if name in self._hyper:
                    value.copy_(torch.from_numpy(self._hyper[name]))
        return model

    def _select(self) -> Rows:
        """Return which points are modelled."""
        count = self.options.max_points
        if len(self.loss) <= count:
            return np.arange(len(self.loss))
        best, others = np.split(np.argsort(self.loss, kind="stable"), [count // 2])
        return np.sort(np.concatenate([best, _thin(np.sort(others), count - len(best))]))

    def _starts(self, bound: NegativeBound, random: np.random.Generator) -> Float[Tensor, "start dim"]:
        """Return where the search for the least bound starts: the best of many points all over, and near the best."""
        dim = self.z.shape[1]
        leaders = self.z[np.argsort(self.loss, kind="stable")[:8]]
        near = np.resize(leaders, (NEAR, dim)) + 2 * JITTER * random.standard_normal((NEAR, dim))
        near[: len(leaders)] = leaders
        groups = (random.uniform(-1.0, 1.0, (SPREAD, dim)), near.clip(-1.0, 1.0))
        with torch.no_grad():
            return torch.cat([u[bound(u[:, None]).topk(STARTS // 2).indices] for u in map(_unit, groups)])


def _minimise_of(
    dim: int, options: SurrogateOptions, state: Mapping[str, Any], drawn: Mapping[str, Any]
) -> tuple[Points, int, dict[str, Points], Mapping[str, Any]]:
    """Return where the bound of a surrogate in this state is least, what it has fitted, and its random numbers then."""
    surrogate, random = Surrogate(dim, options), np.random.default_rng(0)
    surrogate.restore(state)
    random.bit_generator.state = drawn
    return surrogate._minimise(random), surrogate._fitted, surrogate._hyper, random.bit_generator.state


def surrogate_memory(max_points: int, size: SearchSize) -> float:
    """Return what the process takes at the end of a search [bytes]."""
    points = min(max_points, size.budget)
    return float(FLOAT * (ARRAYS * points**2 + 20 * (CANDIDATES + points) * size.dim))


class NegativeBound(AcquisitionFunction):
    """The lower confidence bound's negative, which BoTorch makes as large as it can.

    It is that of BoTorch's `UpperConfidenceBound` for a model of one loss with zero mean, whose parameters are not
    transformed. What does not change from point to point is computed once: weights of the losses, and a root of the
    inverse covariance.
    """

    def __init__(self, model: SingleTaskGP, coefficient: float) -> None:
        super().__init__(model)
        self.coefficient = coefficient
        self.kernel, self.known = model.covar_module, model.train_inputs[0]
        with torch.no_grad():
            one = torch.eye(len(self.known), dtype=torch.float64)
            root = psd_safe_cholesky(self.kernel(self.known).to_dense() + model.likelihood.noise * one)
            self.root = torch.linalg.solve_triangular(root, one, upper=False).T.contiguous()
            self.weights = torch.cholesky_solve(model.train_targets[:, None], root)[:, 0]
        scale = cast(Any, model.outcome_transform)
        self.mean, self.spread = scale.means.squeeze(), scale.stdvs.squeeze()

    def forward(self, X: Float[Tensor, "count 1 dim"]) -> Float[Tensor, " count"]:
        """Return coefficient * standard deviation - mean."""
        x = X[:, 0]
        covariance = self.kernel(x, self.known).to_dense()
        variance = self.kernel(x, diag=True) - (covariance @ self.root).square().sum(dim=1)
        bound = self.coefficient * variance.clamp_min(1e-20).sqrt() - covariance @ self.weights
        return cast(Tensor, self.spread * bound - self.mean)


def _thin(rows: Rows, count: int) -> Rows:
    """Return at most so many of the rows, evenly spread."""
    return rows if len(rows) <= count else rows[np.linspace(0, len(rows) - 1, count).astype(int)]


def _unit(z: Points) -> Float[Tensor, "count dim"]:
    return torch.from_numpy((z + 1.0) / 2.0)


@contextmanager
def exclusive() -> Iterator[None]:
    """Keep other threads out, and quiet what is no news: iteration limits reached, jitter added to a covariance."""
    with ONE_AT_A_TIME, warnings.catch_warnings():
        for category in (BotorchWarning, NumericalWarning, GPInputWarning):
            warnings.simplefilter("ignore", category)
        yield
