"""L-BFGS-B from random starts, and basin hopping, by scipy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.optimize import minimize

from ..base import Kind, Optimizer, Part, Points, Proposal
from ..memory import FLOAT, SearchSize
from ..options import LIBRARY, MANY, MethodOptions, number
from .descent import lacks

MEMORY = 10  # pairs of steps and gradients that the Hessian is made of, as scipy's default has it
INTERVAL, TARGET, FACTOR = 50, 0.5, 0.9  # of hops, of those accepted, of a hop's length: scipy's defaults


class _Unknown(Exception):  # noqa: N818 -- no error: it takes control back from scipy
    """Carry the point with the unknown loss out of scipy."""

    def __init__(self, z: Points) -> None:
        self.z = z.copy()


class LocalSearch(Part):
    """Minimise by scipy's L-BFGS-B from `start`, in the scaled box: `at` is the next point it needs, until `done`.

    scipy calls a function and needs its value at once. So every `tell` minimises from the start again, with the known
    values, up to the first unknown point: the points are the same every time. That takes 1 ms for a point of a search
    of 100, 3 ms of 200 (50 parameters). `failed`: scipy reports that the search ended without success.
    """

    def __init__(self, start: Points, evaluations: int) -> None:
        self.start, self.evaluations = np.clip(start, -1.0, 1.0), evaluations
        self.z: Points = np.empty((0, len(start)))
        self.loss: list[float] = []
        self.grad: Points = np.empty((0, len(start)))
        self.at, self.best, self.best_loss = self.start, self.start, math.inf
        self.done = self.failed = False

    def tell(self, loss: float, grad: Points) -> None:
        """Take the loss and the gradient, shape (dim,), of the requested point; raises whatever scipy raises.

        A point without a gradient ends the search, at the lowest loss so far, because scipy cannot use NaN.
        """
        self.z, self.grad = np.vstack([self.z, self.at]), np.vstack([self.grad, grad])
        self.loss.append(loss)
        if lacks(grad):
            least = int(np.argmin(self.loss))
            self.done, self.failed, self.best, self.best_loss = True, True, self.z[least], self.loss[least]
            return
        try:
            found = self._minimise()
        except _Unknown as unknown:
            self.at = unknown.z
        else:
            self.done, self.failed = True, not found.success
            self.best, self.best_loss = np.asarray(found.x), float(found.fun)

    def _minimise(self) -> Any:
        """Return scipy's result. Raises _Unknown at the first point whose loss is not known."""
        known = zip(self.loss, self.grad, strict=True)

        def at(z: Points) -> tuple[float, Points]:
            for loss, grad in known:
                return loss, grad.copy()
            raise _Unknown(z)

        options, box = {"maxcor": MEMORY, "maxfun": self.evaluations}, [(-1.0, 1.0)] * len(self.start)
        return minimize(at, self.start, jac=True, method="L-BFGS-B", bounds=box, options=options)


@dataclass(frozen=True)
class LBFGSBOptions(MethodOptions):
    """A search that has not ended by itself ends after `evaluations` episodes."""

    method = "l-bfgs-b"

    evaluations: int = number(200, 2, MANY)


class LBFGSB(Optimizer):
    """Minimise by scipy's L-BFGS-B from uniformly random starts: where one search ends, the next begins.

    Every episode has a gradient. A failed one counts as the worst loss so far, with a gradient of zero. One that has a
    loss but no gradient ends its search.
    """

    name = "l-bfgs-b"
    Options: ClassVar[type[Any]] = LBFGSBOptions
    needs_grad = True

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate the memory of the longest search [bytes]."""
        points = min(options["evaluations"], size.budget or MANY) + 2 * MEMORY
        return float(3 * FLOAT * size.dim * points)

    def _setup(self) -> None:
        self.local = self._begin(self.random.uniform(-1.0, 1.0, self.space.dim))

    def learn(self, z: Points, loss: Points) -> None:
        """Search from the best point first."""
        self.local = self._begin(z[np.argmin(loss)])

    def _begin(self, start: Points) -> LocalSearch:
        return LocalSearch(start, self.options.evaluations)

    def _ask(self) -> Proposal:
        return Proposal(torch.from_numpy(self.local.at[None]), Kind.DESCENT, grad=True)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        assert grad is not None  # as asked
        self.local.tell(float(self.penalise(loss)[0]), grad[0])
        if self.local.done:
            self.local = self._begin(self._next_start())

    def _next_start(self) -> Points:
        """Return the start of the next search, after one has ended."""
        return self.random.uniform(-1.0, 1.0, self.space.dim)


@dataclass(frozen=True)
class BasinHoppingOptions(LBFGSBOptions):
    """How the search goes from minimum to minimum; the defaults of hops are scipy's.

    A hop is uniform, up to `step` along each parameter of the box scaled to [-1, 1]. Its length is adapted every 50
    hops so that half of them are accepted. A minimum that is worse by `temperature` [loss unit] is accepted with
    probability 1/e.
    """

    method = "basin-hopping"

    step: float = number(0.5, 1e-12, 1000, LIBRARY.format("scipy"))
    temperature: float = number(1.0, 1e-300, 1e300, LIBRARY.format("scipy"))


class BasinHopping(LBFGSB):
    """Hop from minimum to minimum like scipy's `basinhopping`: displace, minimise by L-BFGS-B, accept or go back.

    It is our own code, to propose points one by one. On functions that scipy can minimise itself it evaluates the same
    points.
    """

    name = "basin-hopping"
    Options: ClassVar[type[Any]] = BasinHoppingOptions

    def _setup(self) -> None:
        super()._setup()
        self.here = self.local.start
        self.here_loss, self.here_failed = math.inf, True
        self.length, self.hops, self.accepted = self.options.step, 0, 0

    def learn(self, z: Points, loss: Points) -> None:
        """Search from the best point first, and hop from there."""
        super().learn(z, loss)
        self.here = self.local.start

    def _next_start(self) -> Points:
        if self.hops == 0 or self._accept():
            self.accepted += self.hops > 0
            self.here, self.here_loss, self.here_failed = self.local.best, self.local.best_loss, self.local.failed
        self.hops += 1
        if self.hops % INTERVAL == 0:
            self.length *= 1 / FACTOR if self.accepted / self.hops > TARGET else FACTOR
        return self.here + self.random.uniform(-self.length, self.length, self.space.dim)

    def _accept(self) -> bool:
        """Accept the found minimum as Metropolis does, unless its search failed and the previous one did not."""
        worse = max(0.0, self.local.best_loss - self.here_loss)
        drawn = self.random.uniform()
        return bool(
            math.exp(-worse / self.options.temperature) >= drawn and (not self.local.failed or self.here_failed)
        )
