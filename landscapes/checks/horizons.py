"""Find the time at which a gradient goes wrong: the shortest episode with a wrong gradient, by bisection."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

Made = TypeVar("Made")


@dataclass(frozen=True)
class FirstWrong:
    """The shortest length of an episode with a wrong gradient, in the unit of the horizon.

    `right` is the next shorter one, whose gradient is right, None where the shortest of all is already wrong.
    """

    length: float
    right: float | None


def first_wrong_step(
    make: Callable[[float], Made], lengths: Iterable[float], is_wrong: Callable[[Made], bool]
) -> FirstWrong | None:
    """Return the shortest wrong length, None where the longest is right or all are refused.

    It assumes that a wrong gradient stays wrong in longer episodes, so the number of trials is the logarithm of the
    number of lengths. `make` or `is_wrong` can refuse a length by ValueError; then the next one is tried.
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
