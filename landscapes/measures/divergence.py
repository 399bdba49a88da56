"""Divergence of neighbours: how fast motions that begin almost alike part, and whether that is chaos.

A chaotic motion has no reference that others converge to point by point: every error, of a step as of a digit, grows
until it is as large as the motion itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..plain import finite, number, optional
from ..statistics import fit_line, mean
from .fidelity import Bootstrap

Array = NDArray[np.float64]
# A point is chaotic where neighbours part so fast that a small difference would grow a thousandfold over an episode:
# that undoes ten halvings of the step of a first-order scheme (2^10 = 1024).
CHAOTIC = 1000.0
SATURATED = 0.1  # of a motion's extent: from there on a distance cannot grow as it did
FEWEST = 5  # instants that a rate is fitted to
LARGE = 0.1  # of the losses' spread: a difference of losses as large as that is no longer small


@dataclass(frozen=True)
class Growth:
    """Hold how a distance grows: `rate` [1/s], over `duration` [s], and whether it is `saturated` before the end.

    `factor` is what the distance is at last, as a multiple of the first that is not zero; NaN where it is always zero.
    """

    rate: float
    duration: float
    factor: float
    saturated: bool

    @property
    def chaotic(self) -> bool:
        """Whether a small difference would grow a thousandfold over the whole duration at that rate."""
        return bool(self.rate * self.duration >= math.log(CHAOTIC))


def measure_growth(time: Array, distance: Array, *, extent: float) -> Growth:
    """Fit log distance ~ rate x time, over the latter half of the time in which a distance can grow.

    The first half is left out because powers of time grow quickly at first, which is no chaos: a distance like t^n
    gains a factor of 2^n in the latter half. Growth ends where the distance is a tenth of the `extent` of the motion. A
    rate is NaN where fewer than five instants are left.
    """
    known = np.flatnonzero(distance > 0)
    whole = float(time[-1] - time[0])
    if not known.size:
        return Growth(0.0, whole, math.nan, False)
    large = np.flatnonzero(distance >= SATURATED * extent)
    end = int(large[0]) if large.size else len(time) - 1
    middle = (time[known[0]] + time[end]) / 2
    chosen = [k for k in known if middle <= time[k] <= time[end]]
    factor = float(distance[-1] / distance[known[0]])
    if len(chosen) < FEWEST:
        return Growth(math.nan, whole, factor, bool(large.size))
    rate = fit_line(time[chosen], np.log(distance[chosen])).slope
    return Growth(rate, whole, factor, bool(large.size))


@dataclass(frozen=True)
class Response:
    """Say how far losses move for a perturbation of a `size`, as a share of the box: the median, in spreads."""

    size: float
    loss: float | None

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Response:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(number(record["size"]), optional(number, record["loss"]))


@dataclass(frozen=True)
class Divergence:
    """Hold how neighbours part in a scene.

    `rate` [1/s] is the mean over `points` with Student's interval, `chaotic` how many of them are; `size` is what was
    perturbed, as a share of the box. `responses` are those of losses; `saturates_at` is the smallest size at which they
    move by a tenth of their spread, None where none does.
    """

    points: int
    chaotic: int
    size: float
    rate: Bootstrap
    rates: tuple[float | None, ...]
    responses: tuple[Response, ...]
    saturates_at: float | None

    @classmethod
    def of(cls, growths: Sequence[Growth], responses: Sequence[Response], *, size: float) -> Divergence:
        """Sum up what points show."""
        rates = np.array([one.rate for one in growths])
        found = mean(rates)
        large = [one.size for one in responses if one.loss is None or one.loss >= LARGE]
        return cls(
            len(growths),
            sum(one.chaotic for one in growths),
            size,
            Bootstrap(finite(found.value), finite(found.low), finite(found.high)),
            tuple(finite(float(rate)) for rate in rates),
            tuple(responses),
            min(large, default=None),
        )

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Divergence:
        """Read it from plain JSON; raises TypeError and KeyError for what is none."""
        return cls(
            record["points"],
            record["chaotic"],
            number(record["size"]),
            Bootstrap.of_record(record["rate"]),
            tuple(optional(number, rate) for rate in record["rates"]),
            tuple(map(Response.of_record, record["responses"])),
            optional(number, record["saturates_at"]),
        )

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON."""
        return asdict(self)

    def say(self) -> str:
        """Say how neighbours part."""
        moved = "no perturbation up to a thousandth of the box moves"
        if self.saturates_at is not None:
            moved = f"a perturbation of {self.saturates_at:g} of the box moves"
        return (
            f"neighbours part at {interval(self.rate)} 1/s; {self.chaotic} of {self.points} points are chaotic; "
            f"{moved} losses by a tenth of their spread"
        )

    @property
    def is_chaos(self) -> bool:
        """Whether half of the points or more are chaotic: then a scene is judged by distributions."""
        return self.points > 0 and 2 * self.chaotic >= self.points


def interval(found: Bootstrap) -> str:
    """Write a number with the ends of its interval."""
    value, low, high = ("?" if end is None else f"{end:z.3g}" for end in (found.value, found.low, found.high))
    return f"{value} ({low} to {high})"
