"""Continuation: descend on a smoothed loss while the smoothing fades, then polish by L-BFGS-B."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from ...landscapes.randomised import reflect, shrunk_gradient
from ..base import Kind, Points, Proposal
from ..memory import FLOAT, SearchSize
from ..options import choice, number
from .quasi_newton import LBFGSB, LBFGSBOptions

ORDERS = ("mixed", "zeroth")
STALL = 10  # evaluations without progress that end a polish


@dataclass(frozen=True)
class ContinuationOptions(LBFGSBOptions):
    """How a schedule of smoothing goes, and when the next one begins elsewhere.

    A schedule has `widths` standard deviations of the Gaussian, in geometric order, from `sigma`, a fraction of every
    side of the box, to `narrowest` times that. At each one, `pairs` of opposite points estimate the gradient of the
    smoothed loss, and the centre moves against it by `step` widths in each parameter, root mean square. `order` mixed
    takes losses and gradients, zeroth only losses. Then L-BFGS-B continues for up to `evaluations` episodes.

    The next schedule begins at the best point since the last random start. If a schedule has not lowered the best loss
    by `tolerance`, a fraction of it, nor by more than `floor` [loss unit], the next one has half its widths. After
    `halvings` of these there is another random start. `landscape study symmetry` measures the floor of a scene. Ten
    evaluations in a row that do not lower the loss by more than the floor end L-BFGS-B.
    """

    method = "continuation"

    sigma: float = number(0.1, 1e-12, 0.5)
    narrowest: float = number(0.03, 1e-6, 1)
    widths: int = number(4, 1, 1_000_000)
    pairs: int = number(4, 3, 100_000)
    step: float = number(1.5, 1e-12, 1000)
    order: str = choice("mixed")
    halvings: int = number(3, 0, 100)
    tolerance: float = number(1e-4, 0, 1)
    floor: float = number(0.0, 0, 1e300)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.order not in ORDERS:
            raise ValueError(f"continuation option order takes {' or '.join(ORDERS)}; got {self.order}")


class Continuation(LBFGSB):
    """Descend on the loss under a Gaussian whose width fades, polish by L-BFGS-B, and restart at the best point.

    Strong smoothing leads past local minima, weak smoothing to the minimum of the loss itself: graduated non-convexity
    (Blake & Zisserman 1987; Mobahi & Fisher 2015). `shrunk_gradient` estimates gradients of the smoothed loss, after
    Suh et al. 2022. A failed episode counts as the worst loss so far, with a gradient of zero. An episode with a loss
    but no gradient also counts with zero; the estimate from such losses is of zeroth order.
    """

    name = "continuation"
    Options: ClassVar[type[Any]] = ContinuationOptions

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate the memory of the longest polish, and of the estimate of a gradient [bytes]."""
        estimate = FLOAT * options["pairs"] * (20 * size.dim + 6 * options["pairs"])
        return super().memory(options, size) + float(estimate)

    def _setup(self) -> None:
        self.needs_grad = self.options.order != "zeroth"
        self.w = self.signs = np.empty((0, self.space.dim))  # of the pairs that are asked for
        self.local = self._begin(self._start_anywhere())

    def _start_anywhere(self) -> Points:
        """Draw the first point of a search without a best one."""
        self.best, self.best_loss = self.random.uniform(-1.0, 1.0, self.space.dim), math.inf
        self.halved = 0
        return self._start_schedule()

    def _start_schedule(self) -> Points:
        """Begin a schedule at the best point."""
        self.level, self.before = 0, self.best_loss
        self.centre = (self.best + 1.0) / 2.0  # in the unit cube
        return self.best

    @property
    def width(self) -> float:
        """The present standard deviation of the Gaussian, a fraction of every side of the box."""
        share = self.level / max(1, self.options.widths - 1)
        return float(self.options.sigma * 0.5**self.halved * self.options.narrowest**share)

    def _ask(self) -> Proposal:
        if self.level == self.options.widths:
            return super()._ask()
        self.w = self.random.standard_normal((self.options.pairs, self.space.dim))
        moved = self.centre + self.width * np.stack([self.w, -self.w])
        places, signs = reflect(torch.from_numpy(moved))
        self.signs = signs.numpy()
        return Proposal((2.0 * places - 1.0).flatten(0, 1), Kind.POPULATION, grad=self.needs_grad)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        least = int(np.argmin(loss))
        if loss[least] < self.best_loss:
            self.best, self.best_loss = z[least].copy(), float(loss[least])
        if self.level == self.options.widths:
            self._polish(z, loss, grad)
            return
        if self.best_loss == math.inf:  # nothing around the start is worth a schedule
            self._start_anywhere()
            return
        self.centre = self._move(self.penalise(loss), grad)
        self.level += 1
        if self.level == self.options.widths:
            self.local = self._begin(2.0 * self.centre - 1.0 if self.needs_grad else self._next_start())

    def _move(self, loss: Points, grad: Points | None) -> Points:
        """Return the next centre from the losses of pairs and, if there are some, their gradients."""
        shape = (2, self.options.pairs, self.space.dim)
        half = loss[: shape[1]] / 2 - loss[shape[1] :] / 2  # by a move of one width
        first = np.zeros(shape[1:])
        if grad is not None:
            first = (self.width * self.signs * np.nan_to_num(grad.reshape(shape))).sum(axis=0)
        largest = max(float(np.abs(half).max()), float(np.abs(first).max()))
        if largest == 0:
            return self.centre
        known = torch.ones(1, shape[1], dtype=torch.bool)
        differences, slopes = torch.from_numpy(half[None] / largest), torch.from_numpy(first[None] / largest)
        uphill = shrunk_gradient(differences, slopes, torch.from_numpy(self.w), known)[0].numpy()
        length = float(np.linalg.norm(uphill)) or 1.0
        move = self.options.step * self.width * math.sqrt(self.space.dim) / length * uphill
        return np.asarray(np.clip(self.centre - move, 0.0, 1.0))

    def _polish(self, z: Points, loss: Points, grad: Points | None) -> None:
        """Continue with L-BFGS-B, or begin the next schedule when it has ended or stalls."""
        polished = self.local
        super()._tell(z, loss, grad)
        known = polished.loss
        stalls = len(known) > STALL and min(known[:-STALL]) - min(known[-STALL:]) <= self.options.floor
        if self.local is polished and stalls:
            self.local = self._begin(self._next_start())

    def _next_start(self) -> Points:
        """Begin the next schedule: at the best point, narrower if the last one gained nothing, or at random."""
        least = max(self.options.floor, self.options.tolerance * abs(self.before)) if self.before < math.inf else 0.0
        self.halved += not self.best_loss < self.before - least
        return self._start_anywhere() if self.halved > self.options.halvings else self._start_schedule()
