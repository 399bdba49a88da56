"""A landscape in words: rules with stated thresholds, from measures to what one says of a landscape.

The thresholds were set on functions whose landscape is known, and on nothing else: the sphere, Rosenbrock's valley,
Himmelblau's function, Branin's, Rastrigin's, Ackley's and Levy's, white noise, a step, a plateau, and a bowl with fine
ripples, at 48 x 48 samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..statistics import Values
from .discontinuities import Jumps
from .ruggedness import Ruggedness

VERY_SMOOTH, SMOOTH, RUGGED, EXTREME = "very smooth", "smooth with local minima", "rugged", "extremely rugged"
LARGE_FLAT, DISCONTINUOUS = "large flat regions", "discontinuous"
GOOD, NOISY, OPPOSITE, ZERO = "gradients good", "gradients noisy", "gradients opposite", "gradients zero"
FAILS, MISSING, BELOW = "mostly failed", "gradients missing", "flat within noise and numerics"
WORDS = (
    FAILS,
    BELOW,
    VERY_SMOOTH,
    SMOOTH,
    RUGGED,
    EXTREME,
    LARGE_FLAT,
    DISCONTINUOUS,
    GOOD,
    NOISY,
    OPPOSITE,
    ZERO,
    MISSING,
)

FEW_TURNS = 0.1  # of the steps between samples: Himmelblau's function turns at 0.03, Levy's at 0.15 of them
MANY_TURNS = 0.5  # Rastrigin's function turns at 0.45 of them, white noise at 0.65
FEW_MINIMA = 10  # notable ones: Himmelblau's function has 4, Levy's 20
MUCH = 0.2  # share of the samples from which flat regions are large, and zero or missing gradients are worth a word
MOSTLY = 0.5  # share of the samples from which a slice that failed is called nothing else
AGREE = 0.9  # mean cosine with the slope over two samples: Ackley's gradients have 0.96, those of fine ripples 0.3
OFTEN = 1 / 3  # share of gradients that point uphill: fine ripples make it 0.3 to 0.4, random directions a half


@dataclass(frozen=True)
class QuotedWord:
    """Hold a word of somebody else's for a landscape, and whether it was measured too."""

    word: str
    measured: bool


@dataclass(frozen=True)
class Verdict:
    """Hold the words for a landscape, each with the measure it comes from."""

    derived: ClassVar = ("words",)

    reasons: dict[str, str]

    @property
    def words(self) -> tuple[str, ...]:
        """The words, in the order of `WORDS`."""
        return tuple(word for word in WORDS if word in self.reasons)

    def compare_words(self, said: Sequence[str]) -> tuple[QuotedWord, ...]:
        """Return each word of somebody else's, and whether it was measured."""
        return tuple(QuotedWord(word, word in self.reasons) for word in said)


def classify(found: Ruggedness, jumps: Jumps | None, cosine: Values) -> Verdict:
    """Put a landscape into words.

    `cosine` is that of its gradients with differences over two samples, NaN where neither shows a slope. A gradient
    of zero is no direction, so it counts for the word zero only. What jumps is not called very smooth, and gradients
    are not called good where many are missing. Where most samples failed, or the losses differ by no more than noise or
    numerics alone would make them, nothing else is said.
    """
    return judge(found, jumps, *likeness(cosine))


def likeness(cosine: Values) -> tuple[float, float]:
    """Return the mean of cosines that are of two directions, and the share that is below zero; NaN of none."""
    known = cosine[np.isfinite(cosine) & (cosine != 0)]
    return (float(known.mean()), float((known < 0).mean())) if len(known) else (math.nan, math.nan)


def judge(found: Ruggedness, jumps: Jumps | None, average: float, uphill: float) -> Verdict:
    """Put a landscape into words, of whose gradients the mean cosine and the share uphill are known."""
    if found.failed > MOSTLY * found.samples:
        return Verdict({FAILS: f"no loss at {found.failed / found.samples:.0%} of the samples"})
    if 0 < found.range <= found.floor:
        return Verdict(
            {BELOW: f"the losses range over {found.range:.2g}, noise or numerics alone over {found.floor:.2g}"}
        )
    reasons = dict([_surface(found)])
    if found.level.value >= MUCH:
        reasons[LARGE_FLAT] = f"{found.level.value:.0%} of the samples are level with their neighbours"
    if jumps is not None and jumps.found:
        share = jumps.share
        reasons.pop(VERY_SMOOTH, None)
        reasons[DISCONTINUOUS] = f"jumps found: {len(jumps.found)}, between {share.value:.1%} of neighbouring samples"
    return Verdict(reasons | _gradients(found, average, uphill))


def _surface(found: Ruggedness) -> tuple[str, str]:
    turns, count = found.turns.value, found.notable
    said = f"minima deeper than 1 % of the range: {count}; steps between samples that turn back: {turns:.0%}"
    if turns > MANY_TURNS:
        return EXTREME, said
    if turns > FEW_TURNS or count > FEW_MINIMA:
        return RUGGED, said
    return (SMOOTH if count > 1 else VERY_SMOOTH), said


def _gradients(found: Ruggedness, average: float, uphill: float) -> dict[str, str]:
    reasons = {}
    if found.flat is not None and found.flat.value >= MUCH:
        reasons[ZERO] = f"effectively zero at {found.flat.value:.0%} of the samples"
    lacking = 0.0 if found.missing is None else found.missing.value
    beside = f"gradient missing at {lacking:.1%} of the points that have a loss" if lacking else ""
    if lacking >= MUCH:
        reasons[MISSING] = beside
    if math.isnan(average):
        return reasons
    said = "; ".join(filter(None, (f"mean cosine {average:z.2f} with the slope over two samples", beside)))
    if average < AGREE:
        reasons[NOISY] = said
    elif lacking < MUCH:
        reasons[GOOD] = said
    if uphill >= OFTEN:
        reasons[OPPOSITE] = f"{uphill:.0%} of the gradients point up that slope"
    return reasons


def thresholds() -> dict[str, float]:
    """Return the thresholds by name, to be stated with results."""
    return {
        "few turns": FEW_TURNS,
        "many turns": MANY_TURNS,
        "few minima": FEW_MINIMA,
        "large share": MUCH,
        "good cosine": AGREE,
        "often uphill": OFTEN,
    }
