"""What a policy sees of bodies made of many points: where some of them have got to, and how fast they go."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

SEEN = 32  # points of each body


def watch(x: Float[Tensor, "batch point 3"], sizes: Sequence[int]) -> Float[Tensor, "batch seen 3"]:
    """Return the centre and up to 32 points, spread evenly over their numbers, of each body of so many points."""
    return torch.stack([torch.cat([_watch_body(body) for body in row.split(list(sizes))]) for row in x])


def describe_motion(
    start: Float[Tensor, "batch point axis"],
    before: Float[Tensor, "batch point axis"],
    now: Float[Tensor, "batch point axis"],
    *,
    scale: Float[Tensor, "point 1"] | float,
    intervals: int,
) -> Float[Tensor, "batch feature"]:
    """Return how far points are from their start and their mean velocity in the interval since `before`.

    The unit of length is `scale`, that of time is a decision, which has so many `intervals`.
    """
    features = torch.stack([now - start, (now - before) * intervals], dim=1) / scale
    return features.flatten(start_dim=1)


def _watch_body(x: Float[Tensor, "point 3"]) -> Float[Tensor, "seen 3"]:
    chosen = torch.linspace(0, len(x) - 1, min(SEEN, len(x))).round().long()
    return torch.cat([x.mean(dim=0, keepdim=True), x[chosen]])
