"""From control parameters to tool motion: linear maps and clamps that torch differentiates."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def hold(segments: Float[Tensor, "batch segment axis"], steps: int) -> Float[Tensor, "batch step axis"]:
    """Hold each of the equally long segments' values over its control steps.

    Raises ValueError where control steps cannot be shared equally.
    """
    count = segments.shape[1]
    if steps % count:
        raise ValueError(f"{steps} control steps cannot be shared equally by {count} segments")
    return segments.repeat_interleave(steps // count, dim=1)


def extend(
    rows: Float[Tensor, "batch row axis"], count: int, *, then: Float[Tensor, "batch 1 axis"]
) -> Float[Tensor, "batch count axis"]:
    """Return the first `count` rows of a course in time, those that it lacks being `then`."""
    return torch.cat([rows[:, :count], then.expand(-1, max(0, count - rows.shape[1]), -1)], dim=1)


def ramp(
    start: Float[Tensor, " axis"], waypoints: Float[Tensor, "batch segment axis"], steps: int
) -> Float[Tensor, "batch step_plus_1 axis"]:
    """Move from `start` to the waypoints at the ends of equally long segments, linearly in between."""
    count = waypoints.shape[1]
    corners = torch.cat([start.expand(len(waypoints), 1, -1), waypoints], dim=1)
    time = torch.arange(steps + 1, dtype=waypoints.dtype) * count / steps
    segment = time.floor().long().clamp_max(count - 1)
    share = (time - segment)[:, None]
    return (1 - share) * corners[:, segment] + share * corners[:, segment + 1]


def ease(velocity: Float[Tensor, "batch step axis"], steps: int) -> Float[Tensor, "batch step axis"]:
    """Return velocities that change over so many control steps, from rest: the mean of the last ones."""
    before = torch.cat([velocity.new_zeros(len(velocity), steps - 1, velocity.shape[2]), velocity], dim=1)
    return before.unfold(1, steps, 1).mean(dim=3)


def integrate_velocity(
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


def roll(
    start: Float[Tensor, " axis"],
    steps: Float[Tensor, "batch step 3"],
    radius: float,
    *,
    lower: Float[Tensor, " axis"],
    upper: Float[Tensor, " axis"],
) -> tuple[Float[Tensor, "batch step_plus_1 3"], Float[Tensor, "batch step_plus_1 3"]]:
    """Roll a level cylinder without slip: return its positions [m] and its angles (spin, yaw, 0) [rad].

    `steps` are (spin [rad], turn [rad], height [m]) of each control step. The axis starts along z and turns clockwise
    seen from above; spinning about it moves the cylinder to the left at first.
    """
    spin, turn, lift = steps.unbind(dim=2)
    yaw = -turn.cumsum(dim=1)
    heading = yaw + turn / 2  # half-way through each step
    motion = torch.stack([-radius * spin * heading.cos(), lift, radius * spin * heading.sin()], dim=2)
    angles = torch.stack([spin.cumsum(dim=1), yaw, torch.zeros_like(yaw)], dim=2)
    angles = torch.cat([torch.zeros_like(angles[:, :1]), angles], dim=1)
    return integrate_velocity(start, motion, 1.0, lower=lower, upper=upper), angles
