"""The page that holds what the paper shows and claims against what is kept here: nothing on it is written by hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gradscape.gallery.site.league import VERDICTS
from gradscape.optim.claims import Claim

from .kept import NOT_MEASURED, Kept, KeptFigure
from .pictures import draw_slice, shown
from .text import cell, page, prose, table

CONFIRMED, REFUTED, DIFFERENT = "confirmed", "refuted", "different"
SAYS_NOTHING = "the paper says nothing of it"
MEANING = {
    CONFIRMED: "all that the paper says of it was measured here too; of a claim about two methods: the rank test of "
    "Mann and Whitney, corrected by Holm's rule for all pairs of the race, has p below 0.05",
    REFUTED: "none of the paper's words was measured; of a claim: that test says the opposite",
    DIFFERENT: "some of the paper's words were measured and some were not",
    "not decided": "the races that are kept do not say which of two methods is ahead",
    "not run": "one of the two methods was not raced in this scene",
    NOT_MEASURED: "there are no data of it in this version",
}


@dataclass(frozen=True)
class FoundClaim:
    """What the paper claims of two methods in a scene, and what the league makes of it."""

    env: str
    claim: Claim
    verdict: str
    why: str


def pages(kept: Kept, pictures: Path) -> dict[str, str]:
    """Return the page; small pictures are drawn beside."""
    claims = list(judge_claims(kept))
    text = page(
        "Reproduce the paper",
        'What "Rethinking Optimization with Differentiable Simulation from a Global Perspective" (CoRL 2022, '
        "[arXiv:2207.00167](https://arxiv.org/abs/2207.00167)) shows and claims, and what was measured here. Its code "
        "was never released: scenes, engines and numbers are ours. The page is written by a program from "
        "`gallery/figures.toml`, `gallery/paper.toml`, the reports of the figures and the races of the league.",
        table(("verdict", "what it means"), [(f"**{word}**", prose(said)) for word, said in MEANING.items()]),
        f"Of its slices and ours {_count(verdict_of(one) for one in kept.figures)}; {_earlier(kept)}. "
        f"Of its claims about methods {_count(one.verdict for one in claims)}.",
        *_figures(kept, pictures),
        "## Its claims about methods",
        _claims(claims),
        *[f"{env}: {prose(why)}" for env, why in kept.paper.silences.items()],
        "## How to make it again",
        "`landscape gallery compute --device cuda` samples what is missing of the figures, `--part league` races the "
        "methods; both say first what they cost, and [the gallery](../gallery.md) says what they leave. "
        "`landscape gallery build` then makes the pictures, and this page reads what there is.",
    )
    return {"reproduction.md": text}


def verdict_of(one: KeptFigure) -> str:
    """Return what the measured words of a slice make of the paper's."""
    if one.report is None:
        return NOT_MEASURED
    words = one.report.paper.words if one.report.paper else ()
    hits = [word.measured for word in words]
    if not hits:
        return SAYS_NOTHING
    return CONFIRMED if all(hits) else DIFFERENT if any(hits) else REFUTED


def judge_claims(kept: Kept) -> Iterator[FoundClaim]:
    """Yield every claim of the paper in every scene, and what the kept league makes of it."""
    raced = {scene.env: scene for scene in kept.league.scenes} if kept.league else {}
    for env, claims in kept.paper.claims.items():
        if env not in raced:
            yield from (FoundClaim(env, claim, NOT_MEASURED, "") for claim in claims)
            continue
        for found in raced[env].findings(kept.paper.claims_about(env)):
            chance = found.superiority
            won = f"the first wins {chance.probability:.0%}, corrected p {chance.corrected:.2g}" if chance else ""
            yield FoundClaim(env, found.claim, VERDICTS[found.verdict], won)


def _count(verdicts: Iterable[str]) -> str:
    found = Counter(verdicts)
    order = [*MEANING, SAYS_NOTHING]
    return ", ".join(f"{found[word]} {word}" for word in order if found[word]) or "there are none"


def _earlier(kept: Kept) -> str:
    """Say how many slices were sampled before their scene became what it is."""
    count = sum(one.slice is not None and not one.current for one in kept.figures)
    return (
        f"{count} of them were sampled by an earlier version of their scene" if count else "all by the scene as it is"
    )


def _figures(kept: Kept, pictures: Path) -> Iterator[str]:
    """Yield a section for each figure of the supplement, then one for the slices that it does not have."""
    numbers: dict[int | None, list[KeptFigure]] = {}
    for one in kept.figures:
        numbers.setdefault(one.figure.caption.number, []).append(one)
    for number in sorted(numbers, key=lambda value: (value is None, value or 0)):
        yield f"## Figure {number}" if number else "## Slices of scenes that its supplement does not show"
        for one in numbers[number]:
            yield from _slice(one, kept, pictures)


def _slice(one: KeptFigure, kept: Kept, pictures: Path) -> Iterator[str]:
    yield f"### {one.figure.id}"
    if one.slice is not None:
        alt = f"Losses of {one.figure.env} over {' and '.join(one.slice.plane.labels)}"
        yield shown(draw_slice(one, pictures, small=True), alt, "")
    yield table(("", ""), [(f"**{name}**", said) for name, said in _rows(one, kept).items() if said])


def _rows(one: KeptFigure, kept: Kept) -> Mapping[str, str]:
    """Return what stands beside each other, by what it is."""
    words, report = kept.paper.words.get(one.figure.env), one.report
    reasons = report.profile.verdict.reasons if report else {}
    said = report.paper.words if report and report.paper else ()
    missing = [one.word for one in said if not one.measured]
    earlier = "" if one.current or one.slice is None else ", by samples of an earlier version of the scene"
    return {
        "the paper shows": cell(one.figure.caption.says),
        "its words": cell(f"{', '.join(words.words)} ({words.where})") if words else "",
        "ends of its colour bars": _span(words.losses) if words and words.losses else "",
        "measured": ", ".join(report.words) if report else NOT_MEASURED,
        "losses here": _span(one.losses) if one.losses else "",
        "verdict": f"**{verdict_of(one)}**{earlier}",
        "not measured of its words": ", ".join(missing),
        "why": "; ".join(f"{word}: {cell(why)}" for word, why in reasons.items()),
        "scene": f"[{one.figure.env}](scenes/{one.figure.env}.md), {kept.link(one.figure, '../')}",
        "command": f"`{one.figure.command('auto')}`",
    }


def _span(losses: tuple[float, float]) -> str:
    return f"{losses[0]:.3g} to {losses[1]:.3g}"


def _claims(claims: Sequence[FoundClaim]) -> str:
    rows = [(f"[{one.env}](scenes/{one.env}.md)", cell(str(one.claim)), cell(one.claim.source), f"**{one.verdict}**",
             cell(one.why)) for one in claims]  # fmt: skip
    return table(("scene", "claim", "where the paper says so", "here", "how"), rows)
