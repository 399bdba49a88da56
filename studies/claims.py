"""What a fidelity's name promises, how far a measured variant falls short of that, and the variant to give it to.

Every promise is a lack that is allowed: of rank correlation 1 - rank, of gradients 1 - cosine, of losses the error. A
variant's shortfall is the largest of its lacks, each as a ratio to what is allowed: it keeps the claim up to 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..landscapes.plain import finite
from .samples import Bootstrap, Comparison, pareto_front

if TYPE_CHECKING:
    from .fidelity import MeasuredVariant


@dataclass(frozen=True)
class Claim:
    """Say what a named fidelity promises of its losses and gradients, compared with the reference's at the same points.

    `rank` is the least Spearman's correlation of losses, `cosine` the least median cosine of gradients, `error` the
    largest 95th percentile of loss errors as a share of their spread; no point may fail.
    """

    name: str
    rank: float
    cosine: float
    error: float

    def limits(self, *, chaotic: bool = False) -> dict[str, float]:
        """Return what may be lacking, by what lacks it; of a chaotic motion gradients promise nothing."""
        found = {"rank": 1 - self.rank, "cosine": 1 - self.cosine, "error": self.error}
        return {what: limit for what, limit in found.items() if not (chaotic and what == "cosine")}


CLAIMS = (Claim("draft", rank=0.95, cosine=0.9, error=0.1), Claim("standard", rank=0.99, cosine=0.98, error=0.03))


@dataclass(frozen=True)
class Shortfall:
    """Hold the largest lack of a variant as a ratio to what a claim allows, with the ends of its 95 % interval.

    `by` names what lacks most. All are infinite where a point failed or lacks its gradient, or where something is not
    known.
    """

    value: float
    low: float
    high: float
    by: str

    @classmethod
    def of(cls, found: Comparison, claim: Claim, *, chaotic: bool = False) -> Shortfall:
        """Hold what was measured of a variant against a claim; an interval's end is the largest of the parts' ends."""
        if found.diverged is None or found.diverged > 0:
            return cls(math.inf, math.inf, math.inf, "failed")
        if found.missing:
            return cls(math.inf, math.inf, math.inf, "missing gradients")
        limits = claim.limits(chaotic=chaotic)
        ratios = {what: [lack / limit for lack in _lacks(found, what)] for what, limit in limits.items()}
        value, low, high = (max(ends) for ends in zip(*ratios.values(), strict=True))
        return cls(value, low, high, max(ratios, key=lambda what: ratios[what][0]))

    @property
    def kept(self) -> bool:
        """Whether the claim is kept."""
        return self.value <= 1


def _lacks(found: Comparison, what: str) -> tuple[float, float, float]:
    """Return a lack and the ends of its interval, infinite where it is not known."""
    if what == "error":
        return _known(found.loss_error.p95_relative, 0.0, 1.0)
    value, low, high = _known(found.spearman if what == "rank" else found.gradient.cosine, 1.0, -1.0)
    return value, high, low


def _known(found: Bootstrap, start: float, sign: float) -> tuple[float, float, float]:
    ends = (found.value, found.low, found.high)
    value, low, high = (math.inf if end is None else start + sign * end for end in ends)
    return value, low, high


def fronts(
    variants: Sequence[MeasuredVariant],
    costs: Mapping[str, Mapping[str, float]],
    claims: Iterable[Claim] = CLAIMS,
    *,
    chaotic: bool = False,
) -> list[str]:
    """Return the variants that for some claim no other beats in both cost and shortfall, the cheapest first.

    `costs` are those that count for a claim, by the names of claim and variant.
    """
    best = dict[str, float]()
    for claim in claims:
        cost = [costs[claim.name][one.name] for one in variants]
        short = [Shortfall.of(one.comparison, claim, chaotic=chaotic).value for one in variants]
        best |= {variants[k].name: variants[k].seconds for k in pareto_front(cost, short)}
    return sorted(best, key=lambda name: best[name])


def nearness(found: Comparison, claims: Iterable[Claim] = CLAIMS, *, chaotic: bool = False) -> float:
    """Return how many times a variant misses the limit of the nearest claim, upwards or downwards, as a logarithm."""
    values = (Shortfall.of(found, claim, chaotic=chaotic).value for claim in claims)
    return min(abs(math.log(max(value, 1e-12))) for value in values)


def surely_beaten(
    found: MeasuredVariant,
    others: Iterable[MeasuredVariant],
    claims: Sequence[Claim] = CLAIMS,
    *,
    chaotic: bool = False,
) -> bool:
    """Say whether for every claim a quicker variant falls short by less, beyond the intervals of both."""

    def shortfall(one: MeasuredVariant, claim: Claim) -> Shortfall:
        return Shortfall.of(one.comparison, claim, chaotic=chaotic)

    quicker = [one for one in others if one.seconds < found.seconds]
    return all(any(shortfall(one, claim).high < shortfall(found, claim).low for one in quicker) for claim in claims)


@dataclass(frozen=True)
class Choice:
    """Say which variant a fidelity's name should mean: the cheapest that keeps the claim, or the nearest to keeping it.

    `today_seconds` is what the variant costs that bears the name [s per episode with gradient], and `today_shortfall`
    how far it falls short, None where that is not finite. `variant`, `seconds` and `shortfall` are of the chosen one,
    None where no variant answers at every point within the limit of the cost, and `lacking` names what it lacks. It is
    one of so many `candidates`.
    """

    claim: Claim
    today_seconds: float
    today_shortfall: float | None
    variant: str | None
    seconds: float | None
    shortfall: float | None
    lacking: str
    candidates: int

    @property
    def kept(self) -> bool:
        """Whether the chosen variant keeps the claim; else it is the nearest to that."""
        return self.shortfall is not None and self.shortfall <= 1


def choose(
    variants: Sequence[MeasuredVariant],
    claim: Claim,
    cost: Mapping[str, float],
    *,
    max_cost: float,
    chaotic: bool = False,
) -> Choice:
    """Choose the variant that a claim's name should mean, of those within `max_cost` times what it costs today.

    It is the cheapest that keeps the claim; where none does, the one whose shortfall is the smallest, the cheaper one
    of two that are equal in two digits. `cost` is by name; the variant of the claim's own name is among the variants.
    """
    short = {one.name: Shortfall.of(one.comparison, claim, chaotic=chaotic) for one in variants}
    limit, today = max_cost * cost[claim.name], finite(short[claim.name].value)
    able = [name for name, found in short.items() if cost[name] <= limit and math.isfinite(found.value)]
    if not able:
        return Choice(claim, cost[claim.name], today, None, None, None, "", 0)
    best = min(able, key=lambda name: (max(float(f"{short[name].value:.2g}"), 1.0), not short[name].kept, cost[name]))
    found = short[best]
    lacking = "" if found.kept else found.by
    return Choice(claim, cost[claim.name], today, best, cost[best], found.value, lacking, len(able))
