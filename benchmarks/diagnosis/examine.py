"""What `gs.check` says of the cases, held against what is true of them."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

import gradscape as gs
from gradscape.landscapes.checks.diagnosis import Diagnosis

from .cases import Case
from .planted import slab

POWER = "5%"
WIDTHS = (0.02, 0.05, 0.1, 0.2, 0.4)  # of slabs, shares of the box
SLABS = 36  # of each width
TILTED = 10  # parameters of those at an angle
AT_EDGES = 4  # of them, which begin or end at the box's own edge
NEAR = 0.1  # share of a parameter's range, by which a rule may miss an edge of a region
LATE = 2  # steps by which the first wrong one may be named too late
SHARED = 0.8  # of the parameters that are named or should be, where these are more than FEW
FEW = 3
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Result:
    """What was said of a case: `cause` and `place` are None where none is wanted, `said` is what came first."""

    case: str
    kind: str
    framework: str
    healthy: bool
    passed: bool
    found: bool
    cause: bool | None
    place: bool | None
    said: str
    seconds: float


@dataclass(frozen=True)
class Slab:
    """A region of the box between two values of a weighted sum of the parameters."""

    direction: tuple[float, ...]
    lower: float
    upper: float


@dataclass(frozen=True)
class Slabs:
    """Of how many slabs of a width, a share of the box, was the wrong sign found."""

    width: float
    tilted: bool
    found: int
    tried: int
    seconds: float


def examine(case: Case, seed: int = 0) -> Result:
    """Check a case, and hold what is said against what is true. A check that raises has found nothing."""
    env, start = case.build(), time.perf_counter()
    placed = bool(case.parameters or case.edges or case.step)  # must be named
    result = partial(Result, case.name, case.kind, case.framework, case.healthy)
    try:
        report = gs.check(env, power=POWER, seed=seed)
    except Exception as error:  # of any kind: it is a result, too
        said = f"raised {type(error).__name__}: {' '.join(str(error).split())[:160]}"
        wrong, nowhere = None if case.healthy else False, False if placed else None
        return result(False, False, wrong, nowhere, said, time.perf_counter() - start)
    seconds, told = time.perf_counter() - start, report.diagnoses
    if case.healthy:
        bad = [f"{one.check}: {one.why or one.figure}" for one in report.findings if one.bad]
        said = "; ".join([_name(one) for one in told if one.outcome == "fail"] or bad)
        return result(report.passed, False, None, None, said, seconds)
    fitting = [one for one in told if one.cause in case.causes]
    found = not report.passed or (case.warns and bool(fitting))
    named = bool(fitting) and (case.warns or told[0].cause in case.causes)
    unnamed = "" in case.causes and not report.passed and not told
    place = found and is_placed(case, env.space, fitting or told[:1]) if placed else None
    said = "; ".join(map(_name, told)) or "no diagnosis"
    return result(report.passed, found, found and (named or unnamed), place, said, seconds)


def _name(diagnosis: Diagnosis) -> str:
    where = f" ({diagnosis.region.rule})" if diagnosis.region else ""
    who = f" [{', '.join(diagnosis.parameters[:4])}{', ...' if len(diagnosis.parameters) > 4 else ''}]"
    return f"{diagnosis.cause or 'none'}{who if diagnosis.parameters else ''}{where}"


def is_placed(case: Case, space: gs.ParameterSpace, told: Sequence[Diagnosis]) -> bool:
    """Whether one of some diagnoses names the parameters, the region or the step."""
    if case.step:
        return any(_names_step(case.step, one) for one in told)
    if case.edges:
        return any(_names_region(case, space, one) for one in told)
    return any(_same(case.parameters, one.parameters or space.names) for one in told)  # none named: all are meant


def _same(wanted: Sequence[str], named: Sequence[str]) -> bool:
    """Whether the same parameters are named, nearly all where they are many."""
    both, either = {*wanted} & {*named}, {*wanted} | {*named}
    return both == either if len(wanted) <= FEW else len(both) >= SHARED * len(either)


def _names_region(case: Case, space: gs.ParameterSpace, told: Diagnosis) -> bool:
    """Whether a rule names the parameters of a region, and a number of its own near each of its edges."""
    if told.region is None or {*told.region.parameters} != {*case.edges}:
        return False
    rule = told.region.rule
    for name in space.names:
        rule = rule.replace(name, " ")  # a name may hold a number
    numbers = [float(one) for one in NUMBER.findall(rule)]
    for name, edges in case.edges.items():
        which = space.names.index(name)
        allowed = NEAR * float(space.upper[which] - space.lower[which])
        for edge in edges:
            nearest = min(numbers, key=lambda one, edge=edge: abs(one - edge), default=np.inf)  # type: ignore[misc]
            if abs(nearest - edge) > allowed:
                return False
            numbers.remove(nearest)
    return True


def _names_step(step: int, told: Diagnosis) -> bool:
    """Whether a number of a diagnosis is the first wrong step, or one shortly after."""
    text = f"{told.what} {told.region.rule if told.region else ''}"
    numbers = [float(one) for one in NUMBER.findall(text)]
    return any(step <= one <= step + LATE for one in numbers)


def slabs_of(width: float, tilted: bool = False) -> list[Slab]:
    """Return slabs of a width, at both edges of the box and at random places.

    They lie across one of two forces, or, tilted, at an angle in the box of ten.
    """
    draw = np.random.default_rng(round(1000 * width))
    starts = np.concatenate([[0, 1 - width] * (AT_EDGES // 2), draw.uniform(0, 1 - width, SLABS - AT_EDGES)])
    across = [np.eye(2)[k // 2 % 2] for k in range(SLABS)]
    directions = draw.standard_normal((SLABS, TILTED)) if tilted else np.array(across)
    forces = draw.uniform(-2, 3, (20000, directions.shape[1]))  # shares are those of the box, so known by its points
    found = []
    for direction, start in zip(directions, starts, strict=True):
        ends = np.array([start, start + width])
        lower, upper = np.quantile(forces @ direction, ends) if tilted else 5 * ends - 2
        found.append(Slab(tuple(map(float, direction)), float(lower), float(upper)))
    return found


def power(width: float, tilted: bool = False, tell: Callable[[str], None] = lambda _: None) -> Slabs:
    """Count how many slabs of a width are found, each with a seed of its own; `tell` hears how many are done."""
    found, start, cuts = 0, time.perf_counter(), slabs_of(width, tilted)
    for seed, cut in enumerate(cuts):
        found += not gs.check(slab(cut.direction, cut.lower, cut.upper), power=POWER, seed=seed).passed
        tell(f"slab {seed + 1} of {width:.0%}")
    return Slabs(width, tilted, found, len(cuts), time.perf_counter() - start)
