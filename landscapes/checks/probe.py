"""Evaluate an objective for the checks: losses along lines in the unit cube, and gradients at points."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..objective import Evaluation, Objective, Status, evaluate

EPS = {name: float(torch.finfo(getattr(torch, name)).eps) for name in ("float32", "float64")}
FEW_LOSSES = 8  # different ones, from which the type of numbers can be told
USED_BITS = 2.0**-19  # of the largest loss is what the last bit of float32 has to be below
CLEAR_GRAIN = 16  # times float64's spacing is what the spacing of losses has to be, to be called a grain


@dataclass(eq=False)
class Probe:
    """Evaluate an objective at points of the unit cube.

    `repeats` is the largest difference of losses between repeats [loss unit], and `gradient_repeats` that of gradients
    as a share of the largest component. `precision` is the objective's stated precision. `seen` collects losses, to
    find their grain. `losses` and `gradients` count rows.
    """

    objective: Objective
    precision: str
    repeats: float = 0.0
    gradient_repeats: float = 0.0
    losses: int = 0
    gradients: int = 0
    seen: list[Float[Tensor, " some"]] = field(default_factory=list)

    @property
    def width(self) -> Float[Tensor, " dim"]:
        """Length of the box along each parameter [its unit]."""
        return self.objective.space.upper - self.objective.space.lower

    def loss(self, u: Float[Tensor, "*shape dim"]) -> Float[Tensor, " *shape"]:
        """Return losses, NaN where a point is outside the cube or has none."""
        flat = u.reshape(-1, u.shape[-1])
        found = flat.new_full((len(flat),), torch.nan)
        inside = ((flat >= 0) & (flat <= 1)).all(dim=1)
        if bool(inside.any()):
            points = self.objective.space.from_unit(flat[inside])
            found[inside] = evaluate(self.objective, points, grad=False).loss
            self.losses += int(inside.sum())
            self.seen.append(found[inside])
        return found.reshape(u.shape[:-1])

    def gradient(self, u: Float[Tensor, "batch dim"]) -> Evaluation:
        """Return losses and gradients [loss unit per parameter unit]."""
        found = evaluate(self.objective, self.objective.space.from_unit(u), grad=True)
        self.gradients += len(u)
        self.seen.append(found.loss[found.loss.isfinite()])
        return found

    @property
    def eps(self) -> float:
        """Spacing of numbers at one, of the type of the losses: float32 where all are float32 numbers."""
        if self.precision == "float32":
            return EPS["float32"]
        loss = self._different
        single = len(loss) >= FEW_LOSSES and bool((loss.float().double() == loss).all())
        if single and 0 < self._lowest_bit <= USED_BITS * float(loss.abs().max()):  # whole numbers are no float32
            return EPS["float32"]
        return EPS["float64"]

    @property
    def single(self) -> bool:
        """Whether losses are computed in float32."""
        return self.eps == EPS["float32"]

    @property
    def grain(self) -> float:
        """Largest power of two of which all losses are multiples, 0 if no coarser than float64 [loss unit]."""
        loss, found = self._different, self._lowest_bit
        clear = len(loss) >= FEW_LOSSES and found > CLEAR_GRAIN * EPS["float64"] * float(loss.abs().max())
        return found if clear else 0.0

    @property
    def _different(self) -> Float[Tensor, " some"]:
        """Return the different losses seen, except 0."""
        loss = torch.from_numpy(np.unique(torch.cat(self.seen).numpy())) if self.seen else torch.zeros(0)
        return loss[loss.isfinite() & (loss != 0)]

    @property
    def _lowest_bit(self) -> float:
        return min(map(_lowest_bit, self._different.tolist()), default=0.0)


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines through points of the unit cube: their points, directions, and the gradient's slope.

    `u` and `direction` have shape (line, dim), with components of a direction at most one. `loss` is that at the point,
    `grad` the gradient [loss unit per side of the cube], and `point` the number of the point of each line.
    """

    u: Float[Tensor, "line dim"]
    direction: Float[Tensor, "line dim"]
    loss: Float[Tensor, " line"]
    grad: Float[Tensor, "line dim"]
    missing: Bool[Tensor, " line"]
    point: Tensor

    @classmethod
    def through(cls, probe: Probe, u: Tensor, direction: Tensor, point: Tensor, found: Evaluation) -> Lines:
        """Return lines through evaluated points; `point` is the row of `u` for each line."""
        grad = torch.full_like(u, torch.nan) if found.grad is None else found.grad * probe.width
        missing = found.status == Status.NO_GRADIENT
        return cls(u[point], direction, found.loss[point], grad[point], missing[point], point)

    def __len__(self) -> int:
        return len(self.u)

    @property
    def slope(self) -> Float[Tensor, " line"]:
        """The gradient's slope along each line [loss unit per side of the cube]."""
        used = torch.where(self.direction == 0, 0.0, self.grad)  # a NaN of a parameter that does not move is none
        return (used * self.direction).sum(dim=1)

    @property
    def parts(self) -> Float[Tensor, " line"]:
        """The sum of each parameter's contribution to that slope, without signs."""
        return torch.where(self.direction == 0, 0.0, self.grad * self.direction).abs().sum(dim=1)

    def rows(self, rows: Tensor) -> Lines:
        """Return some of the lines."""
        return Lines(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def walk(self, probe: Probe, steps: list[float]) -> Float[Tensor, "2 step line"]:
        """Return losses ahead of each point and behind it, NaN outside the cube."""
        offset = torch.tensor(steps, dtype=torch.float64)[:, None, None] * self.direction
        return probe.loss(torch.stack([self.u + offset, self.u - offset]))


def _lowest_bit(value: float) -> float:
    """Return the largest power of two of which a number is a multiple."""
    numerator, denominator = value.as_integer_ratio()
    return math.ldexp(1.0, (numerator & -numerator).bit_length() - 1) / denominator
