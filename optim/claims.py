"""Claims about methods, and the verdict of a race on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from .statistics import Difference, Superiority


@dataclass(frozen=True)
class Claim:
    """Claim that one method is ahead of another, or that neither is (`alike`), with the source of the claim."""

    first: str
    second: str
    source: str
    alike: bool = False

    def __str__(self) -> str:
        return f"{self.first} {'and' if self.alike else 'better than'} {self.second}{' alike' if self.alike else ''}"


@dataclass(frozen=True)
class Claims:
    """The claims about an environment; `silence` says why there is none."""

    claims: tuple[Claim, ...] = ()
    silence: str | None = None


class ClaimVerdict(StrEnum):
    """The verdict of a race on a claim."""

    HOLDS = "holds"
    FAILS = "does not hold"
    UNDECIDED = "not decided"
    NOT_RUN = "not run"


@dataclass(frozen=True)
class ClaimFinding:
    """A claim, its verdict, and the comparison of the two methods from the first; None where one was not run."""

    claim: Claim
    verdict: ClaimVerdict
    difference: Difference | None
    superiority: Superiority | None


def check_claims(
    claims: Sequence[Claim], differences: Sequence[Difference], superiorities: Sequence[Superiority]
) -> list[ClaimFinding]:
    """Return the verdict of a race on each claim, by rank tests corrected for all pairs of the race."""
    means = {(found.first, found.second): found for one in differences for found in (one, one.reversed)}
    chances = {(found.first, found.second): found for one in superiorities for found in (one, one.reversed)}
    pairs = [(claim.first, claim.second) for claim in claims]
    return [
        ClaimFinding(claim, judge(claim, chances.get(pair)), means.get(pair), chances.get(pair))
        for claim, pair in zip(claims, pairs, strict=True)
    ]


def judge(claim: Claim, superiority: Superiority | None) -> ClaimVerdict:
    """Return the verdict on a claim about two methods; a claim that two are alike can be refuted, never confirmed."""
    if superiority is None:
        return ClaimVerdict.NOT_RUN
    if superiority.better is None:
        return ClaimVerdict.UNDECIDED
    holds = not claim.alike and superiority.better == claim.first
    return ClaimVerdict.HOLDS if holds else ClaimVerdict.FAILS
