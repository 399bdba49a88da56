"""Growth of gradients with the length of an episode: exponential, by a power of time, bounded, or undecided.

The change of a motion's end with a parameter, |dx(t)/dp|, grows with the largest Lyapunov exponent: like exp(rate x t)
where neighbouring motions diverge. In free flight it grows like a power of time, and in oscillations it stays bounded:
neither is divergence. Points of a slice oscillate together, so many points do not separate these cases; only several
lengths of episodes do. The shape is judged from the medians over points, one for each length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ..statistics import UNKNOWN, Estimate, Line, Values, fit_line, mean, student

MIN_HORIZONS = 4  # horizons that a rate is fitted to
MIN_KNOWN_SHARE = 0.5  # share of the points whose gradients must be known at all horizons
EVIDENCE = 4.0  # of AICc, by which one shape has to beat the others (Burnham & Anderson 2002, section 2.6)
TIMES = np.geomspace(0.02, 1.0, 60)  # after which growth has ended, in lengths of the longest episode
EXACT = 1e-20  # squared errors of a logarithm that are rounding


class Shape(StrEnum):
    """How gradients grow with the length of episodes."""

    EXPONENTIAL = "exponential"
    POWER = "power"
    BOUNDED = "bounded"
    UNDECIDED = "cannot tell"


@dataclass(frozen=True)
class GradientGrowth:
    """The growth of gradients with the length of episodes.

    `rate` [1/s] is the mean over points of the slope of log |gradient| against time, `power` that against log time,
    each NaN where unknown. `misfit` are the residual standard deviations of both, in that order. `time` [s] are the
    lengths, `norm` [loss unit per box] the medians over points, for `known` of `points`.
    """

    rate: Estimate
    power: Estimate
    misfit: tuple[float, float]
    time: tuple[float, ...]
    norm: tuple[float, ...]
    known: int
    points: int

    @property
    def shape(self) -> Shape:
        """The growth of the medians.

        If a straight line rises beyond chance (Student's 95 % interval of its slope), the shape is the one of
        exponential, power and saturation with the lowest AICc, by `EVIDENCE` or more. If none rises, it is bounded if
        the interval excludes growth in proportion to time.
        """
        if not math.isfinite(self.rate.value):
            return Shape.UNDECIDED
        time, logs = np.array(self.time), np.log(self.norm)
        exponential, power = fit_line(time, logs), fit_line(np.log(time), logs)
        if max(one.slope - _reach(one, len(time)) for one in (exponential, power)) <= 0:
            return Shape.BOUNDED if power.slope + _reach(power, len(time)) < 1 else Shape.UNDECIDED
        left = {
            Shape.EXPONENTIAL: _squares(logs - exponential.slope * time),
            Shape.POWER: _squares(logs - power.slope * np.log(time)),
            Shape.BOUNDED: min(_squares(logs - np.log(-np.expm1(-time / (at * time[-1])))) for at in TIMES),
        }
        best, second = sorted(left, key=lambda shape: left[shape])[:2]
        told = len(time) * math.log(left[second] / left[best])  # AICc of shapes that have as many parameters
        return best if told > EVIDENCE else Shape.UNDECIDED

    def describe(self) -> str:
        """Describe in a line how gradients grow."""
        if not math.isfinite(self.rate.value):
            return (
                f"the growth of gradients is unknown: they exist at every horizon at {self.known} of {self.points} "
                "points"
            )
        rate, power = (f"{one.value:z.2g} ({one.low:z.2g} to {one.high:z.2g})" for one in (self.rate, self.power))
        if self.shape is Shape.EXPONENTIAL:
            low, high = self.rate.low, self.rate.high
            return f"gradients grow like exp({self.rate.value:z.3g} t), t in s ({low:z.3g} to {high:z.3g}/s)"
        if self.shape is Shape.POWER:
            return f"gradients grow like t^{power}, not exponentially"
        if self.shape is Shape.BOUNDED:
            return f"gradients stay bounded; a power of time would have exponent {power}"
        return (
            f"the growth of gradients is undecided: an exponential has {rate}/s, a power of time has exponent {power}"
        )


def measure_growth(time: Values, norm: Values) -> GradientGrowth:
    """Fit the growth of |gradients|, shape (horizon, point), with the ascending lengths of episodes `time` [s].

    An exponential and a power of time are fitted to each point; points with a zero or failed gradient at some horizon
    are left out. Intervals combine those of the mean over points and of the fit to the medians, added in squares.
    Raises ValueError where lengths are not positive and ascending.
    """
    if not (time > 0).all() or not (np.diff(time) > 0).all():
        raise ValueError(f"lengths of episodes must be positive and ascending; got {time.tolist()}")
    there = np.isfinite(norm).all(axis=0) & (norm > 0).all(axis=0)
    known, points = int(there.sum()), norm.shape[1]
    medians = np.median(norm[:, there], axis=1) if known else np.full(len(time), math.nan)
    drawn = tuple(time.tolist()), tuple(medians.tolist()), known, points
    if len(time) < MIN_HORIZONS or known < 2 or known < MIN_KNOWN_SHARE * points:
        return GradientGrowth(UNKNOWN, UNKNOWN, (math.nan, math.nan), *drawn)
    logs, axes = np.log(norm[:, there]), (time, np.log(time))
    fits = [[_fit(axis, column) for column in logs.T] for axis in axes]
    rate, power = (
        _widened(mean(np.array([slope for slope, _ in fit])), fit_line(axis, np.log(medians)), len(time))
        for fit, axis in zip(fits, axes, strict=True)
    )
    first, second = (math.sqrt(float(np.mean([left**2 for _, left in fit]))) for fit in fits)
    return GradientGrowth(rate, power, (first, second), *drawn)


def _fit(axis: Values, values: Values) -> tuple[float, float]:
    """Return the slope of a line through values, and the residual standard deviation."""
    found = fit_line(axis, values)
    return found.slope, float(np.std(values - found.intercept - found.slope * axis))


def _widened(found: Estimate, line: Line, count: int) -> Estimate:
    """Return the interval of a mean over dependent points, by the line through `count` medians."""
    reach = math.hypot(found.high - found.value, _reach(line, count))
    return Estimate(found.value, found.value - reach, found.value + reach)


def _reach(line: Line, count: int) -> float:
    """Return the half-width of the 95 % interval of the slope of a line through this many points."""
    return float(line.standard_error * student(count - 2))


def _squares(left: Values) -> float:
    """Return the sum of squares about the mean, at least as large as rounding."""
    return float(((left - left.mean()) ** 2).sum()) + EXACT
