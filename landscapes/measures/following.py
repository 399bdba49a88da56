"""How gradients follow a landscape at fixed scales: parts of the box, whatever the samples of a slice are.

At random points of the plane the gradient is held against central differences over each scale. Gradients of zero have
no direction and count apart, as do those that are missing; scales at which the loss has no slope above the noise do not
count at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ..statistics import Estimate

SCALES = (0.001, 0.01, 0.05)  # of the box
CHIEF = 0.01  # the scale whose grade is the word
FOLLOW, LOOSELY, NOT = "follow", "loosely", "not"
WORD_OF = {
    FOLLOW: "gradients follow",
    LOOSELY: "gradients follow loosely",
    NOT: "gradients do not follow",
}
OPPOSITE, ZERO, EXPLODING = "gradients opposite", "gradients zero", "gradients exploding"
BIASED, MISSING = "gradients biased", "gradients missing"
FOLLOWING_WORDS = (*WORD_OF.values(), OPPOSITE, ZERO, EXPLODING, BIASED, MISSING)
FOLLOWS, FOLLOWS_LOOSELY = 0.9, 0.5  # mean cosines from which on gradients follow, and follow loosely


@dataclass(frozen=True)
class ScaleCosine:
    """Hold how gradients follow differences over one `scale`, a part of the box.

    Of `of` points `points` show a slope above the noise and have a gradient that is not zero: over these are the mean
    `cosine` of the two, the three `quartiles` of it, and the share that is `uphill` (below zero).
    """

    derived: ClassVar = ("grade",)

    scale: float
    points: int
    of: int
    cosine: Estimate
    quartiles: tuple[float, float, float]
    uphill: Estimate

    @property
    def grade(self) -> str | None:
        """How gradients follow over this scale; None where the interval of the mean cosine straddles a threshold."""
        low, high = self.cosine.low, self.cosine.high
        if low >= FOLLOWS:
            return FOLLOW
        if low >= FOLLOWS_LOOSELY and high < FOLLOWS:
            return LOOSELY
        return NOT if high < FOLLOWS_LOOSELY else None


@dataclass(frozen=True)
class Following:
    """Hold how gradients follow the landscape at several `scales`, and where they are of no use.

    Shares are of `points`, NaN where they are not known: of those with a loss whose gradient is `missing`; of those
    with a gradient that is `zero`; of those that show a slope over 1 % of the box whose gradient is `stuck` at zero
    nevertheless; of those with a gradient that is `exploding`; of those whose gradients' mean is `biased`.
    """

    derived: ClassVar = ("words", "reasons", "sentence")

    scales: tuple[ScaleCosine, ...]
    points: int
    zero: Estimate
    stuck: Estimate
    missing: Estimate
    exploding: Estimate
    biased: Estimate

    @property
    def words(self) -> tuple[str, ...]:
        """The words for the gradients, in the order of `FOLLOWING_WORDS`."""
        return tuple(word for word in FOLLOWING_WORDS if word in self.reasons)

    @property
    def reasons(self) -> dict[str, str]:
        """Each word with the measure that it comes from."""
        raise NotImplementedError

    @property
    def sentence(self) -> str:
        """Say in a line how gradients follow at each scale."""
        raise NotImplementedError
