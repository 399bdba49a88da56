"""The page that compares the paper's figures and claims with our data; all of it is generated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from gradscape.envs.base import describe_settings
from gradscape.envs.registry import environment_class
from gradscape.gallery.site.league import VERDICTS
from gradscape.optim.claims import Claim

from .kept import NOT_MEASURED, Kept, KeptFigure
from .pictures import draw_slice
from .text import cell, render

CONFIRMED, REFUTED, DIFFERENT, UNSEEN = "confirmed", "refuted", "different", "not seen here"
SAYS_NOTHING = "not described in the paper"
MEANING = {
    CONFIRMED: "all of the paper's words were measured here too. For a claim about two methods: the rank test of Mann "
    "and Whitney has p below 0.05, after Holm's correction for all pairs of the race",
    REFUTED: "none of the paper's words was measured, neither with the paper's settings (preset paper) nor with any "
    "other known setting. For a claim: that test says the opposite",
    UNSEEN: "none of the paper's words was measured, but another setting shows some of them, or the slice has other "
    "settings than the paper. Known reasons are given",
    DIFFERENT: "some of the paper's words were measured and some were not",
    "not decided": "the stored races do not decide which of the two methods is ahead",
    "not run": "one of the two methods was not raced in this scene",
    NOT_MEASURED: "this version has no data for it",
}


@dataclass(frozen=True)
class FoundClaim:
    """A claim of the paper about two methods in a scene, with the league's verdict."""

    env: str
    claim: Claim
    verdict: str
    why: str


def pages(kept: Kept, pictures: Path) -> dict[str, str]:
    """Return the page, and draw its small pictures into a folder."""
    claims = list(judge_claims(kept))
    numbers: dict[int | None, list[KeptFigure]] = {}  # of the supplement's figures; ours, which have none, are last
    for one in sorted(kept.figures, key=lambda one: one.figure.caption.number or float("inf")):
        numbers.setdefault(one.figure.caption.number, []).append(one)
    text = render(
        "reproduction.md", kept=kept, meaning=MEANING, numbers=numbers, claims=claims, verdict_of=verdict_of, cell=cell,
        draw=partial(draw_slice, folder=pictures), missing=missing_words,
        preset_of=lambda env: describe_settings(environment_class(env).preset_options("paper")),
        of_slices=_count(map(verdict_of, kept.figures)), of_claims=_count(one.verdict for one in claims),
        earlier=sum(one.slice is not None and not one.current for one in kept.figures),
    )  # fmt: skip
    return {"reproduction.md": text}


def verdict_of(one: KeptFigure) -> str:
    """Return the verdict on the paper's words for a slice."""
    if one.report is None:
        return NOT_MEASURED
    words, missing = one.paper_words, missing_words(one)
    if not words:
        return SAYS_NOTHING
    if len(missing) < len(words):
        return DIFFERENT if missing else CONFIRMED
    elsewhere = any(found.setting and found.holds and set(found.words) & set(missing) for found in one.findings)
    return REFUTED if one.as_the_paper and not elsewhere else UNSEEN


def missing_words(one: KeptFigure) -> tuple[str, ...]:
    """Return the paper's words for a slice that were not measured."""
    return tuple(word for word in one.paper_words if one.report is not None and word not in one.report.words)


def judge_claims(kept: Kept) -> Iterator[FoundClaim]:
    """Yield every claim of the paper about every scene, with the verdict of the stored league."""
    raced = {scene.env: scene for scene in kept.league.scenes} if kept.league else {}
    for env, claims in kept.paper.claims.items():
        if env not in raced:
            yield from (FoundClaim(env, claim, NOT_MEASURED, "") for claim in claims)
            continue
        for found in raced[env].findings(kept.paper.claims_about(env)):
            chance = found.superiority
            won = f"first method wins {chance.probability:.0%}, corrected p {chance.corrected:.2g}" if chance else ""
            yield FoundClaim(env, found.claim, VERDICTS[found.verdict], won)


def _count(verdicts: Iterable[str]) -> str:
    found = Counter(verdicts)
    return ", ".join(f"{found[word]} {word}" for word in [*MEANING, SAYS_NOTHING] if found[word]) or "there are none"
