"""Make the cases that `landscape advise` learns from, and score its advice by leaving whole families out.

    python -m benchmarks.advice score                             # from the published cases: seconds
    python -m benchmarks.advice rows --races FOLDER [--jobs 2]    # all cases again: some 45 minutes of one core

Cases are the 24 functions of BBOB in 2 and 5 parameters and every second one in 10, the functions of known character of
`benchmarks.words`, BoTorch's functions, and the scenes of the league. Nine methods race in each within 500 forward
equivalents. Functions have one seed each, and a gradient counts as two losses, about the median of our scenes. The
races in FOLDER are continued. The scenes' ten seeds are those of the gallery's league, truncated at that cost.

Losses closer to the best of the race than 1e-8 of the first one's distance count as equal; among equal methods, the
first to reach its loss is ahead. A function in which no method improves on its first loss is left out. The cases are in
`optim/advice.json`, which is part of the package.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarks import words
from benchmarks.bbob import BBOB, FORMULAS
from docs.pages.text import table
from numpy.typing import NDArray

import gradscape as gs
from gradscape.gallery.files import DATA
from gradscape.gallery.league import METHODS, KeptRuns, read_league
from gradscape.jobs.search import make_optimizer
from gradscape.landscapes.convert import to_json
from gradscape.landscapes.measures.character import Character, measure_character
from gradscape.landscapes.objective import Objective
from gradscape.landscapes.statistics import Estimate
from gradscape.landscapes.threads import one_torch_thread
from gradscape.optim.advice import (
    EVALUATIONS,
    FILE,
    Case,
    Cases,
    Score,
    expected_ranks,
    hold_out,
    read_cases,
    score_held_out,
)
from gradscape.optim.race import Competitor, race
from gradscape.optim.registry import optimizer_class
from gradscape.optim.runs.store import RunStore
from gradscape.optim.statistics import seed_ranks

FORWARDS, GRADIENT_COST = 500, 2.0  # of a race, and what a gradient of a function counts as
DIMS = {2: 1, 5: 1, 10: 2}  # of BBOB's functions, and which of them: each, or every second one
SAMPLES = 3  # of points that a landscape is measured at
LATE = 0.9  # of the cost, which is left where a tenth was measured
SAME = 1e-8  # of the way from the first loss to the best: nearer ones are level
DIGITS = 4  # of what is published
GRADIENTS_ALONE = ("descents", "bo-descents", "l-bfgs-b", "adam")  # ask for a gradient at every point
FUNCTIONS = (
    "ackley",
    "beale",
    "branin",
    "griewank",
    "levy",
    "rastrigin",
    "rosenbrock",
    "six-hump-camel",
    "styblinski-tang",
)
FAMILIES = {  # of our scenes
    **dict.fromkeys(("bounce", "pinball-2", "pinball-16"), "balls"),
    "cartpole": "cartpole",
    "fluid": "fluid",
    **dict.fromkeys(("flip", "swing-stiffness", "swing-velocity"), "cloth"),
    **dict.fromkeys(
        ("assembly", "pinch", "rolling-pin", "rope", "table", "torus", "triple-move", "writer"), "plasticine"
    ),
}
Found = Mapping[str, Mapping[str, Sequence[float]]]  # method -> forwards and loss of each improvement of its run


@dataclass(frozen=True)
class Subject:
    """A function or a scene to measure, and its factory."""

    name: str
    family: str
    make: Callable[[], Objective]
    scene: bool = False


@cache
def functions() -> dict[str, Subject]:
    """Return the functions that methods race in, by name."""
    found = [
        Subject(f"BBOB f{number}, {dim} parameters", f"BBOB {BBOB(number, dim).group}", partial(BBOB, number, dim))
        for dim, every in DIMS.items()
        for number in range(every, len(FORMULAS) + 1, every)
    ]
    for kind, members in words.KINDS.items():
        found += [Subject(one.name, f"words, {kind}", partial(words.KnownObjective, one)) for one in members]
    found += [Subject(name, "BoTorch", partial(gs.make, name)) for name in FUNCTIONS]
    return {one.name: one for one in found}


def scenes() -> list[Subject]:
    """Return the scenes of the league, at its fidelities."""
    league = read_league(DATA)
    assert league is not None  # it is a part of every checkout
    make = partial(gs.make, device="cpu")
    return [
        Subject(one.env, FAMILIES[one.env], partial(make, one.env, fidelity=one.fidelity), scene=True)
        for one in league.scenes
    ]


def race_in(name: str) -> Found:
    """Race the methods in a function, and return the improvements of each; their losses exclude noise."""
    objective = functions()[name].make()
    env, found = gs.as_environment(objective), dict[str, Mapping[str, Sequence[float]]]()
    torch.set_num_threads(1)
    for methods in (GRADIENTS_ALONE, tuple(one for one in METHODS if one not in GRADIENTS_ALONE)):
        budget = int(FORWARDS / GRADIENT_COST) if methods is GRADIENTS_ALONE else FORWARDS
        runs = {method: RunStore.in_memory(env.space, identity={"seed": 0}, budget=budget) for method in methods}
        makes = {method: partial(make_optimizer, method, env) for method in methods}
        with one_torch_thread():
            competitors = [Competitor(method, 0, run, makes[method]) for method, run in runs.items()]
            race(env, competitors, budget=budget, gradient_cost=GRADIENT_COST)
        found |= {method: _improvements(objective, run) for method, run in runs.items()}
    return found


def _improvements(objective: Objective, run: RunStore) -> dict[str, list[float]]:
    data = run.dataset()
    best = np.fmin.accumulate(data["loss"].to_numpy())
    rows = np.flatnonzero((np.diff(best, prepend=np.nan) != 0) & np.isfinite(best))
    loss = best[rows]
    if isinstance(objective, words.KnownObjective) and objective.known.noise:
        loss = objective.known.loss(torch.from_numpy(data["x"].to_numpy()[rows])).numpy()
    return {"forwards": data["forwards"].to_numpy()[rows].tolist(), "loss": loss.tolist()}


def races(folder: Path, jobs: int) -> dict[str, Found]:
    """Return the races in all functions, stored ones from a folder and new ones."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {name: folder / f"{name.replace('/', '-')}.json" for name in functions()}
    left = [name for name, file in files.items() if not file.exists()]
    with ProcessPoolExecutor(jobs) as executor:
        for name, found in zip(left, executor.map(race_in, left), strict=True):
            files[name].write_text(json.dumps(found))
            print(f"{name}: raced", flush=True)
    return {name: json.loads(file.read_text()) for name, file in files.items()}


def kept_races(scene: str) -> list[Found]:
    """Return the races of the league in a scene, by seed."""
    runs = KeptRuns.read(DATA / "league" / f"{scene}.npz").runs
    seeds = sorted({one.seed for one in runs})
    return [
        {one.method: {"forwards": one.forwards.tolist(), "loss": one.loss.tolist()} for one in runs if one.seed == seed}
        for seed in seeds
    ]


def ranks(found: Sequence[Found], forwards: float) -> tuple[dict[str, float], dict[str, float]]:
    """Return the mean ranks of methods over races at a cost, and those of each if it alone has nine tenths of it."""
    places = np.array([_places(one, forwards) for one in found])  # shape (race, early or late, method, two)
    whole, late = places[:, 0], places[:, 1]
    rows = [_ranked(whole)] + [
        _ranked(np.where(np.arange(len(METHODS))[None, :, None] == k, late, whole)) for k in range(len(METHODS))
    ]
    alone = [rows[k + 1][k] for k in range(len(METHODS))]
    first, second = (dict(zip(METHODS, map(float, one), strict=True)) for one in (rows[0], alone))
    return first, second


def _ranked(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean rank of each method over races: the lowest loss first, the earliest of equal ones."""
    order = [np.unique(one, axis=0, return_inverse=True)[1].ravel() for one in places]
    found: NDArray[np.float64] = seed_ranks(np.array(order, float).T).mean(axis=1)
    return found


def _places(found: Found, forwards: float) -> NDArray[np.float64]:
    """Return the loss of each method at a cost and at nine tenths of it, and from which cost on, shape (2, method, 2).

    Losses equal to the best of the race are set to it. A method is at infinity before its first loss.
    """
    curves = [(np.array(found[one]["forwards"]), np.array(found[one]["loss"])) for one in METHODS]
    known = [loss for _, loss in curves if len(loss)]
    best, first = (min(map(np.min, known)), max(loss[0] for loss in known)) if known else (0.0, 0.0)
    level = best + SAME * (first - best)
    return np.array([[_place(cost, loss, level, share * forwards) for cost, loss in curves] for share in (1.0, LATE)])


def _place(cost: NDArray[np.float64], loss: NDArray[np.float64], level: float, forwards: float) -> tuple[float, float]:
    there = np.maximum(loss[cost <= forwards], level)
    return (float(there[-1]), float(cost[np.argmax(there <= there[-1])])) if len(there) else (np.inf, np.inf)


def characters(subject: Subject) -> tuple[Character, ...]:
    """Measure a landscape at several samples of points."""
    env = gs.as_environment(subject.make())
    measured = [measure_character(env, evaluations=EVALUATIONS, seed=seed).character for seed in range(SAMPLES)]
    print(f"{subject.name}: measured", flush=True)
    return tuple(measured)


def cases(folder: Path, jobs: int) -> Iterator[Case]:
    """Yield all cases in which methods differ."""
    found = {name: [one] for name, one in races(folder, jobs).items()}
    for subject in (*functions().values(), *scenes()):
        raced = kept_races(subject.name) if subject.scene else found[subject.name]
        ranked, late = ranks(raced, FORWARDS)
        if any(len(set(curve["loss"])) > 1 for one in raced for curve in one.values()):
            yield Case(subject.name, subject.family, subject.scene, characters(subject), ranked, late)


def write(folder: Path, jobs: int) -> None:
    """Make all cases, and publish them."""
    whole = Cases(FORWARDS, GRADIENT_COST, tuple(cases(folder, jobs)))
    path = Path(__file__).parents[1] / "optim" / FILE
    path.write_text(
        json.dumps(_rounded(to_json(whole)), separators=(",", ":")).replace('},{"name"', '},\n{"name"') + "\n"
    )


def _rounded(value: Any) -> Any:
    """Return plain JSON with numbers of few digits."""
    if isinstance(value, dict):
        return {name: _rounded(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def scores() -> dict[str, Score]:
    """Return the score over all cases and over parts of them, and of our scenes by the whole league."""
    found = hold_out(read_cases().cases)
    ours = [one for one in found if one.case.scene]
    league = read_league(DATA)
    assert league is not None  # it is a part of every checkout
    at_cost, episodes = (
        {one.env: {rank.method: rank.rank for rank in way(one)} for one in league.scenes}
        for way in (lambda one: one.equal_cost.ranks, lambda one: one.ranks)
    )
    return {
        "all cases": score_held_out(found),
        "functions": score_held_out([one for one in found if not one.case.scene]),
        "our scenes": score_held_out(ours),
        "our scenes, 1000 forward equivalents": score_held_out(ours, lambda case: at_cost[case.name]),
        "our scenes, 1000 episodes": score_held_out(ours, lambda case: episodes[case.name]),
    }


def score_table() -> str:
    """Return the scores as a table: mean ranks among nine methods, with 95 % intervals over families."""
    rows = [
        [
            said, f"{one.cases} ({one.families})", _interval(one.advised), _interval(one.late),
            f"`{one.method}` {_interval(one.single)}", _interval(one.best), _interval(one.difference, "+.2f"),
        ]
        for said, one in scores().items()
    ]  # fmt: skip
    head = (
        "judged by",
        "cases (families)",
        "advised",
        "advised, a tenth spent",
        "best single method",
        "best in hindsight",
    )
    return table((*head, "advised minus single"), rows)


def scene_table() -> str:
    """Return the advice for each of our scenes from cases of other families, and its rank there."""
    found, rows = [one for one in hold_out(read_cases().cases) if one.case.scene], []
    for name in sorted({one.case.name for one in found}):
        mine = [one for one in found if one.case.name == name]
        case, said = mine[0].case, list(dict.fromkeys(one.method for one in mine))
        single = f"{case.ranks[scores_single()]:.1f}"
        near = "; ".join(dict.fromkeys(one.name for held in mine for one in held.near[:1]))
        advised = ", ".join(f"`{method}` {case.ranks[method]:.1f}" for method in said)
        best = ", ".join(f"`{method}`" for method in case.best)
        rows.append([f"`{name}`", near, advised, single, f"{best} {min(case.ranks.values()):.1f}"])
    return table(("scene", "nearest case", "advised, its rank", f"rank of `{scores_single()}`", "best there"), rows)


KINDS: dict[str, Callable[[Case], bool]] = {  # of landscapes, by measures whose names are those of `measures_of`
    "Gradients are accurate over steps of 0.1 % (at least 90 % of the predicted decrease)": lambda case: (
        promised(case) >= 0.9
    ),
    "Gradients mislead over these steps (less than half of the predicted decrease)": lambda case: promised(case) < 0.5,
}


def promised(case: Case) -> float:
    """Return the actual decrease of the shortest steps relative to their gradients' prediction; 0 if unknown.

    It is a mean over samples.
    """
    return float(np.nan_to_num([one.agreement[0] for one in case.characters]).mean())


def prose() -> str:
    """Return the best methods for each kind of landscape, as a list."""
    known, lines = read_cases().cases, list[str]()
    for said, fits in KINDS.items():
        lines.append(f"- {said}: {_best([one for one in known if fits(one)], METHODS)}.")
    alone = [method for method in METHODS if not optimizer_class(method).needs_grad]
    lines.append(f"- Without gradients: {_best(known, alone)}.")
    for said, found in (("scenes", scores()["our scenes"]), ("functions", scores()["functions"])):
        lines.append(
            f"- Advice by the nearest cases, in {said} whose family was left out: mean rank "
            f"{_interval(found.advised, '.1f')}. `{found.method}` everywhere: {_interval(found.single, '.1f')}. The "
            f"difference is {_interval(found.difference, '+.2f')}, so {_verdict(found)}."
        )
    return "".join(f"{line}\n" for line in lines)


def _verdict(found: Score) -> str:
    if found.helps:
        return "it helps"
    return "it harms" if found.difference.low > 0 else "there is no evidence that it helps"


def _best(cases: Sequence[Case], methods: Sequence[str]) -> str:
    """Name the best methods in some cases, and in the scenes among them."""
    scenes = [one for one in cases if one.scene]
    ours = f"in the {len(scenes)} scenes among them {_ranked_first(scenes, methods)}"
    return f"{_ranked_first(cases, methods)} ({len(cases)} cases); {ours}"


def _ranked_first(cases: Sequence[Case], methods: Sequence[str]) -> str:
    found = expected_ranks(cases, methods)
    return ", ".join(f"`{method}` {rank:.1f}" for method, rank in list(found.items())[:3])


def scores_single() -> str:
    """Return the method that is best everywhere."""
    return scores()["all cases"].method


def _interval(one: Estimate, form: str = ".2f") -> str:
    if not np.isfinite(one.value):
        return ""
    return f"{one.value:{form}} ({one.low:{form}} to {one.high:{form}})".replace("-", "\N{MINUS SIGN}")


def main() -> None:
    """Score the published cases, or make them again."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("score", "rows"))
    parser.add_argument("--races", type=Path, default=Path("out/advice-races"), help="where races are kept")
    parser.add_argument("--jobs", type=int, default=1, help="processes that race")
    asked = parser.parse_args()
    if asked.what == "rows":
        write(asked.races, asked.jobs)
    print(score_table(), scene_table(), sep="\n")


if __name__ == "__main__":
    main()
