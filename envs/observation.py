"""What a policy sees of bodies made of many points: where some of them have got to, and how fast they go."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

if TYPE_CHECKING:
    from .engines.mpm.solver import Solver

SEEN = 32  # points of each body


def watched(x: Float[Tensor, "batch point 3"], sizes: Sequence[int]) -> Float[Tensor, "batch seen 3"]:
    """Return the centre and up to 32 points, spread evenly over their numbers, of each body of so many points."""
    return torch.stack([torch.cat([_of_body(body) for body in row.split(list(sizes))]) for row in x])


def followed(
    solver: Solver, tools: Float[Tensor, "batch step_plus_1 slot 3"], step: int
) -> list[Float[Tensor, "batch seen 3"]]:
    """Return bodies, as they are watched, and tools: at the start, before the last control step, and after it."""
    if step:
        solver.run(tools[:, : step + 1])
    sizes = [len(body.x) for body in solver.model.bodies]
    return [
        torch.cat([watched(solver.reached(k, len(tools)).double().cpu(), sizes), tools[:, k].double().cpu()], dim=1)
        for k in (0, max(0, step - 1), step)
    ]


def motion(
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


def _of_body(x: Float[Tensor, "point 3"]) -> Float[Tensor, "seen 3"]:
    chosen = torch.linspace(0, len(x) - 1, min(SEEN, len(x))).round().long()
    return torch.cat([x.mean(dim=0, keepdim=True), x[chosen]])
