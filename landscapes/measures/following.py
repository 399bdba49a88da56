"""How gradients follow a landscape at fixed scales: parts of the box, independent of a slice's samples.

At random points of the plane, the gradient is compared with central differences over each scale. A point does not count
at a scale where the loss has no slope above the noise. Zero gradients have no direction and are counted separately, as
are missing, exploding and biased ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from torch import Tensor

from ..objective import Objective, Status, evaluate
from ..plane import Plane
from ..statistics import UNKNOWN, Estimate, Values, mean, share
from .gradient_quality import agreement, central_differences, differences_of_samples, smoothed_slopes, width_table
from .ruggedness import box_slopes, losses_of, span

SCALES = (0.001, 0.01, 0.05)  # of the box
CHIEF = 0.01  # the scale whose grade is the word, and over which other faults of gradients show
FOLLOW, LOOSELY, NOT = "follow", "loosely", "not"
WORD_OF = {FOLLOW: "gradients follow", LOOSELY: "gradients follow loosely", NOT: "gradients do not follow"}
OPPOSITE, ZERO, EXPLODING = "gradients opposite", "gradients zero", "gradients exploding"
BIASED, MISSING = "gradients biased", "gradients missing"
FOLLOWING_WORDS = (*WORD_OF.values(), OPPOSITE, ZERO, EXPLODING, BIASED, MISSING)

FOLLOWS, FOLLOWS_LOOSELY = 0.9, 0.5  # mean cosines from which on gradients follow, and follow loosely
FEWEST = 5  # points that show a slope, without which there is no grade
MOSTLY = 0.5  # share uphill beyond which gradients are opposite: random directions are uphill as often as downhill
NOTABLE = 0.1  # share of gradients that are zero, biased or missing beyond which it is worth a word
RARE = 0.01  # share of gradients that explode beyond which it is: one of them undoes many steps
SHOWN = 4  # deviations of a difference by noise alone, beyond which it is a slope: it is one by chance at 1 in 3000
VANISHING = 1e-9  # ranges per side of the box, up to which a gradient is zero
EXPLODES = 100  # times the slope over 1 % of the box, and ranges per side of the box, beyond which a gradient explodes
WIDTH = 0.01  # of the box: the standard deviation of the Gaussian under which means of gradients are held to slopes
NEAR = 2  # times a scale, or its part, that differences of samples may be over instead


@dataclass(frozen=True)
class ScaleCosine:
    """How gradients follow differences over one `scale`, a part of the box.

    `width` is the actual part of the differences, which depends on the samples of a stored slice. `of` points have a
    gradient and a slope above the noise; at `points` of these the gradient is not zero. Over these are the mean
    `cosine` of the two, its three `quartiles`, and the share that is `uphill` (cosine below zero).
    """

    derived: ClassVar = ("grade",)

    scale: float
    width: float
    points: int
    of: int
    cosine: Estimate
    quartiles: tuple[float, float, float]
    uphill: Estimate

    @property
    def grade(self) -> str | None:
        """How gradients follow over this scale; None where the interval of the mean cosine straddles a threshold."""
        low, high = self.cosine.low, self.cosine.high
        if self.points < FEWEST:
            return None
        if low >= FOLLOWS:
            return FOLLOW
        if low >= FOLLOWS_LOOSELY and high < FOLLOWS:
            return LOOSELY
        return NOT if high < FOLLOWS_LOOSELY else None

    def describe(self) -> str:
        """Describe the mean cosine and its grade."""
        if not self.points:
            return "all gradients zero" if self.of else "no slope above the noise"
        value, low, high = (f"{one:z.2f}" for one in (self.cosine.value, self.cosine.low, self.cosine.high))
        interval = f" ({low} to {high})" if low != high and math.isfinite(self.cosine.low) else ""
        return f"{value}{interval}, {self.grade or 'not resolved'}".replace("-", "\N{MINUS SIGN}")


@dataclass(frozen=True)
class Following:
    """How gradients follow the landscape at several `scales`, and where they are useless.

    Shares are of `points`, NaN where unknown. Of those with a loss, the gradient is `missing`; of those with a
    gradient, it is `zero`, or `exploding`; of some that are examined further, its mean over a Gaussian is `biased`.
    """

    derived: ClassVar = ("stuck", "words", "reasons", "sentence")

    scales: tuple[ScaleCosine, ...]
    points: int
    missing: Estimate
    zero: Estimate
    exploding: Estimate
    biased: Estimate

    def at(self, scale: float) -> ScaleCosine | None:
        """Return the result at one of `SCALES`, None where the samples do not allow it."""
        return next((one for one in self.scales if one.scale == scale), None)

    @property
    def stuck(self) -> Estimate:
        """Share of gradients that are zero among the points that have a slope over 1 % of the box."""
        chief = self.at(CHIEF)
        return UNKNOWN if chief is None else share(chief.of - chief.points, chief.of)

    @property
    def words(self) -> tuple[str, ...]:
        """The words for the gradients, in the order of `FOLLOWING_WORDS`."""
        reasons = self.reasons
        return tuple(word for word in FOLLOWING_WORDS if word in reasons)

    @property
    def reasons(self) -> dict[str, str]:
        """Each word with its measure.

        A share gives a word only if its whole interval supports it. Gradients that are missing or zero do not follow.
        Bias is not mentioned for gradients that are zero, opposite or exploding.
        """
        reasons, chief = dict[str, str](), self.at(CHIEF)
        if self.missing.low > NOTABLE:
            reasons[MISSING] = f"no gradient at {_share(self.missing)} of the points with a loss"
        if self.zero.low > NOTABLE:
            beside = f", and at {_share(self.stuck)} of those with a slope over 1 %" if self.stuck.value > 0 else ""
            reasons[ZERO] = f"zero at {_share(self.zero)} of the points{beside}"
        if self.exploding.low > RARE:
            reasons[EXPLODING] = f"over {EXPLODES} times the slope over 1 % of the box at {_share(self.exploding)}"
        if chief is not None and chief.uphill.low > MOSTLY:
            reasons[OPPOSITE] = f"{_share(chief.uphill)} of the gradients point up the slope over 1 % of the box"
        if self.biased.low > NOTABLE and not reasons.keys() & {ZERO, EXPLODING, OPPOSITE}:
            reasons[BIASED] = f"their mean is not the slope of the mean loss at {_share(self.biased)} of the points"
        useless = self.missing.low > NOTABLE or self.stuck.low > NOTABLE
        if chief is not None and chief.grade and not (useless and chief.grade != NOT):
            others = any(one.grade not in (None, chief.grade) for one in self.scales)
            about = "mean cosine of gradient and slope over 1 % of the box"
            reasons[WORD_OF[chief.grade]] = self.sentence if others else f"{about}: {chief.describe()}"
        return reasons

    @property
    def undecided(self) -> frozenset[str]:
        """The words that can neither be confirmed nor excluded: their measure is unknown or not resolved."""
        shares = {MISSING: self.missing, ZERO: self.zero, EXPLODING: self.exploding, BIASED: self.biased}
        unknown = {word for word, one in shares.items() if math.isnan(one.value)}
        chief = self.at(CHIEF)
        if chief is None:
            unknown |= {*WORD_OF.values(), OPPOSITE}
        elif chief.grade is None:
            unknown |= {*WORD_OF.values()}
        return frozenset(unknown)

    @property
    def sentence(self) -> str:
        """Describe in a line how gradients follow at each scale."""
        said = [f"{100 * one.width:.2g} %: {one.describe()}" for one in self.scales]
        return "mean cosine of gradient and slope, by parts of the box: " + ("; ".join(said) or "not known")


def measure_following(
    objective: Objective,
    planes: Sequence[Plane],
    *,
    ranges: Sequence[float],
    deviation: float = 0.0,
    points: int = 100,
    smoothed: int = 36,
    pairs: int = 12,
    seed: int = 0,
) -> list[Following]:
    """Compare gradients with slopes at random points of planes of one rank, all planes in one batch.

    `ranges` are those of the losses on each plane, `deviation` is that of the losses' noise [loss unit]. At `smoothed`
    of the points, means of gradients are compared with the slope of the mean loss, with `pairs` of samples each; 0
    leaves that out. Points keep a distance from the border, so that no difference leaves the box.
    """
    generator = torch.Generator().manual_seed(seed)
    inner = 1 - max(SCALES)
    places = max(SCALES) / 2 + inner * torch.rand(points, planes[0].rank, generator=generator, dtype=torch.float64)
    u = torch.stack([plane.lower + places * (plane.upper - plane.lower) for plane in planes])
    lifted = torch.cat([plane.lift(part) for plane, part in zip(planes, u, strict=True)])
    exact = evaluate(objective, lifted, grad=True)
    assert exact.grad is not None  # as it was asked for
    differences = central_differences(objective, planes, u, SCALES)
    found = []
    for number, (plane, whole) in enumerate(zip(planes, ranges, strict=True)):
        rows = slice(number * points, (number + 1) * points)
        slope = (plane.slope(exact.grad[rows]) * (plane.upper - plane.lower)).numpy()
        over = [(scale, scale, one) for scale, one in zip(SCALES, differences[number], strict=True)]
        biased = _biased(objective, plane, u[number, :smoothed], pairs, seed) if smoothed else UNKNOWN
        found.append(_conclude(slope, exact.loss[rows].numpy(), over, whole, deviation, biased))
    return found


def follow_samples(
    dataset: xr.Dataset, *, deviation: float = 0.0, points: int = 100, seed: int = 0
) -> Following | None:
    """Compare gradients of a stored slice with differences of its own losses, at some samples, without evaluations.

    It returns only scales that the samples allow within a factor of two, and none for a slice without gradients.
    """
    if "grad" not in dataset:
        return None
    loss = losses_of(dataset)
    slope, status = box_slopes(dataset), dataset["status"].transpose("v", "u", missing_dims="ignore").to_numpy()
    asked = np.flatnonzero(np.isfinite(slope).all(axis=-1) | (status == Status.NO_GRADIENT))
    chosen = np.unravel_index(np.sort(np.random.default_rng(seed).permutation(asked)[:points]), loss.shape)
    over = []
    for scale in SCALES:
        strides = [max(1, round(scale * (size - 1) / 2)) for size in loss.shape]
        widths = [2 * stride / (size - 1) for stride, size in zip(strides, loss.shape, strict=True)]
        if all(scale / NEAR <= width <= scale * NEAR and width < 1 for width in widths):
            axes = [differences_of_samples(loss, axis, stride) for axis, stride in enumerate(strides)][::-1]  # u first
            over.append((scale, float(np.mean(widths)), np.stack(axes, axis=-1)[chosen]))
    return _conclude(slope[chosen], loss[chosen], over, span(loss), deviation, UNKNOWN)


def _conclude(
    slope: Float[Values, "point axis"],
    loss: Float[Values, " point"],
    over: Sequence[tuple[float, float, Values]],
    whole: float,
    deviation: float,
    biased: Estimate,
) -> Following:
    """Summarise slopes by gradients [loss unit per side] and differences `over` scales, each with its width."""
    size = np.linalg.norm(slope, axis=-1)
    having, zero = np.isfinite(size), size <= VANISHING * whole
    scales, exploding = list[ScaleCosine](), UNKNOWN
    for scale, width, difference in over:
        noise = math.sqrt(2) * deviation / width
        shown = having & (np.linalg.norm(difference, axis=-1) > SHOWN * noise)
        cosine = agreement(slope, difference, noise)["cosine"][shown & ~zero]
        quartiles = np.quantile(cosine, (0.25, 0.5, 0.75)) if len(cosine) else np.full(3, np.nan)
        average, uphill = mean(cosine, least=-1, most=1), share(int((cosine < 0).sum()), len(cosine))
        scales.append(
            ScaleCosine(scale, width, len(cosine), int(shown.sum()), average, tuple(quartiles.tolist()), uphill)
        )
        if scale == CHIEF:
            known = having & np.isfinite(difference).all(axis=-1)
            too_large = (size > EXPLODES * np.linalg.norm(difference, axis=-1)) & (size > EXPLODES * whole)
            exploding = share(int((known & too_large).sum()), int(known.sum()))
    there = np.isfinite(loss)
    return Following(
        scales=tuple(scales),
        points=len(loss),
        missing=share(int((there & ~having).sum()), int(there.sum())),
        zero=share(int((having & zero).sum()), int(having.sum())),
        exploding=exploding,
        biased=biased,
    )


def _biased(objective: Objective, plane: Plane, u: Float[Tensor, "point rank"], pairs: int, seed: int) -> Estimate:
    return width_table(smoothed_slopes(objective, plane, u, widths=(WIDTH,), pairs=pairs, seed=seed))[0].biased


def _share(estimate: Estimate) -> str:
    value, low, high = (100 * part for part in (estimate.value, estimate.low, estimate.high))
    return f"{value:.0f} % ({low:.0f} to {high:.0f})"
