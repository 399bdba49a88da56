"""What is claimed of methods, and what a race makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from .statistics import Difference, Superiority


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
    """A claim, what the race makes of it, and how the two compare, seen from the first; None where one was not run."""

    claim: Claim
    verdict: ClaimVerdict
    difference: Difference | None
    superiority: Superiority | None


def check_claims(
    claims: Sequence[Claim], differences: Sequence[Difference], superiorities: Sequence[Superiority]
) -> list[ClaimFinding]:
    """Return what a race makes of each claim, by the rank tests of its methods, corrected for all pairs of the race."""
    means = {(found.first, found.second): found for one in differences for found in (one, one.reversed)}
    chances = {(found.first, found.second): found for one in superiorities for found in (one, one.reversed)}
    pairs = [(claim.first, claim.second) for claim in claims]
    return [
        ClaimFinding(claim, judge(claim, chances.get(pair)), means.get(pair), chances.get(pair))
        for claim, pair in zip(claims, pairs, strict=True)
    ]


def judge(claim: Claim, superiority: Superiority | None) -> ClaimVerdict:
    """Return what is to be made of a claim, by its two methods; that two are alike can be refuted, never shown."""
    if superiority is None:
        return ClaimVerdict.NOT_RUN
    if superiority.better is None:
        return ClaimVerdict.UNDECIDED
    holds = not claim.alike and superiority.better == claim.first
    return ClaimVerdict.HOLDS if holds else ClaimVerdict.FAILS
