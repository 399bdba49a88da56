"""How a scene's gradients grow with the length of its episodes, measured at points of a slice."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ..landscapes.identity import plane_of, stored_identity
from ..landscapes.objective import BoxedObjective, evaluate
from .watch import Watch

if TYPE_CHECKING:
    import xarray as xr

    from ..envs.base import Environment
    from ..landscapes.measures.lyapunov import GradientGrowth

SHARES = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the episode
POINTS = 16


def effort(env: Environment) -> int:
    """Return how many gradients of shorter and whole episodes `measure_growth_of` evaluates."""
    return len(SHARES) * POINTS if env.horizon else 0


def measure_growth_of(env: Environment, dataset: xr.Dataset, watch: Watch) -> GradientGrowth | None:
    """Measure how gradients grow with the length of episodes at points of a slice.

    None where no setting says how long episodes are. Where a scene draws none, time is in the unit of that setting.
    """
    from ..landscapes.measures.gradient_quality import subgrid
    from ..landscapes.measures.lyapunov import measure_growth

    if not env.horizon:
        return None
    time = env.horizon
    with suppress(ValueError):  # nothing to draw
        time = float(env.episode(env.space.center).time[-1])
    plane = plane_of(dataset)
    x = plane.lift(subgrid(plane, math.isqrt(POINTS) if plane.rank == 2 else POINTS))
    boxed = bool(stored_identity(dataset).get("boxed"))
    width, norms = env.space.upper - env.space.lower, list[Tensor]()
    with watch.progress(effort(env), "gradients of shorter episodes") as advance:
        for share in SHARES:
            other = env.with_horizon(share * env.horizon)
            found = evaluate(BoxedObjective(other) if boxed else other, x, grad=True)
            assert found.grad is not None
            norms.append((found.grad * width).norm(dim=1))
            advance(len(norms) * len(x))
    return measure_growth(time * np.array(SHARES), torch.stack(norms).numpy())
