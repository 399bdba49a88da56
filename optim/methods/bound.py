"""The lower confidence bound of a Gaussian process over [0, 1]^dim, and where it is least."""

from __future__ import annotations

import threading
import warnings
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import torch
from botorch.acquisition.acquisition import AcquisitionFunction
from botorch.exceptions.warnings import BotorchWarning
from botorch.optim.optimize import optimize_acqf
from gpytorch.models import ExactGP
from gpytorch.utils.warnings import GPInputWarning
from jaxtyping import Float
from linear_operator.utils.cholesky import psd_safe_cholesky
from linear_operator.utils.warnings import NumericalWarning
from torch import Tensor

from ..base import Points

STEPS = 30  # of L-BFGS on the bound, from each start
STARTS, SPREAD, NEAR, JITTER = 6, 128, 32, 0.02  # of the search for its least value: see `_starts`
KEPT = 64  # roots; fewer than the searches that go on abreast would be lost before they are asked for again
# GPyTorch's settings and Python's warning filters belong to the process, not to a thread.
ONE_AT_A_TIME = threading.RLock()
_roots: OrderedDict[tuple[Any, ...], Tensor] = OrderedDict()  # by kernel and bytes of points, noise, parameters


class NegativeBound(AcquisitionFunction):
    """The lower confidence bound's negative, which BoTorch makes as large as it can.

    It is that of BoTorch's `UpperConfidenceBound` for a model of one function, alone or with its slopes, with zero mean
    and a variance of one where nothing is known, whose parameters are not transformed. What does not change from point
    to point is computed once: weights of what is known, and a root of the inverse covariance. The root of the `first`
    points, which the process was fitted to, is kept for the next bound of the same process.
    """

    def __init__(self, model: ExactGP, coefficient: float, first: int | None = None) -> None:
        super().__init__(model)
        known: Any = model  # which of its parts are modules, torch's types do not say
        self.coefficient = coefficient
        self.kernel, self.known = known.covar_module, known.train_inputs[0]
        with torch.no_grad():
            values = known.train_targets.reshape(-1)
            self.root = inverse_root(self.kernel, self.known, known.likelihood.noise, first)
            self.weights = self.root @ (self.root.T @ values)
        self.rows = len(values) // len(self.known)  # of a point: its value, and slopes where they are modelled
        scale = getattr(known, "outcome_transform", None)
        self.mean: Tensor | float = scale.means.squeeze() if scale else 0.0
        self.spread: Tensor | float = scale.stdvs.squeeze() if scale else 1.0

    def forward(self, X: Float[Tensor, "count 1 dim"]) -> Float[Tensor, " count"]:
        """Return coefficient * standard deviation - mean."""
        covariance = self.kernel(X[:, 0], self.known).to_dense()[:: self.rows]
        variance = 1.0 - (covariance @ self.root).square().sum(dim=1)
        bound = self.coefficient * variance.clamp_min(1e-20).sqrt() - covariance @ self.weights
        return cast(Tensor, self.spread * bound - self.mean)


def inverse_root(
    kernel: Any, points: Float[Tensor, "point dim"], noise: Tensor, first: int | None
) -> Float[Tensor, "row row"]:
    """Return R, upper triangular, with R R^T the inverse of the points' covariance and noise.

    That of the first points is computed once for each process and so many of them; R of all follows by blocks.
    """
    if first is None:
        return _root_of(kernel(points).to_dense(), noise)
    head, tail = points[:first], points[first:]
    known = _kept_root(kernel, head, noise)
    if not len(tail):
        return known
    across = kernel(tail, head).to_dense() @ known
    own = _root_of(kernel(tail).to_dense() - across @ across.T, noise)
    root = torch.zeros((len(known) + len(own),) * 2, dtype=torch.float64)
    root[: len(known), : len(known)] = known
    root[: len(known), len(known) :] = -known @ (across.T @ own)
    root[len(known) :, len(known) :] = own
    return root


def _kept_root(kernel: Any, points: Float[Tensor, "point dim"], noise: Tensor) -> Float[Tensor, "row row"]:
    arrays = (points, noise, *kernel.state_dict().values())
    key = (type(kernel), *(array.detach().contiguous().numpy().tobytes() for array in arrays))
    if key not in _roots:
        _roots[key] = _root_of(kernel(points).to_dense(), noise)
    _roots.move_to_end(key)
    if len(_roots) > KEPT:
        _roots.popitem(last=False)
    return _roots[key]


def _root_of(covariance: Float[Tensor, "row row"], noise: Tensor) -> Float[Tensor, "row row"]:
    one = torch.eye(len(covariance), dtype=torch.float64)
    lower = psd_safe_cholesky(covariance + noise * one)
    return cast(Tensor, torch.linalg.solve_triangular(lower, one, upper=False).T.contiguous())


def least_point(bound: NegativeBound, z: Points, loss: Points, random: np.random.Generator) -> Points:
    """Return where in [-1, 1]^dim the bound is least, shape (dim,), given the points z and their losses so far."""
    best, _ = optimize_acqf(
        bound,
        bounds=torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(2, z.shape[1]),
        q=1,
        num_restarts=STARTS,
        batch_initial_conditions=_starts(bound, z, loss, random)[:, None],
        options={"maxiter": STEPS},
        retry_on_optimization_warning=False,
    )
    return np.asarray(2.0 * best[0].numpy() - 1.0)


def _starts(bound: NegativeBound, z: Points, loss: Points, random: np.random.Generator) -> Float[Tensor, "start dim"]:
    """Return where the search for the least bound starts: the best of many points all over, and near the best."""
    leaders = z[np.argsort(loss, kind="stable")[:8]]
    near = np.resize(leaders, (NEAR, z.shape[1])) + 2 * JITTER * random.standard_normal((NEAR, z.shape[1]))
    near[: len(leaders)] = leaders
    groups = (random.uniform(-1.0, 1.0, (SPREAD, z.shape[1])), near.clip(-1.0, 1.0))
    with torch.no_grad():
        return torch.cat([u[bound(u[:, None]).topk(STARTS // 2).indices] for u in map(unit, groups)])


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
