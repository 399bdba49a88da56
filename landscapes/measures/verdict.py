"""A landscape in words, at fixed scales: its surface, its jumps, and whether its gradients help.

Each word comes from one measure, does not depend on the number of samples, and is left out where that measure does not
resolve it. The rules were fixed on half of the functions of `benchmarks/words.py`, and on nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import xarray as xr
from jaxtyping import Float
from torch import Tensor

from ..identity import plane_of
from ..objective import Evaluation, Objective, ObjectiveWrapper, evaluate, in_box
from .discontinuities import Count, Jumps, find_jumps
from .floor import Floor
from .following import FOLLOWING_WORDS, Following, follow_samples, measure_following
from .noise import noise_floor
from .ruggedness import span
from .slice_floor import counted_from, floor_of
from .surface import EXTREME, PLACES, RUGGED, SMOOTH, VERY_SMOOTH, Surface, look_between, measure_surface

FAILS, FLAT, NOISY, LARGE_FLAT, DISCONTINUOUS = (
    "mostly failed",
    "flat",
    "noisy losses",
    "large flat regions",
    "discontinuous",
)
WORDS = (FAILS, FLAT, NOISY, VERY_SMOOTH, SMOOTH, RUGGED, EXTREME, LARGE_FLAT, DISCONTINUOUS, *FOLLOWING_WORDS)
MOSTLY = 0.5  # share of the samples from which a slice that failed is called nothing else
REPEATS = 1.96 * math.sqrt(2)  # standard deviations: 95 % of repeats are closer
NOISY_FROM = 0.01  # of the range
RANGE_POINTS = 32  # at which the range of the whole environment is measured
PAIRS = 48  # of samples that are looked into for jumps
POINTS, SMOOTHED = 100, 36  # where gradients are held against slopes, and against those of the smoothed loss


@dataclass(frozen=True)
class QuotedWord:
    """A word from another source for a landscape, and whether it was measured, None where undecided."""

    word: str
    measured: bool | None

    @property
    def answer(self) -> str:
        """Whether it was measured, in a word or two."""
        return "not resolved" if self.measured is None else "yes" if self.measured else "no"


@dataclass(frozen=True)
class Verdict:
    """The sources of a slice's words: its surface, jumps and gradients, and the limits of all of them.

    `jumps` and `following` are None where they were not searched. `deviation` [loss unit] is that of noise, None where
    not measured, `floor` that of numerics, None without replicas. `failed` of the `samples` failed.
    """

    derived: ClassVar = ("words", "reasons", "open", "lines")

    surface: Surface
    jumps: Jumps | None
    following: Following | None
    samples: int
    failed: int
    deviation: float | None = None
    floor: Floor | None = None

    @property
    def words(self) -> tuple[str, ...]:
        """The words, in the order of `WORDS`."""
        reasons = self.reasons
        return tuple(word for word in WORDS if word in reasons)

    @property
    def reasons(self) -> dict[str, str]:
        """Each word with its measure."""
        if self.failed > MOSTLY * self.samples:
            return {FAILS: f"no loss at {self.failed / self.samples:.0%} of the samples"}
        if self.surface.flat:
            return {FLAT: self._flat()}
        reasons = self._surface()
        if self.surface.large_flat:
            reasons[LARGE_FLAT] = f"{self.surface.level.value:.0%} of the box is level over 2 % of it"
        if self.jumps is not None and self.jumps.found:
            reasons.pop(VERY_SMOOTH, None)
            reasons[DISCONTINUOUS] = self.jumps.sentence
        if (noisy := self.noise) is not None and noisy >= NOISY_FROM:
            reasons[NOISY] = self._noise()
        return reasons | (self.following.reasons if self.following is not None else {})

    @property
    def open(self) -> tuple[str, ...]:
        """The unresolved measures, and why."""
        if self.failed > MOSTLY * self.samples or self.surface.flat:
            return ()
        said = []
        if self.surface.word is None:
            said.append(f"surface not resolved: {self.surface.unresolved or 'no losses'}")
        if self.surface.at_least:
            said.append("not resolved whether it is extremely rugged")
        if self.surface.large_flat is None:
            said.append("large flat regions not resolved")
        if self.jumps is None:
            said.append("jumps not searched")
        return tuple(said)

    @property
    def lines(self) -> tuple[str, ...]:
        """The limits of every word: undetected jumps, noise, failed samples, and the numerical floor."""
        numerics = self.floor.sentence() if self.floor is not None else "numerical floor not measured"
        always = self._noise(), _failed(self.failed, self.samples), numerics
        if self.jumps is None or self.jumps.found or self.surface.flat:
            return always
        return f"jumps: {self.jumps.sentence}", *always

    @property
    def noise(self) -> float | None:
        """The largest difference of 95 % of repeats, relative to the range; None where unknown."""
        if self.deviation is None or not self.surface.range > 0:
            return None
        return REPEATS * self.deviation / self.surface.range

    def compare_words(self, said: Sequence[str]) -> tuple[QuotedWord, ...]:
        """Return each word from another source, and whether it was measured."""
        fits, unknown = self.reasons, self.undecided
        return tuple(QuotedWord(word, True if word in fits else None if word in unknown else False) for word in said)

    @property
    def undecided(self) -> frozenset[str]:
        """The words that can neither be confirmed nor excluded: their measure is not resolved, or was not taken."""
        if self.failed > MOSTLY * self.samples or self.surface.flat:
            return frozenset()
        unknown = set(FOLLOWING_WORDS if self.following is None else self.following.undecided)
        if self.surface.word is None:
            unknown |= {VERY_SMOOTH, SMOOTH, RUGGED, EXTREME}
        if self.surface.at_least:
            unknown.add(EXTREME)
        if self.surface.large_flat is None:
            unknown.add(LARGE_FLAT)
        if self.jumps is None:
            unknown.add(DISCONTINUOUS)
        if self.deviation is None:
            unknown.add(NOISY)
        return frozenset(unknown)

    def _surface(self) -> dict[str, str]:
        found = self.surface
        if found.word is None:
            return {}
        return {found.word: f"{found.describe()}{'; at least' if found.at_least else ''}"}

    def _flat(self) -> str:
        if self.surface.range == 0:
            return "all losses are equal"
        if self.surface.range <= self.surface.floor:
            return (
                f"losses range over {self.surface.range:.2g}, noise, numerics or rounding over {self.surface.floor:.2g}"
            )
        return f"losses range over {self.surface.range:.2g}, less than 1 % of the environment's range"

    def _noise(self) -> str:
        if self.noise is None:
            return "noise not measured" if self.deviation is None else f"noise {self.deviation:.2g}"
        return f"95 % of repeats agree within {100 * self.noise:.2g} % of the range"


class CountedObjective(ObjectiveWrapper):
    """Evaluate an objective where it is defined, and count all points and the `cut` ones outside."""

    def __init__(self, objective: Objective) -> None:
        super().__init__(objective)
        self.beyond_box = True  # those are left out here
        self.asked = self.cut = 0

    def evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool = True) -> Evaluation:
        """Return losses, and gradients if requested."""
        self.asked += len(x)
        if not self.objective.beyond_box:
            self.cut += int((~in_box(self.space, x)).sum())
        return evaluate(self.objective, x, grad=grad)


def _failed(failed: int, samples: int) -> str:
    return f"no loss at {failed / samples:.1%} of the samples" if failed else "a loss at every sample"


def judge(
    objective: Objective,
    datasets: Sequence[xr.Dataset],
    *,
    deviation: float,
    floor: Floor | None = None,
    own_range: float | None = None,
    places: int = PLACES,
    pairs: int = PAIRS,
    points: int = POINTS,
    smoothed: int = SMOOTHED,
    seed: int = 0,
    events: Count | None = None,
) -> list[Verdict]:
    """Judge slices by new evaluations of their objective, those of all slices in one batch.

    `deviation` [loss unit] is that of the losses' noise, `floor` the numerical floor, `own_range` [loss unit] the range
    of the whole environment, if known. Losses between samples are evaluated at `places`, see `look_between`. At most
    `pairs` of each slice are examined for jumps, which `events` explain. Gradients are compared with slopes at
    `points`, and with those of the smoothed loss at `smoothed` of them.
    """
    floors = [least_difference(one, deviation, floor) for one in datasets]
    between = look_between(objective, datasets, floors, places=places, seed=seed)
    jumps = find_jumps(objective, datasets, least=floors, most=pairs, seed=seed, events=events)
    following = _follow(objective, datasets, deviation=deviation, points=points, smoothed=smoothed, seed=seed)
    found = []
    for dataset, least, one, steps, slopes in zip(datasets, floors, between, jumps, following, strict=True):
        surface = measure_surface(dataset, floor=least, own_range=own_range, between=one)
        found.append(_verdict(dataset, surface, steps, slopes, deviation, floor))
    return found


def _follow(
    objective: Objective, datasets: Sequence[xr.Dataset], *, deviation: float, points: int, smoothed: int, seed: int
) -> Sequence[Following | None]:
    """Measure how gradients follow on slices that have gradients, None for the others."""
    able = [one for one in datasets if "grad" in one]
    if not able:
        return [None] * len(datasets)
    ranges = [float(np.nan_to_num(span(one["loss"].to_numpy()))) for one in able]
    planes = [plane_of(one) for one in able]
    told = measure_following(
        objective, planes, ranges=ranges, deviation=deviation, points=points, smoothed=smoothed, seed=seed
    )
    found = iter(told)
    return [next(found) if "grad" in one else None for one in datasets]


def judge_samples(dataset: xr.Dataset, *, deviation: float | None = None) -> Verdict:
    """Judge a slice from its samples alone: jumps are not searched, gradients are compared where samples are close."""
    floor = floor_of(dataset)
    surface = measure_surface(dataset, floor=least_difference(dataset, deviation or 0.0, floor))
    following = follow_samples(dataset, deviation=float(np.nan_to_num(deviation or 0.0)), points=dataset["loss"].size)
    return _verdict(dataset, surface, None, following, deviation, floor)


def measure_range(objective: Objective, *, seed: int = 0) -> float:
    """Return the range of an objective's losses at random points of its box, 0 where all of them failed."""
    found = evaluate(objective, objective.space.uniform(RANGE_POINTS, seed=seed), grad=False).loss
    known = found[found.isfinite()]
    return float(known.max() - known.min()) if len(known) else 0.0


def least_difference(dataset: xr.Dataset, deviation: float, floor: Floor | None) -> float:
    """Return the smallest difference of losses above noise and numerics [loss unit]."""
    return max(noise_floor(float(np.nan_to_num(deviation)), dataset["loss"].size), counted_from(floor))


def _verdict(
    dataset: xr.Dataset,
    surface: Surface,
    jumps: Jumps | None,
    following: Following | None,
    deviation: float | None,
    floor: Floor | None,
) -> Verdict:
    loss = dataset["loss"].to_numpy()
    return Verdict(surface, jumps, following, loss.size, int((~np.isfinite(loss)).sum()), deviation, floor)
