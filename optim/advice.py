"""Advise a method to begin a search with, from cases: measured landscapes in which methods have raced.

A case is a function or a scene. Few evaluations measured its landscape, and the ranks of nine methods at equal cost are
known. In a new landscape, the expected rank of each method is its mean rank over the nearest cases. Leaving out whole
families of cases (`hold_out`) measures whether that helps. If, in our scenes, it beats one method everywhere beyond
chance, the nearest cases decide the advice; otherwise that one method does.

`python -m benchmarks.advice rows` makes the cases, and `python -m benchmarks.advice score` computes the score.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..landscapes.convert import from_json
from ..landscapes.measures.character import Character
from ..landscapes.statistics import Estimate, middle_95
from ..landscapes.storage.records import read_json

EVALUATIONS = 50  # at which the landscapes of cases were measured
NEAREST = 10  # cases that say what to expect
RESAMPLES = 2000  # of families
FARTHEST = 3.0  # deviations that a measure counts as at most
FILE = "advice.json"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """A landscape measured at several samples, and the mean `ranks` of methods at equal cost, 1 for best.

    `late` has the rank of each method if it alone had nine tenths of that cost, because a tenth was spent on measuring.
    `scene`: whether it is one of our simulated scenes.
    """

    name: str
    family: str
    scene: bool
    characters: tuple[Character, ...]
    ranks: Mapping[str, float]
    late: Mapping[str, float]

    @cached_property
    def measures(self) -> Array:
        """The means of its measures over the samples, NaN where no sample has one."""
        table = np.array([measures_of(one) for one in self.characters])
        known = np.isfinite(table)
        means = np.where(known, table, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        return np.where(known.any(axis=0), means, np.nan)

    @property
    def best(self) -> tuple[str, ...]:
        """The methods with the best mean rank."""
        least = min(self.ranks.values())
        return tuple(method for method, rank in self.ranks.items() if rank == least)


@dataclass(frozen=True)
class Cases:
    """All cases, raced at a cost of `forwards` [forward equivalents], where a gradient costs `gradient_cost`."""

    forwards: float
    gradient_cost: float
    cases: tuple[Case, ...]


@dataclass(frozen=True)
class Near:
    """A case near a landscape: its distance, in deviations of the measures, and the advised method's rank in it."""

    name: str
    family: str
    distance: float
    best: tuple[str, ...]
    rank: float


@dataclass(frozen=True)
class Score:
    """Quality of advice for cases of left-out families: mean ranks, with 95 % intervals over families.

    `advised` is the rank of the methods advised by the nearest cases. `single` is that of one `method` everywhere, the
    best of these cases in hindsight; `best` is that of the best method of each case in hindsight. `difference` is
    `advised` minus `single`. `late` is `advised` if measuring has cost a tenth, NaN where that is unknown.
    """

    cases: int
    families: int
    method: str
    advised: Estimate
    late: Estimate
    single: Estimate
    best: Estimate
    difference: Estimate

    @property
    def said(self) -> str:
        """Describe the mean ranks in words."""
        apart = self.difference
        return (
            f"advice by the nearest cases has mean rank {self.advised.value:.1f}, and {self.method} everywhere has "
            f"{self.single.value:.1f} (difference {apart.value:+.2f}, 95 %: {apart.low:+.2f} to {apart.high:+.2f})"
        )

    @property
    def helps(self) -> bool:
        """Whether advice beats one method everywhere, beyond chance."""
        return self.difference.high < 0


@dataclass(frozen=True)
class Scores:
    """Quality of advice in our scenes, which decides whether it is given, and in functions."""

    scenes: Score
    functions: Score


@dataclass(frozen=True)
class Choice:
    """The method to begin with, the reason, and the expected mean ranks of methods from the nearest cases, best first.

    `by_cases`: the nearest cases chose it, rather than the best single method of our scenes. `scores` are the quality
    of advice by the nearest cases.
    """

    method: str
    by_cases: bool
    reason: str
    expected: Mapping[str, float]
    nearest: tuple[Near, ...]
    scores: Scores


@cache
def read_cases() -> Cases:
    """Return the cases of the package."""
    return from_json(Cases, read_json(Path(str(resources.files("gradscape.optim"))) / FILE))


def measures_of(one: Character) -> Array:
    """Return the measures by which landscapes are compared, NaN where unknown."""
    found = [np.log10(one.parameters), one.failed, one.flat, *one.falls, *one.agreement, one.across, one.convex]
    found += [one.coherence, one.steepest, np.log10(1e-6 + one.noise), max(one.linear, 0.0), max(one.quadratic, 0.0)]
    found += [one.dispersion, one.information, one.distance, one.skewness]
    return np.array(found)


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """Cases to compare with, their measures in deviations from their means; an unknown measure counts as the mean."""

    cases: Sequence[Case]
    mean: Array
    deviation: Array

    @classmethod
    def of(cls, cases: Sequence[Case]) -> Neighbourhood:
        """Return the neighbourhood of some cases."""
        table = np.array([one.measures for one in cases])
        known = np.isfinite(table)
        count = np.maximum(known.sum(axis=0), 1)
        mean = np.where(known, table, 0.0).sum(axis=0) / count
        spread = np.sqrt(np.where(known, np.square(table - mean), 0.0).sum(axis=0) / count)
        return cls(cases, mean, np.where(spread > 0, spread, 1.0))

    def nearest(self, character: Character) -> list[tuple[float, Case]]:
        """Return the nearest cases with their distances, the nearest first."""
        here = self._standardised(measures_of(character)[None])[0]
        there = self._standardised(np.array([one.measures for one in self.cases]))
        distances = np.sqrt(np.square(there - here).mean(axis=1))
        order = np.argsort(distances, kind="stable")[:NEAREST]
        return [(float(distances[row]), self.cases[row]) for row in order]

    def _standardised(self, table: Array) -> Array:
        found: Array = np.where(np.isfinite(table), (table - self.mean) / self.deviation, 0.0).clip(-FARTHEST, FARTHEST)
        return found


def expected_ranks(near: Sequence[Case], methods: Sequence[str]) -> dict[str, float]:
    """Return the mean rank of each method over some cases, the best first."""
    found = {method: float(np.mean([one.ranks[method] for one in near])) for method in methods}
    return dict(sorted(found.items(), key=lambda one: one[1]))


def methods_of(cases: Sequence[Case]) -> tuple[str, ...]:
    """Return the methods that raced in all cases."""
    return tuple(method for method in cases[0].ranks if all(method in one.ranks for one in cases))


@dataclass(frozen=True)
class HeldOut:
    """The advice of cases of other families in a case, from one of its samples."""

    case: Case
    method: str
    near: tuple[Case, ...]


def hold_out(cases: Sequence[Case]) -> list[HeldOut]:
    """Advise in each case, for each of its samples, by cases of other families only."""
    methods, found = methods_of(cases), list[HeldOut]()
    for family in dict.fromkeys(one.family for one in cases):
        known = Neighbourhood.of([one for one in cases if one.family != family])
        for case in (one for one in cases if one.family == family):
            for character in case.characters:
                near = tuple(one for _, one in known.nearest(character))
                found.append(HeldOut(case, next(iter(expected_ranks(near, methods))), near))
    return found


def score_held_out(found: Sequence[HeldOut], ranks: Callable[[Case], Mapping[str, float]] | None = None) -> Score:
    """Compare the advised methods with the best, by `ranks` of each case, by default its own.

    With other ranks there is no `late`; it is NaN.
    """
    known = {one.case.name: ranks(one.case) if ranks else one.case.ranks for one in found}
    rows, methods = [known[one.case.name] for one in found], methods_of([one.case for one in found])
    single = min(methods, key=lambda method: float(np.mean([row[method] for row in rows])))
    late = [math.nan if ranks else one.case.late[one.method] for one in found]
    columns = np.array(
        [
            [row[one.method], after, row[single], min(row[method] for method in methods)]
            for row, after, one in zip(rows, late, found, strict=True)
        ]
    )
    families, of_family = np.unique([one.case.family for one in found], return_inverse=True)
    sums = np.array([[*columns[of_family == k].sum(axis=0), (of_family == k).sum()] for k in range(len(families))])
    times = np.random.default_rng(0).multinomial(len(families), np.full(len(families), 1 / len(families)), RESAMPLES)
    drawn = times @ sums
    means, whole = drawn[:, :-1] / drawn[:, -1:], columns.mean(axis=0)
    advised, spent, alone, best = (middle_95(float(whole[k]), means[:, k]) for k in range(4))
    apart = middle_95(float(whole[0] - whole[2]), means[:, 0] - means[:, 2])
    return Score(len(known), len(families), single, advised, spent, alone, best, apart)


def raced_methods() -> tuple[str, ...]:
    """Return the methods that raced in the cases of the package."""
    return methods_of(read_cases().cases)


@cache
def published_scores() -> Scores:
    """Return the scores of the cases of the package."""
    found = hold_out(read_cases().cases)
    return Scores(*(score_held_out([one for one in found if one.case.scene == scene]) for scene in (True, False)))


def choose(character: Character, methods: Sequence[str] = ()) -> Choice:
    """Choose among `methods`, by default all that raced, the one to begin with in a landscape of this character.

    Raises ValueError where none of them raced.
    """
    cases, scores = read_cases().cases, published_scores()
    able = [one for one in methods_of(cases) if not methods or one in methods]
    if not able:
        raise ValueError(f"there is no evidence on {', '.join(methods)}; choose from {', '.join(methods_of(cases))}")
    near = Neighbourhood.of(cases).nearest(character)
    expected = expected_ranks([case for _, case in near], able)
    advised = next(iter(expected))
    single = next(iter(expected_ranks([one for one in cases if one.scene], able)))
    method = advised if scores.scenes.helps else single
    found = tuple(Near(one.name, one.family, far, one.best, one.ranks[method]) for far, one in near)
    return Choice(method, scores.scenes.helps, _reason(method, advised, found, scores), expected, found, scores)


def _reason(method: str, advised: str, near: Sequence[Near], scores: Scores) -> str:
    """Explain in a sentence why a method is advised, and how certain that is."""
    first = sum(method in one.best for one in near)
    known = [one.name for one in near if method in one.best]
    alike = f"it was best in {first} of the {len(near)} nearest cases"
    alike += f", as in {' and '.join(known[:2])}" if known else ""
    if scores.scenes.helps:
        return f"{alike}; in scenes of other kinds {scores.scenes.said}"
    other = "" if advised == method else f", which would advise {advised}"
    return (
        "advice by similar landscapes is not shown to beat one method everywhere: in scenes of other kinds "
        f"{scores.scenes.said}; in functions {scores.functions.said}. {alike[0].upper()}{alike[1:]}{other}"
    )
