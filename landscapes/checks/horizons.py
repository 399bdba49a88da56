"""Where in time a gradient goes wrong: the shortest episode whose gradient is wrong, by bisection."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

Made = TypeVar("Made")


@dataclass(frozen=True)
class FirstWrong:
    """Hold the shortest length of an episode with a wrong gradient, in the unit of the horizon.

    `right` is the next shorter one, whose gradient is right, None where the shortest of all is wrong already.
    """

    length: float
    right: float | None


def first_wrong_step(
    make: Callable[[float], Made], lengths: Iterable[float], is_wrong: Callable[[Made], bool]
) -> FirstWrong | None:
    """Return the shortest length that is wrong, None where the longest is right or all are refused.

    A gradient that is wrong is taken to stay so in longer episodes: that makes the number of trials the logarithm of
    the number of lengths. `make` or `is_wrong` may refuse a length by ValueError; then the next one is tried.
    """
    ahead = sorted(set(lengths))

    def judge(length: float) -> bool | None:
        try:
            return is_wrong(make(length))
        except ValueError:
            return None

    while ahead and (wrong := judge(ahead[-1])) is not True:
        if wrong is False:
            return None
        del ahead[-1]
    right, wrong_from = 0, len(ahead) - 1  # those before the first are right, and this one is wrong
    while right < wrong_from:
        middle = (right + wrong_from) // 2
        wrong = judge(ahead[middle])
        if wrong is None:
            del ahead[middle]
            wrong_from -= 1
        elif wrong:
            wrong_from = middle
        else:
            right = middle + 1
    return FirstWrong(ahead[right], ahead[right - 1] if right else None) if ahead else None
