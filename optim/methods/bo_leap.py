"""BO-Leap: Bayesian optimisation proposes, a population explores, gradient descent leaps, and so on from there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cma
import numpy as np
import torch
from cma.sigma_adaptation import CMAAdaptSigmaCSA

from ..base import Kind, Optimizer, Points, Proposal
from ..lockstep import Asking
from ..memory import SearchSize
from ..options import MANY, PAPER, number
from .cmaes import population_memory, quiet_options
from .descent import Descent, DescentOptions
from .surrogate import Surrogate, SurrogateOptions, surrogate_memory

LARGEST_LOSS = np.finfo(float).max / 4  # what a failure counts as: pycma adds two of them


@dataclass(frozen=True)
class BOLeapOptions(SurrogateOptions, DescentOptions):
    """Options of the semi-local search.

    The first population of `population` points (K) is drawn with step size `sigma`, in the box scaled to [-1, 1]. The
    mean of the `best` of them, those with the lowest losses, descends. After a semi-local search has spent
    `local_budget` episodes, it draws no new population. It can exceed that by up to one population and one descent.
    """

    method = "bo-leap"

    population: int = number(10, 2, 10_000, PAPER)
    best: int = number(5, 1, 9_999)
    sigma: float = number(1.0, 1e-9, 1000, PAPER)
    local_budget: int = number(100, 1, MANY, PAPER)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.best < self.population:
            raise ValueError(
                f"bo-leap option best takes 1 to {self.population - 1} of a population of {self.population}; "
                f"got {self.best}"
            )


class BOLeap(Optimizer):
    """Search as in algorithm 1 of "Rethinking Optimization with Differentiable Simulation from a Global Perspective".

    A semi-local search begins at the minimum of a Gaussian process's lower confidence bound. It draws a population from
    N(mu, sigma^2 C), takes the mean of its best points and descends from there. The end of the descent is the next mu,
    and sigma and C are adapted. The process learns the loss of every point of populations and descents. Its proposal
    itself is not evaluated; the first one is random. Points outside the box are moved to its border before evaluation,
    and adapt sigma and C from there.
    """

    name = "bo-leap"
    Options = BOLeapOptions
    needs_grad = True

    @classmethod
    def memory(cls, options: Mapping[str, Any], size: SearchSize) -> float:
        """Estimate the memory of process and populations [bytes]."""
        return surrogate_memory(options["max_points"], size) + population_memory(options["population"], size.dim)

    def _setup(self) -> None:
        if self.space.dim < 2:
            raise ValueError(f"bo-leap needs two parameters or more; this space has {self.space.dim}")
        self.surrogate = Surrogate(self.space.dim, self.options)
        self.local: SemiLocal | None = None
        self.descent = Descent(np.zeros(self.space.dim), self.options, done=True)
        self.spent = 0  # episodes, by this semi-local search

    def learn(self, z: Points, loss: Points) -> None:
        """Model these points, too."""
        self.surrogate.add(z, loss)

    def _ask(self) -> Asking[Proposal]:
        if not self.descent.done:
            return Proposal(torch.from_numpy(self.descent.at[None]), Kind.DESCENT, grad=True)
        if self.local is None or self.spent >= self.options.local_budget:
            mu = yield from self.surrogate.minimise(self.random)
            self.local, self.spent = SemiLocal(mu, self.options, self.random), 0
        return Proposal(torch.from_numpy(self.local.draw()), Kind.POPULATION)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        assert self.local is not None  # as asked
        self.surrogate.add(z, loss)
        self.spent += len(z)
        if self.descent.done:
            self.descent = Descent(self.local.tell(z, loss), self.options)
            return
        assert grad is not None
        self.descent.tell(float(loss[0]), grad[0])
        if self.descent.done:
            self.local.leap(self.descent.at)

    def _state(self) -> dict[str, Any]:
        return super()._state() | {"local": self.local and self.local.state()}

    def _restore(self, own: Mapping[str, Any]) -> None:
        super()._restore({name: value for name, value in own.items() if name != "local"})
        self.local = own["local"] and SemiLocal.from_state(own["local"], self.options, self.random)


class SemiLocal:
    """Adapt sigma and C to populations by equations 14-17 of Hansen & Ostermeier 2001; their mean leaps.

    The paths of those equations use (mean of the best - mu), where the population was drawn around mu. They ignore the
    leap, which says nothing about the selection of a population. pycma does the computation, reduced to the state of
    2001: equal weights, only the rank-one update, which never stalls, and the constants of table 1.
    """

    def __init__(self, mu: Points, options: BOLeapOptions, random: np.random.Generator) -> None:
        self.count, self.best = options.population, options.best
        self._began, self._start = random.bit_generator.state, mu
        self._told: list[tuple[Points, Points]] = []  # populations as they were evaluated, and their losses
        self._leaps: list[Points] = []
        dim = len(mu)
        self.es = cma.CMAEvolutionStrategy(
            mu,
            options.sigma,
            quiet_options(random)
            | {
                "popsize": self.count,
                "CMA_recombination_weights": [1.0 / self.best] * self.best + [0.0] * (self.count - self.best),
                "CMA_rankmu": 0,
                "CMA_active": False,
                "CMA_diagonal_decoding": 0,
                "CMA_mirrors": 0,  # which the library draws of populations below six
                "AdaptSigma": PathLength,
            },
        )
        # Hansen & Ostermeier 2001, table 1: c_c, c_cov, c_sigma; d_sigma = 1 / c_sigma + 1 is pycma's damps / c_sigma
        self.es.sp.cc = self.es.adapt_sigma.initialize(self.es).cs = c = 4.0 / (dim + 4.0)
        self.es.adapt_sigma.damps = 1.0 + c
        self.es.adapt_sigma.max_delta_log_sigma = np.inf
        weights = self.es.sp.weights
        self.es.sm.parameters(weights.mueff, weights.lambda_)["c1"] = 2.0 / (dim + np.sqrt(2.0)) ** 2

    def draw(self) -> Points:
        """Draw x_k ~ N(mu, sigma^2 C), shape (population, dim)."""
        return np.stack(self.es.ask())

    def tell(self, x: Points, loss: Points) -> Points:
        """Adapt sigma and C to a population, and return the mean of its best points."""
        self._told.append((x, loss))
        self.es.tell(list(x), list(loss.clip(-LARGEST_LOSS, LARGEST_LOSS)), check_points=False)
        return np.array(self.es.mean)

    def leap(self, mu: Points) -> None:
        """Draw the next population around `mu`."""
        self.es.mean = mu.copy()
        self._leaps.append(mu)

    def state(self) -> dict[str, Any]:
        """Return everything that the library was told, and its start: its own state could only be pickled."""
        points, losses = ([told[part] for told in self._told] for part in (0, 1))
        return {
            "began": self._began,
            "start": self._start,
            "points": np.array(points),
            "losses": np.array(losses),
            "leaps": np.array(self._leaps),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any], options: BOLeapOptions, random: np.random.Generator) -> SemiLocal:
        """Return the search that had this state, by telling it all again."""
        random.bit_generator.state = state["began"]
        local = cls(state["start"], options, random)
        for turn, (points, loss) in enumerate(zip(state["points"], state["losses"], strict=True)):
            local.draw()
            local.tell(points, loss)
            if turn < len(state["leaps"]):
                local.leap(state["leaps"][turn])
        return local


class PathLength(CMAAdaptSigmaCSA):  # type: ignore[misc]
    """Adapt sigma by the length of its path, and never stall the path of C; stalling came only later."""

    def hsig(self, es: cma.CMAEvolutionStrategy) -> bool:
        """Update the path, and return that the path of C is to be updated, too."""
        self._update_ps(es)
        return True
