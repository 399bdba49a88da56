"""From control parameters to tool motion: linear maps and clamps that torch differentiates."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def hold(segments: Float[Tensor, "batch segment axis"], steps: int) -> Float[Tensor, "batch step axis"]:
    """Hold each of the equally long segments' values over its control steps."""
    count = segments.shape[1]
    if steps % count:
        raise ValueError(f"{steps} control steps cannot be shared equally by {count} segments")
    return segments.repeat_interleave(steps // count, dim=1)


def travel(
    start: Float[Tensor, " axis"],
    velocity: Float[Tensor, "batch step axis"],
    span: float,
    *,
    lower: Float[Tensor, " axis"],
    upper: Float[Tensor, " axis"],
) -> Float[Tensor, "batch step_plus_1 axis"]:
    """Integrate a tool's velocity [m/s] over control steps of `span` [s]; positions [m] stay between the bounds."""
    positions = [start.expand(len(velocity), -1)]
    for step in range(velocity.shape[1]):
        positions.append(torch.clamp(positions[-1] + span * velocity[:, step], lower, upper))
    return torch.stack(positions, dim=1)
