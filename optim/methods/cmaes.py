"""CMA-ES, by the library cma."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import cma
import numpy as np
import torch
from cma.sigma_adaptation import CMAAdaptSigmaCSA

from ..base import Kind, Optimizer, Points, Proposal
from ..memory import FLOAT, SearchSize
from ..options import LIBRARY, MethodOptions, number

MATRICES = 8  # of dim x dim, that CMA-ES holds while it is written to disk: C, its eigenvectors, a pickle of both
POPULATION = 7000  # bytes for each member of a population, in addition to its numbers (measured with pycma 4)

OTHERS = (
    "cma-es continues with the points and losses of the run; cma or its linear algebra draws different numbers here "
    "than where the run began, so the run will differ from one continued there"
)


@dataclass(frozen=True)
class CMAESOptions(MethodOptions):
    """`sigma` is the first step size in the box scaled to [-1, 1]; `population` 0 means 4 + 3 ln(dim) points.

    The library's author advises a quarter of the width of the box. The minimum is then expected within three standard
    deviations of any start in the box.
    """

    method = "cma-es"

    sigma: float = number(0.5, 1e-9, 1000, LIBRARY.format("cma"))
    population: int = number(0, 0, 10_000, LIBRARY.format("cma"))

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.population < 3:
            raise ValueError(f"cma-es option population takes 0 or at least 3; got {self.population}")


class CMAES(Optimizer):
    """Adapt a normal distribution's mean, step size and covariance to the losses of its samples.

    The mean starts at random. The library's `BoundTransform` keeps samples in the box. The distribution is on an
    unbounded space that is folded smoothly into the box, so every sample is inside and none is forced onto the border.
    When the library ends the search (converged, stagnated, a flat loss), it begins again from another random point,
    until the budget is spent. A failed episode counts as the worst loss so far.
    """

    name = "cma-es"
    Options: ClassVar[type[CMAESOptions]] = CMAESOptions

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate the memory of the distribution's matrices and of its population [bytes]."""
        return population_memory(options["population"], size.dim)

    def _setup(self) -> None:
        if self.space.dim < 2:
            raise ValueError(f"cma-es needs two parameters or more; this space has {self.space.dim}")
        self._start()

    def learn(self, z: Points, loss: Points) -> None:
        """Begin with the mean at the best point."""
        self._start(z[np.argmin(loss)])

    def _start(self, mean: Points | None = None) -> None:
        self._given = mean
        self._began = self.random.bit_generator.state
        self._told: list[tuple[Points, Points]] = []  # populations and their losses since then
        options = quiet_options(self.random) | {
            "bounds": [-1.0, 1.0],
            "AdaptSigma": CMAAdaptSigmaCSA,  # in every dimension, as published
        }
        if self.options.population:
            options["popsize"] = self.options.population
        start = self.random.uniform(-1.0, 1.0, self.space.dim) if mean is None else mean
        self.strategy = cma.CMAEvolutionStrategy(start, self.options.sigma, options)

    def _ask(self) -> Proposal:
        self._asked = self.strategy.ask()
        return Proposal(torch.from_numpy(np.stack(self._asked)), Kind.POPULATION)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        self._take(self.penalise(loss))
        if self.strategy.stop():
            self._start()

    def _take(self, loss: Points) -> None:
        self.strategy.tell(self._asked, loss.tolist())  # the very points, which it knows again
        self._told.append((np.stack(self._asked), loss))

    def _state(self) -> dict[str, Any]:
        """Return everything that the library was told since its last start: its own state could only be pickled."""
        points, losses = ([told[part] for told in self._told] for part in (0, 1))
        return {"began": self._began, "mean": self._given, "points": np.array(points), "losses": np.array(losses)}

    def _restore(self, own: Mapping[str, Any]) -> None:
        self.random.bit_generator.state = own["began"]
        self._start(own.get("mean"))  # which earlier versions did not write
        for points, loss in zip(own["points"], own["losses"], strict=True):
            self._repeat()
            self._asked = self.strategy.ask()
            if not np.array_equal(self._asked, points):
                warnings.warn(OTHERS, RuntimeWarning, stacklevel=2)
                self._asked = list(points)
            self._take(loss)
            self.strategy.stop()

    def _repeat(self) -> None:
        """Repeat the preparation of a population: nothing, except in derived classes."""


def population_memory(population: int, dim: int) -> float:
    """Return the memory of a search by populations in this many dimensions [bytes]."""
    return float(FLOAT * MATRICES * dim**2 + population * (POPULATION + 20 * FLOAT * dim))


@dataclass(frozen=True)
class Normal:
    """Draw standard normal numbers of a shape, as numpy.random.randn does, from a given generator."""

    random: np.random.Generator

    def __call__(self, *shape: int) -> Points:
        """Return numbers of shape `shape`."""
        return self.random.standard_normal(shape)


def quiet_options(random: np.random.Generator) -> dict[str, Any]:
    """Return the library's options to draw from a given generator, print nothing and write no file."""
    return {
        "randn": Normal(random),
        "seed": np.nan,  # leave numpy's global generator alone
        "verbose": -10,  # no text, no files written or read
        "verb_log": 0,
    }


@dataclass(frozen=True)
class CMAESGradientOptions(CMAESOptions):
    """The options of CMA-ES."""

    method = "cma-es-gradient"


class CMAESGradient(CMAES):
    """Inject a step down the gradient at the mean into every population of CMA-ES.

    Before each population, the mean is evaluated with its gradient g. The first point of the population is then mean -
    sigma sqrt(dim) C g / sqrt(g' C g). It is as far from the mean as a typical sample, in the direction of the natural
    gradient (Hansen 2011, "Injecting External Solutions Into CMA-ES"). The library ensures that no point counts as
    farther away than its own samples can be. If the episode of the mean failed, or its gradient is zero or missing,
    nothing is injected.
    """

    name = "cma-es-gradient"
    Options: ClassVar[type[CMAESOptions]] = CMAESGradientOptions
    needs_grad = True

    def _start(self, mean: Points | None = None) -> None:
        super()._start(mean)
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
