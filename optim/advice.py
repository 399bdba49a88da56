"""Which method to begin a search with: learnt from cases, landscapes that were measured and in which methods raced.

A case is a function or a scene. Its landscape was measured by few evaluations, and the ranks of nine methods in it are
known at equal cost. Of a new landscape the expected rank of each method is its mean over the nearest cases. Whether
that helps is measured by leaving out whole families of cases (`hold_out`). Only if in our scenes it is better than one
method everywhere, beyond chance, is the method of the nearest cases advised, and else that one.

`python -m benchmarks.advice rows` makes the cases, and `python -m benchmarks.advice score` measures the score.
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
    """A landscape that was measured at several samples, and the mean `ranks` of methods at equal cost, 1 for best.

    `late` has the rank of each method if it alone had nine tenths of that cost, as it has after a tenth was measured.
    `scene` is whether it is one of our simulated scenes.
    """

    name: str
    family: str
    scene: bool
    characters: tuple[Character, ...]
    ranks: Mapping[str, float]
    late: Mapping[str, float]

    @cached_property
    def measures(self) -> Array:
        """The means of its measures over the samples, NaN where none tells."""
        table = np.array([measures_of(one) for one in self.characters])
        known = np.isfinite(table)
        means = np.where(known, table, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        return np.where(known.any(axis=0), means, np.nan)

    @property
    def best(self) -> tuple[str, ...]:
        """The methods of the best mean rank."""
        least = min(self.ranks.values())
        return tuple(method for method, rank in self.ranks.items() if rank == least)


@dataclass(frozen=True)
class Cases:
    """All cases, which were raced at a cost of `forwards` [forward equivalents], a gradient being `gradient_cost`."""

    forwards: float
    gradient_cost: float
    cases: tuple[Case, ...]


@dataclass(frozen=True)
class Near:
    """A case near to a landscape: how far, in deviations of the measures, and the rank of the advised method there."""

    name: str
    family: str
    distance: float
    best: tuple[str, ...]
    rank: float


@dataclass(frozen=True)
class Score:
    """How good advice is for cases of families that were left out: mean ranks, with 95 % intervals over families.

    `advised` is the rank of what the nearest cases advise, `single` that of one `method` everywhere, the best of these
    cases in hindsight, `best` that of the best in each case in hindsight, and `difference` the first less the second.
    `late` is `advised` if measuring has cost a tenth, NaN where that is not known.
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
        """Say in words what the mean ranks are."""
        apart = self.difference
        return (
            f"the nearest cases advise what has mean rank {self.advised.value:.1f}, and {self.method} everywhere has "
            f"{self.single.value:.1f} (difference {apart.value:+.2f}, 95 %: {apart.low:+.2f} to {apart.high:+.2f})"
        )

    @property
    def helps(self) -> bool:
        """Whether advice is better than one method everywhere, beyond chance."""
        return self.difference.high < 0


@dataclass(frozen=True)
class Scores:
    """How good advice is in our scenes, which decides whether it is given, and in functions."""

    scenes: Score
    functions: Score


@dataclass(frozen=True)
class Choice:
    """The method to begin with, why, and what the nearest cases let expect: mean ranks of methods, the best first.

    `by_cases` is whether it is the choice of the nearest cases, rather than the best single method of our scenes.
    `scores` say how good choices of the nearest cases are.
    """

    method: str
    by_cases: bool
    reason: str
    expected: Mapping[str, float]
    nearest: tuple[Near, ...]
    scores: Scores


@cache
def read_cases() -> Cases:
    """Return the cases that the package brings."""
    return from_json(Cases, read_json(Path(str(resources.files("gradscape.optim"))) / FILE))


def measures_of(one: Character) -> Array:
    """Return the measures that landscapes are compared by, NaN where they are not known."""
    found = [np.log10(one.parameters), one.failed, one.flat, *one.falls, *one.agreement, one.across, one.convex]
    found += [one.coherence, one.steepest, np.log10(1e-6 + one.noise), max(one.linear, 0.0), max(one.quadratic, 0.0)]
    found += [one.dispersion, one.information, one.distance, one.skewness]
    return np.array(found)


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """Cases to compare with, their measures in deviations from their means; what is not known counts as the mean."""

    cases: Sequence[Case]
    mean: Array
    deviation: Array

    @classmethod
    def of(cls, cases: Sequence[Case]) -> Neighbourhood:
        """Return that of some cases."""
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
    """What cases of other families advise in a case, by one of the samples that it was measured at."""

    case: Case
    method: str
    near: tuple[Case, ...]


def hold_out(cases: Sequence[Case]) -> list[HeldOut]:
    """Advise in each case, for each of its samples, by the cases of other families alone."""
    methods, found = methods_of(cases), list[HeldOut]()
    for family in dict.fromkeys(one.family for one in cases):
        known = Neighbourhood.of([one for one in cases if one.family != family])
        for case in (one for one in cases if one.family == family):
            for character in case.characters:
                near = tuple(one for _, one in known.nearest(character))
                found.append(HeldOut(case, next(iter(expected_ranks(near, methods))), near))
    return found


def score_held_out(found: Sequence[HeldOut], ranks: Callable[[Case], Mapping[str, float]] | None = None) -> Score:
    """Compare what was advised with what is best, by `ranks` of each case, by default its own.

    By others there is no `late`, which is NaN.
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
    """Return the methods that raced in the cases that the package brings."""
    return methods_of(read_cases().cases)


@cache
def published_scores() -> Scores:
    """Return the scores of the cases that the package brings."""
    found = hold_out(read_cases().cases)
    return Scores(*(score_held_out([one for one in found if one.case.scene == scene]) for scene in (True, False)))


def choose(character: Character, methods: Sequence[str] = ()) -> Choice:
    """Choose among `methods`, by default all that raced, the one to begin with in a landscape of such a character.

    Raises ValueError where none of them raced.
    """
    cases, scores = read_cases().cases, published_scores()
    able = [one for one in methods_of(cases) if not methods or one in methods]
    if not able:
        raise ValueError(f"there is no evidence on {', '.join(methods)}; there is on {', '.join(methods_of(cases))}")
    near = Neighbourhood.of(cases).nearest(character)
    expected = expected_ranks([case for _, case in near], able)
    advised = next(iter(expected))
    single = next(iter(expected_ranks([one for one in cases if one.scene], able)))
    method = advised if scores.scenes.helps else single
    found = tuple(Near(one.name, one.family, far, one.best, one.ranks[method]) for far, one in near)
    return Choice(method, scores.scenes.helps, _reason(method, advised, found, scores), expected, found, scores)


def _reason(method: str, advised: str, near: Sequence[Near], scores: Scores) -> str:
    """Say in a sentence why a method is advised, and how sure that is."""
    first = sum(method in one.best for one in near)
    known = [one.name for one in near if method in one.best]
    alike = f"it was best in {first} of the {len(near)} nearest cases"
    alike += f", as in {' and '.join(known[:2])}" if known else ""
    if scores.scenes.helps:
        return f"{alike}; in scenes of other kinds {scores.scenes.said}"
    other = "" if advised == method else f", which would say {advised}"
    return (
        f"no evidence beyond that one method: in scenes of other kinds {scores.scenes.said}; "
        f"in functions {scores.functions.said}. {alike[0].upper()}{alike[1:]}{other}"
    )
