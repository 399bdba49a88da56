"""The options of a method: a frozen dataclass whose numbers stay in the ranges that their fields give."""

from __future__ import annotations

from dataclasses import Field, dataclass, field, fields
from numbers import Integral, Real
from typing import Any, ClassVar

MANY = 1_000_000_000  # of what no run comes near: as good as no limit
OURS, PAPER, LIBRARY = "ours", "the paper's", "the library's ({})"  # whose choice a default is


def number(default: float, least: float, most: float, source: str = OURS) -> Any:
    """Return the field of an option that takes numbers from `least` to `most`, integers where it is an int.

    `source` names who chose the default.
    """
    return field(default=default, metadata={"range": (least, most), "source": source})


def choice(default: str, source: str = OURS) -> Any:
    """Return the field of an option that takes one of several words."""
    return field(default=default, metadata={"source": source})


@dataclass(frozen=True)
class Default:
    """The default of an option, and who chose it."""

    option: str
    value: str
    source: str


def defaults(options: type[MethodOptions]) -> tuple[Default, ...]:
    """Return the defaults of a method, in the order of its options."""
    return tuple(Default(one.name, f"{one.default}", one.metadata["source"]) for one in fields(options))


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
