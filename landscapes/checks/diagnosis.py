"""The conclusion of a check: the error of a gradient, its certainty, its region, and a remedy."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from .finding import Numbers

Certainty = Literal["certain", "likely", "possible"]
CERTAINTIES: tuple[Certainty, ...] = ("certain", "likely", "possible")


@dataclass(frozen=True)
class Region:
    """Describe where gradients are wrong, by the simplest valid rule.

    `rule` ends a sentence, such as "a between 0.52 and 0.95". `error` is the share of points on the wrong side of the
    rule, and `checked` the number of points it was tested on.
    """

    rule: str
    parameters: tuple[str, ...]
    error: float
    checked: int


@dataclass(frozen=True)
class Diagnosis:
    """Describe what is wrong with a gradient.

    `cause` is the name of a file in `causes/`, empty where none fits; `outcome` is fail, or warn where no gradient is
    wrong. `what` is a sentence with its number, `parameters` are the affected ones, empty for all. `region` is None
    where it applies to the whole box. `remedy` is the advice.
    """

    cause: str
    outcome: str
    certainty: Certainty
    what: str
    remedy: str
    parameters: tuple[str, ...] = ()
    region: Region | None = None
    numbers: Numbers = field(default_factory=dict)
