"""Causes of wrong gradients: one file each, with its signature of numbers, its message and its remedy.

A cause explains one kind of finding (`of`): wrong gradients, NaN, gradients that are always 0, slopes that cannot be
judged, or calls that depend on each other. The cause is the first by `order` with a matching signature. A signature
matches if each of its numbers is in one of its intervals.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources

from ..diagnosis import Certainty
from ..finding import FAIL, WARN

WARNED = ("zero", "steep", "noise", "jumps", "physics", "memory")  # kinds of findings that are no wrong gradients
Intervals = list[list[float]]


@dataclass(frozen=True)
class Signature:
    """Intervals of numbers that identify a cause, its certainty, and whether it fails or warns."""

    certainty: Certainty
    outcome: str
    numbers: Mapping[str, Intervals]

    def holds(self, evidence: Mapping[str, float]) -> bool:
        """Return whether all its numbers are known and inside their intervals."""
        return all(
            name in evidence and any(low <= evidence[name] <= high for low, high in intervals)
            for name, intervals in self.numbers.items()
        )


@dataclass(frozen=True)
class Cause:
    """A cause, as in its file."""

    name: str
    of: str
    order: int
    says: str
    remedy: str
    signatures: tuple[Signature, ...]


@cache
def causes() -> tuple[Cause, ...]:
    """Return the causes in the order in which they are tried."""
    found = []
    for file in resources.files(__name__).iterdir():
        if file.name.endswith(".toml"):
            read = tomllib.loads(file.read_text())
            usual = WARN if read["of"] in WARNED else FAIL
            signatures = [
                Signature(one.pop("certainty"), one.pop("outcome", usual), one) for one in read.pop("signature")
            ]
            found.append(Cause(**read, signatures=tuple(signatures)))
    return tuple(sorted(found, key=lambda one: one.order))


def recognise(of: str, evidence: Mapping[str, float]) -> tuple[Cause, Signature] | None:
    """Return the cause of a kind of finding from its numbers, and the matching signature; None without a match."""
    for cause in causes():
        if cause.of == of:
            for signature in cause.signatures:
                if signature.holds(evidence):
                    return cause, signature
    return None
