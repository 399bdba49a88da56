"""What is claimed of methods, and what a race makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from .statistics import Difference


@dataclass(frozen=True)
class Claim:
    """Say that one method is claimed to be ahead of another, or neither ahead (`alike`), and where that stands."""

    first: str
    second: str
    source: str
    alike: bool = False

    def __str__(self) -> str:
        return f"{self.first} {'and' if self.alike else 'better than'} {self.second}{' alike' if self.alike else ''}"


@dataclass(frozen=True)
class Claims:
    """What is claimed of an environment; `silence` says why that is nothing."""

    claims: tuple[Claim, ...] = ()
    silence: str | None = None


class ClaimVerdict(StrEnum):
    """Say what a race makes of a claim."""

    HOLDS = "holds"
    FAILS = "does not hold"
    UNDECIDED = "not decided"
    NOT_RUN = "not run"


@dataclass(frozen=True)
class ClaimFinding:
    """A claim, what the race makes of it, and the difference it was measured by, None where it was not run."""

    claim: Claim
    verdict: ClaimVerdict
    difference: Difference | None


def check_claims(claims: Sequence[Claim], differences: Sequence[Difference]) -> list[ClaimFinding]:
    """Return what a race, by the differences of its methods, makes of each claim."""
    measured = {(found.first, found.second): found for one in differences for found in (one, one.reversed)}
    return [_check(claim, measured.get((claim.first, claim.second))) for claim in claims]


def _check(claim: Claim, difference: Difference | None) -> ClaimFinding:
    """Check a claim; that two are alike can be refuted by an interval, never shown."""
    if difference is None:
        return ClaimFinding(claim, ClaimVerdict.NOT_RUN, None)
    if difference.better is None:
        return ClaimFinding(claim, ClaimVerdict.UNDECIDED, difference)
    holds = not claim.alike and difference.better == claim.first
    return ClaimFinding(claim, ClaimVerdict.HOLDS if holds else ClaimVerdict.FAILS, difference)
