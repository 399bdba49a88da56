"""The 24 noiseless functions of BBOB, with gradients (Hansen et al. 2009), in torch.

Optima and rotations of an instance are those of the package cma, whose functions have no gradients: a test compares
ours with them. Functions are defined in the box [-5, 5], so terms that only matter outside it are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from cma import bbobbenchmarks as cma
from torch import Tensor

import gradscape as gs
from gradscape.landscapes.objective import Evaluation, Objective, Status

GROUPS = {  # first function of each, as Hansen et al. 2009 order them
    1: "separable",
    6: "low conditioning",
    10: "high conditioning",
    15: "multi-modal",
    20: "weakly structured",
}
TURNED = 1e6  # added to a seed for the second rotation
SEEDS = {4: 3, 18: 17}  # functions that share the numbers of another one
Formula = Callable[["Instance", Tensor], Tensor]


@dataclass(frozen=True)
class Instance:
    """The numbers of one instance of a function, and common parts of formulas."""

    function: int
    dim: int
    instance: int

    @property
    def seed(self) -> float:
        """The seed of all its numbers."""
        return SEEDS.get(self.function, self.function) + 1e4 * self.instance

    @cached_property
    def least(self) -> float:
        """The value at the minimum."""
        ratio = cma.gauss(1, self.seed)[0] / cma.gauss(1, self.seed + 1)[0]
        return float(np.clip(np.round(1e4 * ratio) / 100, -1000, 1000))

    @cached_property
    def optimum(self) -> Tensor:
        """A random point, which is the minimum of most functions."""
        return torch.from_numpy(cma.compute_xopt(self.seed + TURNED * (self.function == 12), self.dim))

    @cached_property
    def first(self) -> Tensor:
        """The rotation R of the paper's names."""
        return torch.from_numpy(cma.compute_rotation(self.seed + TURNED, self.dim))

    @cached_property
    def second(self) -> Tensor:
        """The rotation Q."""
        return torch.from_numpy(cma.compute_rotation(self.seed, self.dim))

    @cached_property
    def ramp(self) -> Tensor:
        """From 0 to 1 over the parameters."""
        return torch.linspace(0, 1, self.dim, dtype=torch.float64)

    def between(self, condition: float) -> Tensor:
        """Return a map of two rotations with scales between them."""
        return (self.second * math.sqrt(condition) ** self.ramp) @ self.first

    def skew(self, x: Tensor, beta: float) -> Tensor:
        """Return the asymmetric transformation T_asy."""
        high = x.clamp_min(1e-300)
        return torch.where(x > 0, high ** (1 + beta * self.ramp * high.sqrt()), x)


def ripple(x: Tensor) -> Tensor:
    """Return the oscillating transformation T_osz."""
    size, one = x.abs().clamp_min(1e-300).log() / 0.1, torch.ones_like(x)
    a, b = torch.where(x > 0, one, 0.55 * one), torch.where(x > 0, 0.79 * one, 0.31 * one)
    whole = x.sign() * ((size + 0.49 * ((a * size).sin() + (b * size).sin())) * 0.1).exp()
    return torch.where(x == 0, x, whole)


def _bumps(x: Tensor, waves: Tensor) -> Tensor:
    return 10 * (x.shape[1] - (2 * math.pi * waves).cos().sum(1)) + x.square().sum(1)


def _bent_valley(x: Tensor) -> Tensor:
    return (100 * (x[:, :-1] ** 2 - x[:, 1:]) ** 2 + (x[:, :-1] - 1) ** 2).sum(1)


def _sphere(it: Instance, x: Tensor) -> Tensor:
    return (x - it.optimum).square().sum(1)


def _ellipsoid(it: Instance, x: Tensor) -> Tensor:
    return ripple(x - it.optimum).square() @ 1e6**it.ramp


def _rastrigin(it: Instance, x: Tensor) -> Tensor:
    x = math.sqrt(10) ** it.ramp * it.skew(ripple(x - it.optimum), 0.2)
    return _bumps(x, x)


def _bueche(it: Instance, x: Tensor) -> Tensor:
    even = torch.arange(it.dim) % 2 == 0
    x = ripple(x - torch.where(even, it.optimum.abs(), it.optimum))
    x = math.sqrt(10) ** it.ramp * torch.where(even & (x > 0), 10 * x, x)
    return _bumps(x, x)


def _slope(it: Instance, x: Tensor) -> Tensor:
    sides, scales = it.optimum.sign(), 10**it.ramp
    return (5 * scales).sum() - x @ (sides * scales)


def _sector(it: Instance, x: Tensor) -> Tensor:
    x = (x - it.optimum) @ it.between(10)
    return ripple(torch.where(x * it.optimum > 0, 100 * x, x).square().sum(1)) ** 0.9


def _steps(it: Instance, x: Tensor) -> Tensor:
    x = (x - it.optimum) @ (it.second * math.sqrt(10) ** it.ramp)
    rounded = torch.where(x.abs() > 0.5, x.round(), (10 * x).round() / 10)
    return 0.1 * torch.maximum(1e-4 * x[:, 0].abs(), (rounded @ it.first).square() @ 100**it.ramp)


def _rosenbrock(it: Instance, x: Tensor) -> Tensor:
    return _bent_valley(max(1.0, math.sqrt(it.dim) / 8) * (x - 0.75 * it.optimum) + 1)


def _turned_rosenbrock(it: Instance, x: Tensor) -> Tensor:
    return _bent_valley(max(1.0, math.sqrt(it.dim) / 8) * x @ it.second + 0.5)


def _turned_ellipsoid(it: Instance, x: Tensor) -> Tensor:
    return ripple((x - it.optimum) @ it.first).square() @ 1e6**it.ramp


def _discus(it: Instance, x: Tensor) -> Tensor:
    x = ripple((x - it.optimum) @ it.first)
    return x.square().sum(1) + (1e6 - 1) * x[:, 0] ** 2


def _cigar(it: Instance, x: Tensor) -> Tensor:
    x = it.skew((x - it.optimum) @ it.first, 0.5) @ it.first
    return 1e6 * x.square().sum(1) + (1 - 1e6) * x[:, 0] ** 2


def _ridge(it: Instance, x: Tensor) -> Tensor:
    x = (x - it.optimum) @ it.between(10)
    return x[:, 0] ** 2 + 100 * x[:, 1:].square().sum(1).clamp_min(1e-300).sqrt()


def _powers(it: Instance, x: Tensor) -> Tensor:
    x = (x - it.optimum) @ it.first
    return (x.abs() ** (2 + 4 * it.ramp)).sum(1).clamp_min(1e-300).sqrt()


def _turned_rastrigin(it: Instance, x: Tensor) -> Tensor:
    x = it.skew(ripple((x - it.optimum) @ it.first), 0.2) @ it.between(10)
    return _bumps(x, x)


def _weierstrass(it: Instance, x: Tensor) -> Tensor:
    x = ripple((x - it.optimum) @ it.first) @ it.between(1 / 100)
    powers = torch.arange(12, dtype=torch.float64)
    high, fast = 0.5**powers, 2 * math.pi * 3**powers
    whole = ((fast * (x[..., None] + 0.5)).cos() @ high).sum(1) / it.dim
    return 10 * (whole - (fast / 2).cos() @ high) ** 3


def _schaffer(condition: float) -> Formula:
    def value(it: Instance, x: Tensor) -> Tensor:
        x = it.skew((x - it.optimum) @ it.first, 0.5) @ (it.second * math.sqrt(condition) ** it.ramp)
        s = (x[:, :-1] ** 2 + x[:, 1:] ** 2).clamp_min(1e-300)
        return (s**0.25 * ((50 * s**0.1).sin() ** 2 + 1)).mean(1) ** 2

    return value


def _griewank_rosenbrock(it: Instance, x: Tensor) -> Tensor:
    x = max(1.0, math.sqrt(it.dim) / 8) * x @ it.second + 0.5
    s = 100 * (x[:, :-1] ** 2 - x[:, 1:]) ** 2 + (1 - x[:, :-1]) ** 2
    return 10 + 10 * (s / 4000 - s.cos()).mean(1)


def _schwefel(it: Instance, x: Tensor) -> Tensor:
    sides = torch.from_numpy(np.sign(cma.unif(it.dim, it.seed) - 0.5))
    least = 4.2096874633
    x = 2 * sides * x
    x = torch.cat([x[:, :1], x[:, 1:] + 0.25 * (x[:, :-1] - least)], dim=1)
    x = 100 * (math.sqrt(10) ** it.ramp * (x - least) + least)
    beyond = (x.abs() - 500).clamp_min(0).square().sum(1)
    return 0.01 * (418.9828872724339 - (x * x.abs().sqrt().sin()).mean(1)) + 0.01 * beyond


def _gallagher(peaks: int, spread: float, condition: float) -> Formula:
    def value(it: Instance, x: Tensor) -> Tensor:
        order = np.argsort(cma.unif(peaks - 1, it.seed))
        conditions = [condition, *(1000 ** np.linspace(0, 1, peaks - 1))[order]]
        scales = np.stack(
            [
                (one ** np.linspace(-0.5, 0.5, it.dim))[np.argsort(cma.unif(it.dim, it.seed + 1e3 * k))]
                for k, one in enumerate(conditions)
            ]
        )
        places = spread * (10 * cma.unif(it.dim * peaks, it.seed) - 5).reshape(peaks, it.dim) @ it.second.numpy()
        places[0] *= 0.8
        heights = torch.from_numpy(np.array([10.0, *np.linspace(1.1, 9.1, peaks - 1)]))
        away = ((x @ it.second)[:, None, :] - torch.from_numpy(places)).square()
        near = heights * (-0.5 / it.dim * (away * torch.from_numpy(scales)).sum(2)).exp()
        return ripple(10 - near.max(dim=1).values) ** 2

    return value


def _katsuura(it: Instance, x: Tensor) -> Tensor:
    x = (x - it.optimum) @ it.between(100)
    powers = 2.0 ** torch.arange(1, 33, dtype=torch.float64)
    waves = x[..., None] * powers
    parts = 1 + torch.arange(1, it.dim + 1) * ((waves - waves.round()).abs() @ (1 / powers))
    return 10 / it.dim**2 * (parts.prod(dim=1) ** (10 / it.dim**1.2) - 1)


def _lunacek(it: Instance, x: Tensor) -> Tensor:
    x = 2 * torch.from_numpy(np.sign(cma.gauss(it.dim, it.seed))) * x
    near, share = 2.5, 1 - 0.5 / (math.sqrt(it.dim + 20) - 4.1)
    far = -math.sqrt((near**2 - 1) / share)
    funnels = torch.minimum((x - near).square().sum(1), it.dim + share * (x - far).square().sum(1))
    return funnels + 10 * (it.dim - (2 * math.pi * (x - near) @ it.between(100)).cos().sum(1))


FORMULAS: tuple[Formula, ...] = (
    *(_sphere, _ellipsoid, _rastrigin, _bueche, _slope),
    *(_sector, _steps, _rosenbrock, _turned_rosenbrock),
    *(_turned_ellipsoid, _discus, _cigar, _ridge, _powers),
    *(_turned_rastrigin, _weierstrass, _schaffer(10), _schaffer(1000), _griewank_rosenbrock),
    *(_schwefel, _gallagher(101, 1.0, 1000**0.5), _gallagher(21, 0.98, 1000), _katsuura, _lunacek),
)


class BBOB(Objective):
    """Function 1 to 24 of BBOB with its exact gradient (float64), over the box [-5, 5] of so many parameters."""

    threads = 1
    preferred_batch = 256

    def __init__(self, function: int, dim: int, instance: int = 1) -> None:
        self.name = f"bbob-{function}"
        self.it, self.formula = Instance(function, dim, instance), FORMULAS[function - 1]
        self.space = gs.ParameterSpace.box(tuple(f"x{k}" for k in range(dim)), -5.0, 5.0)

    @property
    def group(self) -> str:
        """The group that the functions' authors put it in."""
        return GROUPS[max(first for first in GROUPS if first <= self.it.function)]

    def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if requested."""
        x = x.detach().double().requires_grad_(grad)
        with torch.set_grad_enabled(grad):
            loss = self.formula(self.it, x) + self.it.least
        slope = torch.autograd.grad(loss.sum(), x)[0] if grad else None
        return Evaluation.from_results(loss.detach(), slope, torch.full((len(x),), Status.OK, dtype=torch.int8))
