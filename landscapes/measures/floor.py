"""The numerical floor: the change of losses and gradients when only the numerics change, not the physics.

An objective has replicas, `Objective.replicas`: the grid shifted by a part of a cell, other particles, the mirrored
scene. Differences between them are no features of the landscape, so no measure counts anything below them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..objective import Evaluation, Objective, evaluate
from ..statistics import CONFIDENCE, UNKNOWN, Estimate, Values, exactly, gradient_error, middle_95, ratio

MIN_POINTS = 4  # that an interval needs
RESAMPLES = 999  # of the bootstrap


@dataclass(frozen=True)
class Floor:
    """The differences between replicas of an objective at some points.

    `names` are the replicas; `points` is the number of points where all of them have a loss, `failed` the number left
    out. `deviation` [loss unit] is the root mean square, over points, of the standard deviation between the original
    and its replicas. `range` [loss unit] is its reference, and `share` = deviation / range. `cosine` is the median
    cosine of the replicas' gradients with the original's, per width of the box; None without gradients. Intervals are
    NaN below four points.
    """

    names: tuple[str, ...]
    points: int
    failed: int
    deviation: float
    range: float
    share: Estimate
    cosine: Estimate | None

    def sentence(self) -> str:
        """Return it in words: "numerical floor 0.8 % of the range; gradients of replicas: cosine 0.97"."""
        if not math.isfinite(self.share.value):
            return f"numerical floor unknown: {'all losses are the same' if self.points else 'every point failed'}"
        said = f"numerical floor {100 * self.share.value:.2g} % of the range"
        if self.cosine is None or not math.isfinite(self.cosine.value):
            return said
        return f"{said}; gradients of replicas: cosine {format_cosine(self.cosine.value)}"


def format_cosine(cosine: float) -> str:
    """Return a cosine with two decimals, or three where two would round it to 1."""
    return f"{cosine:z.2f}" if abs(cosine) < 0.995 else f"{cosine:z.3f}"


def evaluate_replicas(
    objective: Objective, x: Float[Tensor, "points dim"], replicas: Mapping[str, Objective], *, grad: bool
) -> dict[str, Evaluation]:
    """Evaluate each replica of an objective at points, with one replica in memory at a time.

    Raises ValueError where a replica has another space, and any error of `evaluate`.
    """
    found = {}
    objective.release()
    for name, replica in replicas.items():
        refuse_other_space(objective, name, replica)
        found[name] = evaluate(replica, x, grad=grad)
        replica.release()
    return found


def refuse_other_space(objective: Objective, name: str, replica: Objective) -> None:
    """Raise ValueError where a replica has other parameters than the objective."""
    if replica.space.names != objective.space.names:
        raise ValueError(
            f"{objective.name}'s replica {name!r} must take the same parameters, {', '.join(objective.space.names)}; "
            f"got {', '.join(replica.space.names)}"
        )


def floor_between(
    own: Evaluation,
    replicas: Mapping[str, Evaluation],
    *,
    sides: Float[Tensor, " dim"] | None = None,
    range: float | None = None,
    seed: int = 0,
) -> Floor:
    """Measure the differences between evaluations of an objective and its replicas at the same points.

    `sides` are the widths of the box, which scale gradients before their cosine is taken. `range` [loss unit] is by
    default that of the losses. Raises ValueError where a replica was evaluated at another number of points.
    """
    for name, found in replicas.items():
        if len(found.loss) != len(own.loss):
            raise ValueError(
                f"the replica {name!r} has {len(found.loss)} points, but the objective has {len(own.loss)}"
            )
    apart = point_deviations(own, replicas).numpy()
    apart = apart[np.isfinite(apart)]
    if range is None:
        known = own.loss[own.has_loss]
        range = float(known.max() - known.min()) if len(known) else math.nan
    spread = _pooled_deviation(apart, len(replicas))
    share = Estimate(*(ratio(end, range) for end in (spread.value, spread.low, spread.high)))
    failed = len(own.loss) - len(apart)
    cosine = _cosine(own, replicas, sides, seed)
    return Floor(tuple(replicas), len(apart), failed, spread.value, range, share, cosine)


def point_deviations(own: Evaluation, replicas: Mapping[str, Evaluation]) -> Float[Tensor, " points"]:
    """Return the standard deviation between an objective and its replicas at each point, NaN without all losses."""
    losses = torch.stack([own.loss, *(found.loss for found in replicas.values())]).double()
    return (losses - losses[0]).std(dim=0)  # of differences, so that those of losses that agree are exactly 0


def replica_cosines(own: Evaluation, replica: Evaluation, sides: Float[Tensor, " dim"] | None = None) -> Values:
    """Return the cosine of a replica's gradient with the original's at each point, NaN where one has none."""
    slopes = [found.grad.double() for found in (own, replica) if found.grad is not None]
    if len(slopes) < 2:
        return np.full(len(own.loss), np.nan)
    first, second = ((slope if sides is None else slope * sides).numpy() for slope in slopes)
    cosine, _ = gradient_error(second, first)
    return np.where((own.has_gradient & replica.has_gradient).numpy(), cosine, np.nan)


def _pooled_deviation(apart: Values, freedom: int) -> Estimate:
    """Return the root mean square of standard deviations, each with this many degrees of freedom.

    Its interval is that of a scaled chi-square whose degrees of freedom fit the spread of the variances (Satterthwaite
    1946). It covers the true value more often than a bootstrap where points are few and unequal.
    """
    if not len(apart):
        return UNKNOWN
    variances = apart**2
    whole = float(variances.mean())
    if len(apart) < MIN_POINTS:
        return exactly(math.sqrt(whole))
    if whole == 0:
        return Estimate(0.0, 0.0, 0.0)
    from scipy.special import chdtri

    most, spread = float(freedom * len(apart)), float(variances.var(ddof=1))
    held = max(1.0, min(most, 2 * whole**2 * len(apart) / spread) if spread else most)
    tails = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)
    low, high = (math.sqrt(whole * held / float(chdtri(held, tail))) for tail in tails)
    return Estimate(math.sqrt(whole), low, high)


def _cosine(
    own: Evaluation, replicas: Mapping[str, Evaluation], sides: Float[Tensor, " dim"] | None, seed: int
) -> Estimate | None:
    """Return the median over points and replicas, with a percentile bootstrap over the points (Efron 1979)."""
    if own.grad is None or any(found.grad is None for found in replicas.values()):
        return None
    cosines = np.stack([replica_cosines(own, found, sides) for found in replicas.values()], axis=1)
    cosines = cosines[np.isfinite(cosines).any(axis=1)]
    if not len(cosines):
        return UNKNOWN
    value = float(np.nanmedian(cosines))
    if len(cosines) < MIN_POINTS:
        return exactly(value)
    rows = np.random.default_rng(seed).integers(len(cosines), size=(RESAMPLES, len(cosines)))
    return middle_95(value, np.nanmedian(cosines[rows].reshape(RESAMPLES, -1), axis=1))
