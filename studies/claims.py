"""The claim of a fidelity's name, the shortfall of a measured variant, and the variant that should have the name.

Every claim limits a shortfall: 1 - rank for the rank correlation, 1 - cosine for gradients, the error for losses. A
variant's shortfall is the largest of these, each relative to its limit: it keeps the claim up to 1.
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
    """The claim of a named fidelity on its losses and gradients, compared with the reference's at the same points.

    `rank` is the smallest Spearman's correlation of losses, `cosine` the smallest median cosine of gradients, `error`
    the largest 95th percentile of loss errors as a share of their spread; no point may fail.
    """

    name: str
    rank: float
    cosine: float
    error: float

    def limits(self, *, chaotic: bool = False) -> dict[str, float]:
        """Return the limit of each shortfall, by name; gradients of a chaotic motion have none."""
        found = {"rank": 1 - self.rank, "cosine": 1 - self.cosine, "error": self.error}
        return {what: limit for what, limit in found.items() if not (chaotic and what == "cosine")}


CLAIMS = (Claim("draft", rank=0.95, cosine=0.9, error=0.1), Claim("standard", rank=0.99, cosine=0.98, error=0.03))


@dataclass(frozen=True)
class Shortfall:
    """The largest shortfall of a variant, relative to its limit in a claim, with the ends of its 95 % interval.

    `by` names the worst quantity. All are infinite where a point failed or lacks its gradient, or where something is
    unknown.
    """

    value: float
    low: float
    high: float
    by: str

    @classmethod
    def of(cls, found: Comparison, claim: Claim, *, chaotic: bool = False) -> Shortfall:
        """Compare the measurements of a variant with a claim; an interval's end is the largest of the parts' ends."""
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
    """Return a shortfall and the ends of its interval, infinite where unknown."""
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
    """Return the variants that no other beats in both cost and shortfall for some claim, the cheapest first.

    `costs` are the relevant ones for a claim, by the names of claim and variant.
    """
    best = dict[str, float]()
    for claim in claims:
        cost = [costs[claim.name][one.name] for one in variants]
        short = [Shortfall.of(one.comparison, claim, chaotic=chaotic).value for one in variants]
        best |= {variants[k].name: variants[k].seconds for k in pareto_front(cost, short)}
    return sorted(best, key=lambda name: best[name])


def nearness(found: Comparison, claims: Iterable[Claim] = CLAIMS, *, chaotic: bool = False) -> float:
    """Return by how many times a variant misses the limit of the nearest claim, up or down, as a logarithm."""
    values = (Shortfall.of(found, claim, chaotic=chaotic).value for claim in claims)
    return min(abs(math.log(max(value, 1e-12))) for value in values)


def surely_beaten(
    found: MeasuredVariant,
    others: Iterable[MeasuredVariant],
    claims: Sequence[Claim] = CLAIMS,
    *,
    chaotic: bool = False,
) -> bool:
    """Return whether for every claim a faster variant has a smaller shortfall, beyond both intervals."""

    def shortfall(one: MeasuredVariant, claim: Claim) -> Shortfall:
        return Shortfall.of(one.comparison, claim, chaotic=chaotic)

    quicker = [one for one in others if one.seconds < found.seconds]
    return all(any(shortfall(one, claim).high < shortfall(found, claim).low for one in quicker) for claim in claims)


@dataclass(frozen=True)
class Choice:
    """The variant that a fidelity's name should mean: the cheapest that keeps the claim, or the nearest.

    `today_seconds` is the cost of the variant that has the name now [s per episode with gradient], and
    `today_shortfall` its shortfall, None where not finite. `variant`, `seconds` and `shortfall` are those of the chosen
    one, None where no variant within the cost limit succeeds at every point. `lacking` names its worst quantity. There
    were `candidates` to choose from.
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
        """Whether the chosen variant keeps the claim; otherwise it is the nearest."""
        return self.shortfall is not None and self.shortfall <= 1


def choose(
    variants: Sequence[MeasuredVariant],
    claim: Claim,
    cost: Mapping[str, float],
    *,
    max_cost: float,
    chaotic: bool = False,
) -> Choice:
    """Choose the variant for a claim's name, among those within `max_cost` times the present cost.

    It is the cheapest that keeps the claim. If none does, it is the one with the smallest shortfall, the cheaper of two
    that are equal in two digits. `cost` is by name; the variant with the claim's own name is among the variants.
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
