"""The noise of a loss: smaller differences are no features of the landscape."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Objective, evaluate


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the same loss [loss unit]: evaluated again, in another batch, and rounded differently.

    `again` repeats the same batch; `batch` splits and shuffles it; `rounding` moves the parameters by less than their
    last digit in the engine. The first two are 0 where an engine is deterministic.
    """

    again: float
    batch: float
    rounding: float
    points: int

    @property
    def deviation(self) -> float:
        """The largest of the three [loss unit]."""
        return max(self.again, self.batch, self.rounding)


def noise_floor(deviation: float, samples: int) -> float:
    """Return the expected range of this many samples of noise with a standard deviation.

    Twice the expected maximum of this many normal draws, sqrt(2 ln n) deviations.
    """
    return 2 * deviation * math.sqrt(2 * math.log(max(samples, 2)))


def noise(
    objective: Objective, x: Float[Tensor, "points dim"], *, rounding: float, repeats: int = 4, seed: int = 0
) -> Noise:
    """Measure noise at some points; `rounding` is the engine's relative precision, such as 1.2e-7 for float32.

    Root mean squares over successful points. `rounding` draws are uniform, as fractions of the parameters' ranges.
    """
    generator = torch.Generator().manual_seed(seed)
    first = evaluate(objective, x, grad=False).loss
    again = torch.stack([evaluate(objective, x, grad=False).loss for _ in range(repeats)])
    order = torch.randperm(len(x), generator=generator)
    shuffled = torch.full_like(first, torch.nan)
    for part in torch.split(order, max(1, len(x) // 3)):
        shuffled[part] = evaluate(objective, x[part], grad=False).loss
    reach = rounding * (objective.space.upper - objective.space.lower)
    moves = 2 * torch.rand(repeats, *x.shape, generator=generator, dtype=torch.float64) - 1
    moved = torch.stack([evaluate(objective, x + move * reach, grad=False).loss for move in moves])
    known = objective.noise(x)  # of random numbers that are the same in repeats
    repeated = _deviation(first, again) if known is None else float(known.square().mean().sqrt())
    return Noise(repeated, _deviation(first, shuffled[None]), _deviation(first, moved), len(x))


def _deviation(first: Float[Tensor, " points"], others: Float[Tensor, "repeats points"]) -> float:
    """Return the standard deviation of one evaluation, from differences of two."""
    squared = (others - first).square() / 2
    known = squared[squared.isfinite()]
    return float(known.mean().sqrt()) if len(known) else math.nan
