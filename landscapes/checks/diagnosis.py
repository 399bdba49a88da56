"""What a check concludes: what is wrong with a gradient, how sure that is, where it is so, and what to try."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from .finding import Numbers

Certainty = Literal["certain", "likely", "possible"]
CERTAINTIES: tuple[Certainty, ...] = ("certain", "likely", "possible")


@dataclass(frozen=True)
class Region:
    """Describe where gradients are wrong, by the simplest rule that holds.

    `rule` is a sentence's end, such as "a between 0.52 and 0.95". `error` is the share of the points that the rule puts
    on the wrong side, and `checked` the number of points it was tried at.
    """

    rule: str
    parameters: tuple[str, ...]
    error: float
    checked: int


@dataclass(frozen=True)
class Diagnosis:
    """Say what is wrong with a gradient.

    `cause` is the name of a file in `causes/`, empty where none fits; `outcome` is fail, or warn where no gradient is
    wrong. `what` is a sentence with its number, `parameters` are those concerned, empty where all are, and `region` is
    None where it holds in the whole box. `remedy` says what to try.
    """

    cause: str
    outcome: str
    certainty: Certainty
    what: str
    remedy: str
    parameters: tuple[str, ...] = ()
    region: Region | None = None
    numbers: Numbers = field(default_factory=dict)
