"""Orderings of optimisers that somebody claims, and which of them hold in a race."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from .standings import Difference


@dataclass(frozen=True)
class Claim:
    """Say that one method is claimed to be ahead of another, or neither ahead (`alike`), and where."""

    first: str
    second: str
    source: str
    alike: bool = False

    def __str__(self) -> str:
        return f"{self.first} {'and' if self.alike else 'better than'} {self.second}{' alike' if self.alike else ''}"


class Verdict(StrEnum):
    """Say what a race makes of a claim."""

    HOLDS = "holds"
    FAILS = "does not hold"
    UNDECIDED = "not decided"
    NOT_RUN = "not run"


@dataclass(frozen=True)
class Finding:
    """A claim, what the race makes of it, and the difference it was measured by, None where it was not run."""

    claim: Claim
    verdict: Verdict
    difference: Difference | None


def findings(claims: Sequence[Claim], differences: Sequence[Difference]) -> list[Finding]:
    """Return what a race makes of each of the claims about its environment."""
    measured = {(found.first, found.second): found for one in differences for found in (one, one.reversed)}
    return [_finding(claim, measured.get((claim.first, claim.second))) for claim in claims]


def _finding(claim: Claim, found: Difference | None) -> Finding:
    """Judge a claim; that two are alike can be refuted by an interval, never shown."""
    if found is None:
        return Finding(claim, Verdict.NOT_RUN, None)
    if found.better is None:
        return Finding(claim, Verdict.UNDECIDED, found)
    holds = not claim.alike and found.better == claim.first
    return Finding(claim, Verdict.HOLDS if holds else Verdict.FAILS, found)
