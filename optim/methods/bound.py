"""The lower confidence bound of a Gaussian process over [0, 1]^dim, and where it is least."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from botorch.exceptions.warnings import BotorchWarning
from botorch.optim.batched_lbfgs_b import fmin_l_bfgs_b_batched
from gpytorch.utils.warnings import GPInputWarning
from jaxtyping import Float
from linear_operator.utils.warnings import NumericalWarning
from torch import Tensor

from ...landscapes.threads import one_torch_thread
from ..base import Points
from .process import Process
from .radial import Matrix

STEPS = 30  # of L-BFGS on the bound, from each start
ENOUGH = 1e-4  # deviations of the losses: a step that lowers the bound by less is the last
STARTS, SPREAD, NEAR, JITTER = 4, 128, 32, 0.02  # of the search for its least value: see `_starts`
# GPyTorch's settings and Python's warning filters belong to the process, not to a thread.
ONE_AT_A_TIME = threading.RLock()


class LowerBound:
    """The lower confidence bound of a process, in standard deviations of the losses from their average.

    It is that of BoTorch's `UpperConfidenceBound` with `maximize=False`, before the losses' scale is put back: of a
    process of one function, alone or with its slopes, with a variance of one where nothing is known. What does not
    change from point to point is computed once: weights of what is known, and a factor of the covariance.
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
        """Return the bound at points, and its slopes there."""
        covariance, pull = self.covariance.across(u, self.known)
        white = self.factor.whiten(covariance)
        deviation = _deviation(white)
        # variance = 1 - c K^-1 c, so that the deviation's slope by c is -K^-1 c / deviation
        by_covariance = self.weights + self.factor.solve_whitened(white) * (self.coefficient / deviation)[:, None]
        return covariance @ self.weights - self.coefficient * deviation, pull(by_covariance)


def _deviation(white: Matrix) -> Float[Tensor, " count"]:
    return (1.0 - white.square().sum(dim=1)).clamp_min(1e-20).sqrt()


def least_point(bound: LowerBound, z: Points, loss: Points, random: np.random.Generator) -> Points:
    """Return where in [-1, 1]^dim the bound is least, shape (dim,), given the points z and their losses so far."""

    def at(x: Points) -> tuple[Points, Points]:
        value, slope = bound.with_slope(torch.from_numpy(x))
        return value.numpy(), slope.numpy()

    starts = _starts(bound, z, loss, random).numpy()
    minimise: Any = fmin_l_bfgs_b_batched  # untyped
    how = {"bounds": [(0.0, 1.0)] * z.shape[1], "factr": None, "ftol": ENOUGH}
    found, least, _ = minimise(at, starts, maxiter=STEPS, **how)
    return np.asarray(2.0 * found[np.argmin(least)] - 1.0)


def _starts(bound: LowerBound, z: Points, loss: Points, random: np.random.Generator) -> Float[Tensor, "start dim"]:
    """Return where the search for the least bound starts: the best of many points all over, and near the best."""
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
    """Keep other threads out, let torch use one core, and quiet what is no news: iteration limits, jitter added."""
    with ONE_AT_A_TIME, one_torch_thread(), warnings.catch_warnings():
        for category in (BotorchWarning, NumericalWarning, GPInputWarning):
            warnings.simplefilter("ignore", category)
        yield
