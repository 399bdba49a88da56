"""The subject of a check: an objective, its evaluation at some points, and the noise between repeats."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Evaluation, Objective, evaluate


@dataclass(frozen=True, eq=False)
class Subject:
    """An objective, points of its box, shape (batch, dim), and its evaluation there.

    `noise` is the largest difference between repeats: of losses, as a share of their range, and of gradients, as a
    share of the largest.
    """

    objective: Objective
    x: Float[Tensor, "batch dim"]
    first: Evaluation
    precision: str
    seed: int
    noise: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def observe(
        cls, objective: Objective, x: Float[Tensor, "batch dim"], *, precision: str, seed: int, repeats: int
    ) -> Subject:
        """Evaluate the points `repeats` times."""
        first = evaluate(objective, x, grad=True)
        still = cls(objective, x, first, precision, seed)
        again = [still.differences(evaluate(objective, x, grad=True), first) for _ in range(repeats - 1)]
        losses, grads = zip(*again, strict=True)
        return cls(objective, x, first, precision, seed, (max(losses), max(grads)))

    @property
    def eps(self) -> float:
        """Spacing of numbers at one, in the objective's precision."""
        return float(torch.finfo(getattr(torch, self.precision)).eps)

    @property
    def rounding(self) -> float:
        """Share of the range that another order of sums can change: half of the digits."""
        return math.sqrt(self.eps)

    @property
    def repeatable(self) -> tuple[float, float]:
        """Allowed differences of repeats, losses and gradients, as shares.

        Many threads that add in any order make losses differ by rounding. Gradients multiply that, in a contact a
        thousandfold. A tenth of the allowed error of a slope cannot be mistaken for one.
        """
        return self.rounding, self.eps ** (1 / 3)

    @property
    def tolerances(self) -> tuple[float, float]:
        """Allowed differences of losses and gradients that should be equal, as shares.

        Few repeats understate the noise, so ten times as much is allowed. An objective that repeats exactly can still
        add in another order for another number of rows.
        """
        loss, grad = self.noise
        return max(10 * loss, 1e3 * self.eps), max(10 * grad, 1e3 * self.eps)

    @property
    def scale(self) -> float:
        """Range of the losses at the points."""
        return spread(self.first.loss)

    @property
    def steepness(self) -> float:
        """Largest component of the gradients at the points."""
        return size(self.first.grad)

    def flat(self, loss: Float[Tensor, " batch"]) -> float:
        """Return the slope [loss unit per side of the box] below which a landscape with such losses is flat.

        It changes them by less than half of their digits over the whole box; iterative solvers are not more accurate.
        """
        finite = loss[loss.isfinite()].abs()
        return self.rounding * (float(finite.max()) if len(finite) else 0.0)

    def blur(self, loss: Float[Tensor, " batch"]) -> float:
        """Return the change of such losses by noise and rounding."""
        return self.noise[0] * self.scale + self.eps * float(loss.abs().nan_to_num().max())

    def evaluate(self, x: Float[Tensor, "batch dim"]) -> Evaluation:
        """Return losses and gradients at other points, checked against the protocol."""
        return evaluate(self.objective, x, grad=True)

    def differences(self, found: Evaluation, wanted: Evaluation) -> tuple[float, float]:
        """Return the largest differences between losses and between gradients, as shares."""
        if not torch.equal(found.status, wanted.status):
            return torch.inf, torch.inf
        loss = difference(found.loss, wanted.loss) / self.scale
        if found.grad is None or wanted.grad is None:
            return loss, 0.0
        return loss, difference(found.grad, wanted.grad) / self.steepness

    def agree(self, found: Evaluation, wanted: Evaluation) -> bool:
        """Return whether two evaluations agree within the tolerance."""
        return all(gap <= limit for gap, limit in zip(self.differences(found, wanted), self.tolerances, strict=True))


def difference(a: Tensor, b: Tensor) -> float:
    """Return the largest |a - b|, where two NaN are equal, and infinity where only one is NaN."""
    gap = (a - b).abs().masked_fill(a.isnan() & b.isnan(), 0.0)
    return float(gap.nan_to_num(nan=torch.inf).max()) if gap.numel() else 0.0


def spread(loss: Float[Tensor, " batch"]) -> float:
    """Return the range of the finite losses; their magnitude where all are equal, one where there is none."""
    finite = loss[loss.isfinite()]
    if not len(finite):
        return 1.0
    return float(finite.max() - finite.min()) or float(finite.abs().max()) or 1.0


def size(grad: Tensor | None) -> float:
    """Return the largest finite |component|, or one where there is none."""
    finite = torch.zeros(0) if grad is None else grad[grad.isfinite()]
    return (float(finite.abs().max()) if len(finite) else 0.0) or 1.0
