"""Ticks of an axis of decimal logarithms: at decades, at 1, 2 and 5 where these are few, or at round values."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, Locator

from . import style

WIDE = 6  # ticks in a panel with room for them
PLAIN = 3  # digits of values that are written without a power of ten
NEAR = 1e-9  # what rounding may change of a logarithm
DENSE = (range(1, 10), (1, 2, 5))  # multiples of powers of ten, from the densest on


def decades(low: float, high: float, most: int = WIDE) -> list[float]:
    """Return the logarithms of about so many round values whose logarithms lie between two ends, ascending."""
    whole = range(math.ceil(low - NEAR), math.floor(high + NEAR) + 1)
    if len(whole) >= max(2, most // 2):
        every = -(-len(whole) // most)
        return [float(power) for power in whole if power % every == 0]
    for factors in reversed(DENSE):
        if len(found := _multiples(low, high, factors)) >= max(2, most // 2):
            return found
    values = style.round_values(10.0**low * (1 - NEAR), 10.0**high * (1 + NEAR))
    return [min(max(math.log10(value), low), high) for value in values]


def between_decades(low: float, high: float, most: int = WIDE) -> list[float]:
    """Return where minor ticks are: at 2 to 9 times powers of ten where there is room, else at decades."""
    return _multiples(low, high, range(1, 10) if high - low <= most else (1,))


def _multiples(low: float, high: float, factors: Sequence[int]) -> list[float]:
    powers = range(math.floor(low), math.ceil(high) + 1)
    places = [power + math.log10(factor) for power in powers for factor in factors]
    return [place for place in places if low - NEAR <= place <= high + NEAR]


def write_power(place: float) -> str:
    """Write the value whose logarithm this is: a multiple of a power of ten, or else a plain number."""
    factor = 10.0 ** (place - math.floor(place + NEAR))
    return style.power(10.0**place, PLAIN) if abs(factor - round(factor)) < 1e-6 else style.number(10.0**place)


class DecadeLocator(Locator):
    """Find the ticks of a matplotlib axis whose coordinates are decimal logarithms: `decades`, or those between."""

    def __init__(self, most: int, *, minor: bool = False) -> None:
        self.most, self.minor = most, minor

    def __call__(self) -> Sequence[float]:
        """Return where ticks are on the axis as it is seen."""
        assert self.axis is not None  # as matplotlib has set it
        return self.tick_values(*self.axis.get_view_interval())

    def tick_values(self, vmin: float, vmax: float) -> Sequence[float]:
        """Return where ticks are between two ends."""
        low, high = sorted((vmin, vmax))
        return between_decades(low, high, self.most) if self.minor else decades(low, high, self.most)


def mark_decades(axis: Axis, most: int = WIDE) -> None:
    """Give a matplotlib axis whose coordinates are decimal logarithms the ticks of the values."""
    axis.set_major_locator(DecadeLocator(most))
    axis.set_minor_locator(DecadeLocator(most, minor=True))
    axis.set_major_formatter(FuncFormatter(lambda place, _: write_power(place)))
