"""Growth of gradients with the length of an episode: the largest Lyapunov exponent of a motion, or its power of time.

How far a motion's end moves for a change of a parameter, |dx(t)/dp|, grows by the largest Lyapunov exponent: like
exp(rate x t) where neighbours part for good. What only flies on grows like a power of time, which is no divergence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..statistics import Estimate, Values, fit_line, mean

MIN_HORIZONS = 4  # horizons that a rate is fitted to
MIN_KNOWN_SHARE = 0.5  # share of the points whose gradients must be known at all horizons


@dataclass(frozen=True)
class GradientGrowth:
    """Hold how gradients grow with the length of episodes.

    `rate` [1/s] is the mean over points of the slope of log |gradient| against time, `power` that against log time,
    each NaN where it cannot be told; `misfit` are the standard deviations of what either leaves, in that order. `time`
    [s] are the lengths, `norm` [loss unit per box] the medians over points, of `known` of `points`.
    """

    rate: Estimate
    power: Estimate
    misfit: tuple[float, float]
    time: tuple[float, ...]
    norm: tuple[float, ...]
    known: int
    points: int

    @property
    def is_exponential(self) -> bool:
        """Whether gradients grow like an exponential: nearer to it than to a power, and beyond chance."""
        return bool(self.rate.low > 0 and self.misfit[0] < self.misfit[1])

    def describe(self) -> str:
        """Say in a line how gradients grow."""
        if not math.isfinite(self.rate.value):
            return f"how gradients grow is not known: at {self.known} of {self.points} points they are at every horizon"
        if self.is_exponential:
            low, high = self.rate.low, self.rate.high
            return f"gradients grow like exp({self.rate.value:z.3g} t), t in s ({low:z.3g} to {high:z.3g}/s)"
        low, high = self.power.low, self.power.high
        return f"gradients grow like t^{self.power.value:z.2g} ({low:z.2g} to {high:z.2g}), not exponentially"


def measure_growth(time: Values, norm: Values) -> GradientGrowth:
    """Fit how |gradients|, shape (horizon, point), grow with the ascending lengths of episodes `time` [s].

    Each point is fitted by itself, an exponential and a power of time; points whose gradient is zero or failed at some
    horizon are left out. Raises ValueError where lengths do not ascend from above zero.
    """
    if not (time > 0).all() or not (np.diff(time) > 0).all():
        raise ValueError(f"lengths of episodes ascend from above 0; got {time.tolist()}")
    there = np.isfinite(norm).all(axis=0) & (norm > 0).all(axis=0)
    known, points = int(there.sum()), norm.shape[1]
    medians = np.full(len(time), math.nan)
    nothing = Estimate(math.nan, math.nan, math.nan)
    if known:
        medians = np.median(norm[:, there], axis=1)
    if len(time) < MIN_HORIZONS or known < 2 or known < MIN_KNOWN_SHARE * points:
        return GradientGrowth(
            nothing, nothing, (math.nan, math.nan), tuple(time.tolist()), tuple(medians.tolist()), known, points
        )
    logs = np.log(norm[:, there])
    fits = [[_fit(axis, column) for column in logs.T] for axis in (time, np.log(time))]
    rate, power = (mean(np.array([slope for slope, _ in fit])) for fit in fits)
    first, second = (math.sqrt(float(np.mean([left**2 for _, left in fit]))) for fit in fits)
    return GradientGrowth(rate, power, (first, second), tuple(time.tolist()), tuple(medians.tolist()), known, points)


def _fit(axis: Values, values: Values) -> tuple[float, float]:
    """Return the slope of a line through values, and the standard deviation of what it leaves."""
    found = fit_line(axis, values)
    return found.slope, float(np.std(values - found.intercept - found.slope * axis))
