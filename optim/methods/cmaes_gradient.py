"""CMA-ES that is told the gradient at its mean, by the library cma."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from ..base import Kind, Points, Proposal
from .cmaes import CMAES, CMAESOptions


@dataclass(frozen=True)
class CMAESGradientOptions(CMAESOptions):
    """The options of CMA-ES."""

    method = "cma-es-gradient"


class CMAESGradient(CMAES):
    """Inject a step down the gradient at the mean into every population of CMA-ES.

    Before each population the mean is evaluated with its gradient g. The population's first point is then mean -
    sigma sqrt(dim) C g / sqrt(g' C g), as far from the mean as a typical sample and in the direction that the natural
    gradient has (Hansen 2011, "Injecting External Solutions Into CMA-ES"); the library sees to it that no point counts
    as farther than its own samples may be. Where the episode of the mean failed, or its gradient is zero or missing,
    nothing is injected.
    """

    name = "cma-es-gradient"
    Options: ClassVar[type[CMAESOptions]] = CMAESGradientOptions
    needs_grad = True

    def _start(self) -> None:
        super()._start()
        self._injected: list[Points] = []  # for each population so far, NaN for none

    def _ask(self) -> Proposal:
        if len(self._injected) > len(self._told):
            return super()._ask()
        return Proposal(torch.from_numpy(self._mean()[None]), Kind.DESCENT, grad=True)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        if grad is None:
            super()._tell(z, loss, grad)
            return
        largest = float(np.abs(grad).max())
        if not 0 < largest < np.inf:
            self._inject(np.full(self.space.dim, np.nan))
            return
        down = -grad[0] / largest  # its length does not matter
        natural = np.asarray(self.strategy.sm.covariance_matrix) @ down
        step = self.strategy.sigma * np.sqrt(self.space.dim) * natural / np.sqrt(down @ natural)
        self._inject(np.clip(self._mean() + step, -1.0, 1.0))

    def _mean(self) -> Points:
        """Return the distribution's mean, inside the box."""
        strategy = self.strategy
        return np.asarray(strategy.gp.pheno(strategy.mean, into_bounds=strategy.boundary_handler.repair))

    def _inject(self, z: Points) -> None:
        self._injected.append(z)
        if np.isfinite(z).all():
            self.strategy.inject([z.copy()])

    def _state(self) -> dict[str, Any]:
        return super()._state() | {"injected": np.array(self._injected).reshape(-1, self.space.dim)}

    def _restore(self, own: Mapping[str, Any]) -> None:
        self._again = list(own["injected"])
        super()._restore(own)
        if self._again:  # of a population that was not told yet
            self._inject(self._again.pop(0))
        del self._again

    def _repeat(self) -> None:
        self._inject(self._again.pop(0))
