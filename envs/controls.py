"""From control parameters to tool motion: linear maps and clamps that torch differentiates."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def hold(segments: Float[Tensor, "batch segment axis"], steps: int) -> Float[Tensor, "batch step axis"]:
    """Hold each of the equally long segments' values over its control steps.

    Raises ValueError where control steps cannot be divided equally.
    """
    count = segments.shape[1]
    if steps % count:
        raise ValueError(f"{steps} control steps cannot be divided equally into {count} segments")
    return segments.repeat_interleave(steps // count, dim=1)


def extend(
    rows: Float[Tensor, "batch row axis"], count: int, *, then: Float[Tensor, "batch 1 axis"]
) -> Float[Tensor, "batch count axis"]:
    """Return the first `count` rows of a course in time, extended by `then`."""
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
    """Return velocities that change over this many control steps, from rest: the mean of the last ones."""
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
    path = [start.expand(len(velocity), -1)]
    for move in (span * velocity).unbind(dim=1):
        path.append((path[-1] + move).clamp(lower, upper))
    return torch.stack(path, dim=1)


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


# ---- What a policy sees of bodies made of many points: where some of them have got to, and how fast they go.

SEEN = 32  # points of each body


def watch(x: Float[Tensor, "batch point 3"], sizes: Sequence[int]) -> Float[Tensor, "batch seen 3"]:
    """Return the centre and up to 32 points, evenly chosen by number, of each body."""
    return torch.stack([torch.cat([_watch_body(body) for body in row.split(list(sizes))]) for row in x])


def describe_motion(
    start: Float[Tensor, "batch point axis"],
    before: Float[Tensor, "batch point axis"],
    now: Float[Tensor, "batch point axis"],
    *,
    scale: Float[Tensor, "point 1"] | float,
    intervals: int,
) -> Float[Tensor, "batch feature"]:
    """Return the displacements of points, and their mean velocity in the interval since `before`.

    The unit of length is `scale`; that of time is a decision, which has `intervals` intervals.
    """
    features = torch.stack([now - start, (now - before) * intervals], dim=1) / scale
    return features.flatten(start_dim=1)


def _watch_body(x: Float[Tensor, "point 3"]) -> Float[Tensor, "seen 3"]:
    chosen = torch.linspace(0, len(x) - 1, min(SEEN, len(x))).round().long()
    return torch.cat([x.mean(dim=0, keepdim=True), x[chosen]])
