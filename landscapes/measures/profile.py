"""The profile of a slice: all its measures, and the words that follow from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
import xarray as xr

from ..capacity import Need
from ..convert import NOT_JSON
from ..identity import errors_of, plane_of
from ..objective import Objective
from ..statistics import Estimate, share
from . import gradient_quality as gradients
from .discontinuities import EVALUATIONS_PER_PAIR, Count, Jumps
from .floor import Floor
from .following import SCALES, WIDTH
from .lyapunov import GradientGrowth
from .noise import Noise, noise
from .ruggedness import Ruggedness, ruggedness
from .slice_floor import counted_from, find_floor, floor_of, split_effort
from .surface import EVALUATIONS_PER_PLACE, PLACES, WAY_POINTS, WAYS
from .undersampled import Undersampled, find_undersampled, probes
from .verdict import POINTS, RANGE_POINTS, CountedObjective, Verdict, judge, least_difference, measure_range

NOISE_POINTS, REPEATS, PAIRS = 16, 4, 12
SECONDS, BYTES = (1.0, 4e-5), (80_000_000, 300)  # that a slice takes, and each of its samples (2026-11, one core)
PAIRS_PER_POINT = 8  # pairs of samples that are looked into, for each point of a side of the subgrid


@dataclass(frozen=True)
class OutsideBounds:
    """Count the requested evaluations (`asked`), and those `cut` because they were outside the bounds."""

    asked: int
    cut: int


@dataclass(frozen=True)
class Profile:
    """The measures of a slice: of its losses, its noise, its jumps and its gradients at several scales.

    The `verdict` has the words and their sources: the surface, jumps, how gradients follow, and the numerical floor. No
    measure of losses counts anything below `losses.floor`, the larger one of the noise floor and the numerical floor.
    `noise` is None where it is unknown. `differences`, `differences_of_samples` and `smoothing` summarise `quality`,
    which is drawn; records from samples alone have only the second. `beyond_the_box` counts the probes that the
    objective does not allow. `undersampled` describes what the samples miss, None where that is unknown. `errors` has
    the number of them that raised and the first message. `growth` is that of gradients with the length of episodes,
    None where not measured.
    """

    losses: Ruggedness
    noise: Noise | None
    verdict: Verdict
    differences: tuple[gradients.ScaleRow, ...]
    differences_of_samples: tuple[gradients.ScaleRow, ...]
    smoothing: tuple[gradients.WidthRow, ...]
    beyond_the_box: OutsideBounds
    undersampled: Undersampled | None
    errors: str
    growth: GradientGrowth | None = None
    quality: gradients.GradientQuality | None = field(default=None, metadata=NOT_JSON, compare=False, repr=False)

    @property
    def words(self) -> tuple[str, ...]:
        """The words for the landscape, in the order of `verdict.WORDS`."""
        return self.verdict.words

    @property
    def jumps(self) -> Jumps | None:
        """The found jumps, None where they were not searched."""
        return self.verdict.jumps

    @property
    def floor(self) -> Floor | None:
        """The differences between replicas of the objective, None where it has none."""
        return self.verdict.floor

    @property
    def measures(self) -> dict[str, str]:
        """The main numbers by short names, with 95 % intervals, as a page shows them."""
        named = self._measures_of_losses() | self._measures_of_gradients()
        return {name: text for name, text in named.items() if text}

    def _measures_of_losses(self) -> dict[str, str]:
        losses, jumps, surface = self.losses, self.jumps, self.verdict.surface
        fewest, most = losses.minima_halved
        return {
            "Samples that failed": _shares(share(losses.failed, losses.samples)) if losses.failed else "",
            "Points that raised": self.errors,
            "Local minima above the noise": f"{losses.minima} ({fewest} to {most} at half the resolution)",
            "Local minima deeper than 1 % of the range": _count(surface.minima),
            "Turns along a side": _along_axes(surface.turns),
            "Exponent over short distances": _number(surface.holder),
            "Points between samples that the samples do not predict": _shares(surface.off),
            "Basin of the lowest sample": _percent(losses.lowest_basin),
            "Noise floor": f"{losses.floor:.2g}{self._describe_source()}",
            "Numerical floor, of the range": _shares(self.floor.share) if self.floor else "",
            "Cosine of gradients of replicas": _number(self.floor.cosine) if self.floor and self.floor.cosine else "",
            "Gradient effectively zero": _shares(losses.flat),
            "Level regions, of the box": _shares(surface.level),
            "Jumps": jumps.sentence if jumps else "not searched",
            "Jumps explained by an event": _shares(jumps.explained_by_events) if jumps else "",
            "Correlation length, of the box": ", ".join(map(_shares, losses.correlation_length)),
            "Hölder exponent": _along_axes(losses.holder),
            "Total variation, in ranges": _along_axes(losses.total_variation),
            "Information content": _number(losses.information),
            "Dispersion of the best 5 %": _number(losses.dispersion),
            "Fitness-distance correlation": _number(losses.fitness_distance),
            "Undersampled cells": self.undersampled.format_share() if self.undersampled else "",
        }

    def _measures_of_gradients(self) -> dict[str, str]:
        lacking, following, named = self.losses.missing, self.verdict.following, dict[str, str]()
        if lacking and lacking.value:
            named["Gradients missing at points with a loss"] = _shares(lacking)
        for one in following.scales if following else ():
            said = f"{one.width:.1%} of the box"
            named[f"Cosine of gradient and slope over {said}"] = _number(one.cosine)
            named[f"Gradients uphill over {said}"] = _shares(one.uphill)
        if cut := self.beyond_the_box.cut:
            named["Probes outside the bounds, left out"] = f"{cut} of {self.beyond_the_box.asked}"
        if self.growth:
            named["Growth of gradients with the length of episodes"] = self.growth.describe()
        for row in self.smoothing:
            named[f"First order biased, smoothed over {row.width:.0%} of the box"] = _shares(row.biased)
        return named

    def _describe_source(self) -> str:
        """Say whether the floor is the numerical one."""
        return ", the numerical floor" if self.floor and self.losses.floor == counted_from(self.floor) else ""


def effort(rank: int, points: int, shape: Sequence[int] = (), replicas: int = 0) -> tuple[int, int]:
    """Return the largest number of losses, and the number of gradients, that `measure_profile` evaluates.

    Without the `shape` of the slice, those between its samples and at its `replicas` are not counted.
    """
    places = points**2
    losses = NOISE_POINTS * (2 + 2 * REPEATS) + PAIRS_PER_POINT * points * EVALUATIONS_PER_PAIR + RANGE_POINTS
    losses += 2 * rank * (places * len(gradients.SCALES) + POINTS * len(SCALES))
    losses += PLACES * EVALUATIONS_PER_PLACE + WAYS * WAY_POINTS
    slopes = places * (1 + 2 * PAIRS * len(gradients.WIDTHS)) + POINTS
    if shape:
        losses += probes(math.prod(shape), grad=True)
        slopes += math.prod(split_effort(math.prod(shape), replicas)) if replicas else 0
    return losses, slopes


def need_of(rank: int, dim: int, points: int) -> Need:
    """Return the memory of the points and gradients of `measure_profile`, including some copies."""
    return Need(8.0 * (4 * rank + 6 * dim) * 2 * PAIRS * float(points) ** 2)


def own_cost(samples: int) -> tuple[float, int]:
    """Return the approximate seconds and bytes that `measure_profile` itself takes for a slice of this many samples."""
    return SECONDS[0] + SECONDS[1] * samples, BYTES[0] + BYTES[1] * samples


def measure_profile(
    objective: Objective,
    dataset: xr.Dataset,
    *,
    rounding: float,
    points: int = 6,
    seed: int = 0,
    events: Count | None = None,
) -> Profile:
    """Measure a slice, with new evaluations on a grid of points x points and at random points.

    `rounding` is the engine's relative precision: `LAST_PLACE` has that of float32 and of float64. `events` counts the
    events of episodes, which explain jumps. The numerical floor is the slice's own, or else measured now. Where
    neighbours or their gradients are compared, only noise counts, because their numerics are the same.
    """
    plane, objective = plane_of(dataset), CountedObjective(objective)
    generator = torch.Generator().manual_seed(seed)
    places = gradients.subgrid(plane, points if plane.rank == 2 else points**2)
    shares = torch.rand(NOISE_POINTS, plane.rank, generator=generator, dtype=torch.float64)
    drawn = plane.lower + (plane.upper - plane.lower) * shares
    fuzz = noise(objective, plane.lift(drawn), rounding=rounding, repeats=REPEATS, seed=seed)
    numerics = floor_of(dataset) or find_floor(objective, dataset, seed=seed)
    deviation = float(np.nan_to_num(fuzz.deviation))
    steps = gradients.compare_differences(objective, plane, places, deviation=deviation)
    smooth = gradients.smoothed_slopes(objective, plane, places, pairs=PAIRS, seed=seed)
    whole, pairs = measure_range(objective, seed=seed), PAIRS_PER_POINT * points
    (verdict,) = judge(
        objective, [dataset], deviation=deviation, floor=numerics, own_range=whole,
        pairs=pairs, smoothed=0, seed=seed, events=events,  # they are smoothed here, over several widths
    )  # fmt: skip
    near, widths = gradients.compare_samples(dataset, deviation=deviation), gradients.width_table(smooth)
    floor, repeats = (least_difference(dataset, deviation, one) for one in (numerics, None))
    between = Undersampled.of(dataset) or find_undersampled(objective, dataset, floor=floor, seed=seed)
    return Profile(
        losses=ruggedness(dataset, floor=floor, noise=repeats),
        noise=fuzz,
        verdict=_with_bias(verdict, widths),
        differences=gradients.scale_table(steps),
        differences_of_samples=gradients.scale_table(near),
        smoothing=widths,
        beyond_the_box=OutsideBounds(objective.asked, objective.cut),
        undersampled=between,
        errors=errors_of(dataset),
        quality=gradients.GradientQuality(steps, near, smooth),
    )


def _with_bias(verdict: Verdict, widths: Sequence[gradients.WidthRow]) -> Verdict:
    """Return the verdict completed by where the mean of gradients is biased, at the width of its words."""
    biased = next((row.biased for row in widths if row.width == WIDTH), None)
    if verdict.following is None or biased is None:
        return verdict
    return replace(verdict, following=replace(verdict.following, biased=biased))


def _shares(estimate: Estimate | None) -> str:
    return _with_interval(estimate, _percent)


def _along_axes(values: Sequence[Estimate]) -> str:
    """Write a number for each axis, a dash where it is unknown, nothing where all are."""
    said = list(map(_number, values))
    return ", ".join(one or "\N{EN DASH}" for one in said) if any(said) else ""


def _number(estimate: Estimate) -> str:
    return _with_interval(estimate, lambda value: f"{value:z.2f}".replace("-", "\N{MINUS SIGN}"))


def _with_interval(estimate: Estimate | None, write: Callable[[float], str]) -> str:
    if estimate is None or not math.isfinite(estimate.value):
        return ""
    said, low, high = write(estimate.value), estimate.low, estimate.high
    known = math.isfinite(low) and math.isfinite(high) and low != high
    return f"{said} ({write(low)} to {write(high)})" if known else said


def _count(estimate: Estimate) -> str:
    """Write a count, and those for a larger and a smaller depth."""
    if not math.isfinite(estimate.value):
        return ""
    ends = f" ({estimate.low:.0f} to {estimate.high:.0f})" if estimate.low != estimate.high else ""
    return f"{estimate.value:.0f}{ends}"


def _percent(part: float) -> str:
    return f"{100 * part:.1f} %" if math.isfinite(part) else ""
