"""The options of a method: a frozen dataclass whose numbers keep to ranges that their fields state."""

from __future__ import annotations

from dataclasses import Field, dataclass, field, fields
from numbers import Integral, Real
from typing import Any, ClassVar

MANY = 1_000_000_000  # of what no run comes near: as good as no limit


def number(default: float, least: float, most: float) -> Any:
    """Return the field of an option that takes numbers from `least` to `most`, whole ones where it is an int."""
    return field(default=default, metadata={"range": (least, most)})


@dataclass(frozen=True)
class MethodOptions:  # noqa: D101 -- its words would stand among those that `landscape methods NAME` prints
    method: ClassVar[str]  # whose options they are

    def __post_init__(self) -> None:
        for option in fields(self):
            if "range" in option.metadata:
                self._check(option)

    def _check(self, option: Field[Any]) -> None:
        least, most = option.metadata["range"]
        kind, words = (Integral, "whole numbers") if option.type == "int" else (Real, "numbers")
        value = getattr(self, option.name)
        if not isinstance(value, kind) or isinstance(value, bool) or not least <= value <= most:
            raise ValueError(
                f"{self.method} option {option.name} takes {words} from {least:g} to {most:g}; got {value}"
            )
