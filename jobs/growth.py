"""How a scene's gradients grow with the length of its episodes, measured at points of a slice."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from ..landscapes.adapters import within_box
from ..landscapes.objective import Evaluation, evaluate
from .scene import SceneSpec

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float
    from torch import Tensor

    from ..envs.base import Environment
    from ..landscapes.measures.lyapunov import GradientGrowth

SHARES = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the episode
POINTS = 16
HORIZON = "horizon"


def effort(env: Environment) -> int:
    """Return how many gradients of shorter and whole episodes `measure_growth_of` evaluates."""
    return len(SHARES) * POINTS if hasattr(env.options, HORIZON) else 0


def measure_growth_of(
    env: Environment, x: Float[Tensor, "place dim"], advance: Callable[[int], None], *, boxed: bool = False
) -> GradientGrowth | None:
    """Measure how gradients grow with the length of episodes, at some of the points `x`, spread over their order.

    None where a scene's episodes have no option `horizon`, or nothing to draw that says how long they last. With
    `boxed` points beyond the bounds are left out.
    """
    from ..landscapes.measures.lyapunov import measure_growth

    if not hasattr(env.options, HORIZON):
        return None
    x = x[torch.linspace(0, len(x) - 1, min(POINTS, len(x))).round().long()]
    try:
        time = float(env.episode(env.space.center).time[-1])
    except ValueError:  # nothing to draw
        return None
    width, spec = env.space.upper - env.space.lower, SceneSpec.of(env)
    lengths, norms = list[float](), list[np.ndarray]()
    for number, share in enumerate(SHARES):
        other = spec.make(horizon=share * env.options.horizon)
        found: Evaluation = evaluate(within_box(other) if boxed else other, x, grad=True)
        assert found.grad is not None
        lengths.append(share * time)
        norms.append((found.grad * width).norm(dim=1).numpy())
        advance((number + 1) * len(x))
    return measure_growth(np.array(lengths), np.array(norms))
