"""A Gaussian process over the losses seen so far, and where its lower confidence bound is least.

BoTorch has priors, transforms and the optimiser of fits; covariances, posterior and bound are written here. The same
methods with BoTorch's models alone (SingleTaskGP, fits begun where the last ended, `condition_on_observations` between
them; RBFKernelGrad for bo-gradient) took, over three seeds of 100 episodes at draft, one core, BoTorch 0.18:

| scene (parameters) | method | own time of an episode [ms], ours, BoTorch's | ratio | mean best loss, ours, BoTorch's |
|---|---|---|---|---|
| pinball-2 (2) | bo | 10.5, 51.7 | 4.9 | 0.181, 0.245 |
| | bo-gradient | 16.3, 158 | 9.7 | 0.259, 0.249 |
| | turbo | 8.5, 16.5 | 1.9 | 0.184, 0.184 |
| | bo-descents | 5.5, 16.7 | 3.0 | 0.190, 0.309 |
| | bo-leap | 0.4, 0.5 | 1.2 | 0.171, 0.171 |
| bounce (3) | bo | 11.7, 74.4 | 6.4 | 0.0758, 0.0746 |
| | bo-gradient | 21.1, 215 | 10.2 | 0.600, 0.600 |
| | turbo | 12.0, 22.4 | 1.9 | 0.0717, 0.0713 |
| | bo-descents | 5.3, 15.7 | 3.0 | 0.0278, 0.0378 |
| | bo-leap | 0.8, 0.7 | 0.9 | 0.00014, 0.00014 |
| rope (30) | bo | 26.0, 120 | 4.6 | 10.3, 10.4 |

bo-leap uses a process once or twice in 100 episodes. The comparison of bo-gradient on rope had not ended after 20
minutes. One model for all seeds could save at most two thirds, which leaves bo and bo-gradient 1.6 to 3.4 times slower.
On three seeds BoTorch's models find nothing better; that is no statistical test.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_type_hints

import numpy as np
import torch
from botorch.exceptions.warnings import BotorchWarning
from botorch.models import SingleTaskGP
from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
from botorch.optim.batched_lbfgs_b import fmin_l_bfgs_b_batched
from gpytorch.means import ZeroMean
from gpytorch.models import ExactGP
from gpytorch.utils.warnings import GPInputWarning
from jaxtyping import Float
from linear_operator.utils.warnings import NumericalWarning
from numpy.typing import NDArray
from torch import Tensor

from ...landscapes.threads import one_torch_thread
from ..base import Part, Points, tame
from ..lockstep import Asking, compute_drawing
from ..memory import FLOAT, SearchSize
from ..options import MANY, PAPER, MethodOptions, choice, number
from .process import GROWTH, KERNELS, Covariance, Matrix, Process, fitted, with_parameters

STEPS = 30  # of L-BFGS on the bound, from each start
BOUND_TOLERANCE = 1e-4  # deviations of the losses: a step that lowers the bound by less is the last
STARTS, SPREAD, NEAR, JITTER = 4, 128, 32, 0.02  # of the search for its least value: see `_starts`
# GPyTorch's settings and Python's warning filters belong to the process, not to a thread.
ONE_AT_A_TIME = threading.RLock()
Rows = NDArray[np.intp]
ARRAYS = 16  # of points x points: ten that a process makes (measured with BoTorch 0.16), and factors kept
FIT_POINTS = 300  # points to fit hyper-parameters to, spread over the run: each step's cost grows with their cube
MIN_SPREAD = 1e-8  # of losses that are put in deviations from their average, as in BoTorch's `Standardize`


class LowerBound:
    """The lower confidence bound of a process, in standard deviations of the losses from their average.

    It equals BoTorch's `UpperConfidenceBound` with `maximize=False`, before the losses are scaled back, for a process
    of one function, alone or with its derivatives, with a variance of one far from data. Everything that is the same
    for all points is computed once: weights of the data, and a factor of the covariance.
    """

    @torch.no_grad()
    def __init__(self, process: Process, coefficient: float) -> None:
        self.coefficient = coefficient
        self.covariance, self.known = process.covariance, process.u
        self.factor = process.factor()
        self.weights = self.factor.weights(process.values)

    @torch.no_grad()
    def __call__(self, u: Float[Tensor, "count dim"]) -> Float[Tensor, " count"]:
        """Return mean - coefficient * standard deviation at points."""
        covariance = self.covariance.across(u, self.known)[0]
        deviation = _deviation(self.factor.whiten(covariance))
        return covariance @ self.weights - self.coefficient * deviation

    @torch.no_grad()
    def with_slope(self, u: Float[Tensor, "count dim"]) -> tuple[Float[Tensor, " count"], Float[Tensor, "count dim"]]:
        """Return the bound at points, and its derivatives."""
        covariance, pull = self.covariance.across(u, self.known)
        white = self.factor.whiten(covariance)
        deviation = _deviation(white)
        # variance = 1 - c K^-1 c, so that the deviation's slope by c is -K^-1 c / deviation
        by_covariance = self.weights + self.factor.solve_whitened(white) * (self.coefficient / deviation)[:, None]
        return covariance @ self.weights - self.coefficient * deviation, pull(by_covariance)


def _deviation(white: Matrix) -> Float[Tensor, " count"]:
    return (1.0 - white.square().sum(dim=1)).clamp_min(1e-20).sqrt()


def least_point(bound: LowerBound, z: Points, loss: Points, random: np.random.Generator) -> Points:
    """Return the point in [-1, 1]^dim with the lowest bound, shape (dim,), from the points z and losses so far."""

    def at(x: Points) -> tuple[Points, Points]:
        value, slope = bound.with_slope(torch.from_numpy(x))
        return value.numpy(), slope.numpy()

    starts = _starts(bound, z, loss, random).numpy()
    minimise: Any = fmin_l_bfgs_b_batched  # untyped
    how = {"bounds": [(0.0, 1.0)] * z.shape[1], "factr": None, "ftol": BOUND_TOLERANCE}
    found, least, _ = minimise(at, starts, maxiter=STEPS, **how)
    return np.asarray(2.0 * found[np.argmin(least)] - 1.0)


def _starts(bound: LowerBound, z: Points, loss: Points, random: np.random.Generator) -> Float[Tensor, "start dim"]:
    """Return the starts of the search for the lowest bound: the best of many points everywhere, and near the best."""
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
    """Keep other threads out, let torch use one core, and hide warnings of iteration limits and added jitter."""
    with ONE_AT_A_TIME, one_torch_thread(), warnings.catch_warnings():
        for category in (BotorchWarning, NumericalWarning, GPInputWarning):
            warnings.simplefilter("ignore", category)
        yield


@dataclass(frozen=True)
class SurrogateOptions(MethodOptions):
    """How losses are modelled, and how exploration and exploitation are balanced.

    `coefficient` is the number of standard deviations of the bound below the mean. `kernel` is squared-exponential or
    Matern-5/2, with a length-scale per parameter. Points are random until `initial` of them are known. Fewer points say
    nothing about length-scales, and the search would follow arbitrary ones. At most `max_points` points are modelled.
    Of more, half are those with the lowest losses, and half are others, spread evenly over the run. They are chosen
    again whenever the process is full or its length-scales are fitted.
    """

    method = "bo"

    coefficient: float = number(1.0, 0, 1e6, PAPER)
    kernel: Literal["rbf", "matern"] = choice("rbf", PAPER)
    initial: int = number(10, 1, MANY)
    max_points: int = number(1000, 2, MANY)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kernel not in (known := get_args(get_type_hints(SurrogateOptions)["kernel"])):
            raise ValueError(f"{self.method} option kernel takes {' or '.join(known)}; got {self.kernel}")


class Surrogate(Part):
    """Model losses over the box scaled to [-1, 1] by an exact Gaussian process, float64, with mean zero.

    Losses are standardised first, so zero is their average and one their deviation. Otherwise a search that has seen
    only losses above a hundred would expect low losses everywhere. Hyper-parameters (length-scales and noise) maximise
    the marginal likelihood times BoTorch's priors, which scale with the dimension (Hvarfner et al. 2024). With fewer
    points than dimensions the likelihood alone would decide nothing. They are fitted to at most 300 points, evenly
    spread over the run, and again whenever the data have grown by a tenth. The process itself contains all points.
    """

    def __init__(self, dim: int, options: SurrogateOptions) -> None:
        self.options = options
        self.z: Points = np.empty((0, dim))
        self.loss: Points = np.empty(0)
        self._fitted = 0  # points at the last fit
        self._hyper: dict[str, Points] = {}  # see `fit.fitted`
        self._chosen: Rows = np.empty(0, np.intp)  # those modelled of the first `_seen` points; all later ones are, too
        self._seen = 0

    @property
    def informed(self) -> bool:
        """Whether there are enough points to use the process, and a loss among them."""
        return len(self.loss) >= self.options.initial and bool(np.isfinite(self.loss).any())

    def add(self, z: Points, loss: Points) -> None:
        """Take points, shape (count, dim), and their losses, shape (count,), +inf where an episode failed."""
        self.z = np.concatenate([self.z, z])
        self.loss = np.concatenate([self.loss, loss])

    def minimise(self, random: np.random.Generator) -> Asking[Points]:
        """Return the point with the lowest bound, shape (dim,); a random point before there are enough."""
        if not self.informed:
            return np.asarray(random.uniform(-1.0, 1.0, self.z.shape[1]))
        least, learnt = yield from compute_drawing(random, _minimise, self)
        self.restore(learnt)
        return least

    def process(self) -> Process:
        """Return the process over [0, 1]^dim for the points, its hyper-parameters fitted if that is due."""
        with exclusive():
            rows = self._learn()
            u, values = self._places(rows), torch.from_numpy(self._values(rows))
            return Process(self._covariance(), float(self._hyper["noise"][0]), u, values, len(self._chosen))

    def _learn(self) -> Rows:
        """Fit hyper-parameters and choose points again if that is due, and return which points are modelled."""
        count = len(self.loss)
        due = self._fitted == 0 or count >= GROWTH * self._fitted
        if due:
            self._hyper, self._fitted = fitted(self._to_fit()), count
        most = self.options.max_points
        if due or len(self._chosen) + count - self._seen > most:
            room = most if count <= most else max(1, int(most / GROWTH))
            self._chosen, self._seen = select(self.loss, room), count
        return np.concatenate([self._chosen, np.arange(self._seen, count)])

    def _to_fit(self) -> ExactGP:
        """Return the model whose hyper-parameters are fitted."""
        return self._condition(_thin(np.arange(len(self.loss)), FIT_POINTS))

    def _places(self, rows: Rows) -> Float[Tensor, "point column"]:
        """Return points as the covariance takes them."""
        return unit(self.z[rows])

    def _covariance(self) -> Covariance:
        return KERNELS[self.options.kernel](torch.from_numpy(self._hyper["scale"]))

    def _values(self, rows: Rows) -> Points:
        """Return a number for each row of the process: losses in deviations from their average, as BoTorch has them."""
        loss = self._losses()[rows]
        spread = float(loss.std(ddof=1)) if len(loss) > 1 else 0.0
        return np.asarray((loss - loss.mean()) / (spread if spread >= MIN_SPREAD else 1.0))

    def _losses(self) -> Points:
        finite = np.isfinite(self.loss)
        return tame(np.where(finite, self.loss, self.loss[finite].max()))  # a failure counts as the worst so far

    def _condition(self, rows: Rows) -> SingleTaskGP:
        """Return BoTorch's model of some of the points, with the hyper-parameters of the last fit."""
        dim = self.z.shape[1]
        model = SingleTaskGP(
            unit(self.z[rows]),
            torch.from_numpy(self._losses()[rows])[:, None],
            mean_module=ZeroMean(),
            covar_module=get_covar_module_with_dim_scaled_prior(dim, use_rbf_kernel=self.options.kernel == "rbf"),
        )
        return with_parameters(model, self._hyper)


def _minimise(surrogate: Surrogate, random: np.random.Generator) -> tuple[Points, dict[str, Any]]:
    """Return the point with the lowest bound of a surrogate, and the new state of the surrogate."""
    with exclusive():
        bound = LowerBound(surrogate.process(), surrogate.options.coefficient)
        return least_point(bound, surrogate.z, surrogate.loss, random), surrogate.state()


def surrogate_memory(max_points: int, size: SearchSize) -> float:
    """Return the memory of the process at the end of a search [bytes]."""
    points = min(max_points, size.budget)
    return float(FLOAT * (ARRAYS * points**2 + 20 * (SPREAD + NEAR + points) * size.dim))


def _thin(rows: Rows, count: int) -> Rows:
    """Return at most this many of the rows, evenly spread."""
    return rows if len(rows) <= count else rows[np.linspace(0, len(rows) - 1, count).astype(int)]


def select(loss: Points, count: int) -> Rows:
    """Return which points are modelled: all, or the best for one half and evenly spread others for the second half."""
    if len(loss) <= count:
        return np.arange(len(loss))
    best, others = np.split(np.argsort(loss, kind="stable"), [count // 2])
    return np.sort(np.concatenate([best, _thin(np.sort(others), count - len(best))]))
