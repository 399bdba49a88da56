"""What runs and methods take of this machine, by arithmetic: nothing is imported or made to find out.

Constants are what was measured (2026-11, pycma 4, BoTorch 0.16, Stable-Baselines3 2.7), rounded up.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from ..landscapes.capacity import BLOCK, Need, require

FLOAT = 8  # bytes
RUN = Need(50e3, 25 * BLOCK)  # of a run without a row: its attributes, and the files of its layout
COLUMNS, CHUNK = 9, 64  # of a run's table, and the rows that share a file
MATRICES = 8  # of dim x dim, that CMA-ES holds while it is written to disk: C, its eigenvectors, a pickle of both
POPULATION = 7000  # bytes for each member of a population, beside its numbers
PROCESS = 10  # arrays of points x points that a Gaussian process makes
STARTS = 600  # points from which its bound's least value is looked for
POLICY = 40e3  # bytes for each episode of a rollout: an environment of Stable-Baselines3
FEATURES = 64  # numbers that a policy sees, at most, in our scenes
ROW = 10e3  # bytes of a policy's networks for each transition of a batch

Options = Mapping[str, Any]


def require_runs(dim: int, budget: int, seeds: int, folder: Path, *, abreast: int = 1) -> None:
    """Refuse a budget that is too large for one seed, then more seeds than fit; each has a run of several methods."""
    require("budget", budget, lambda rows: run_need(dim, rows).times(abreast), folder)
    require("seeds", seeds, run_need(dim, budget).times(abreast).times, folder)


def run_need(dim: int, rows: int) -> Need:
    """Return what a run of so many rows takes: columns, a copy of them in a table, and room that they grow into."""
    row = FLOAT * (2 * dim + 5) + 2
    chunks = -(-rows // CHUNK)
    return Need(RUN.memory + 3.0 * row * rows, RUN.disk + float(row * rows + COLUMNS * BLOCK * chunks))


@dataclass(frozen=True)
class Search:
    """Say what a method searches: how many parameters, decisions of an episode and, where that is known, episodes."""

    dim: int
    decisions: int = 1
    budget: int = 0


def require_method(name: str, options: Any, search: Search) -> None:
    """Refuse a method that takes more memory than there is: for its dimension, or else for the option that is too much.

    `options` is the method's dataclass; its defaults are judged first, then with one option after the other.
    """
    known = asdict(type(options)())
    require(f"{name}: number of parameters", search.dim, lambda dim: _need(name, known, replace(search, dim=dim)))
    for option in fields(options):
        value = getattr(options, option.name)
        if type(value) is int and value > 0:
            require(f"{name} option {option.name}", value, partial(_with, name, known, search, option.name))
        known[option.name] = value


def _with(name: str, options: Options, search: Search, option: str, value: int) -> Need:
    return _need(name, {**options, option: value}, search)


def _need(name: str, options: Options, search: Search) -> Need:
    return Need(float(NEEDS[name](options, search)))


def _random(options: Options, search: Search) -> float:
    return 100 * FLOAT * search.dim


def _cma_es(options: Options, search: Search) -> float:
    member = POPULATION + 20 * FLOAT * search.dim
    return FLOAT * MATRICES * search.dim**2 + options["population"] * member  # type: ignore[no-any-return]


def _descents(options: Options, search: Search) -> float:
    return options["together"] * (1000 + 20 * FLOAT * search.dim)  # type: ignore[no-any-return]


def _bo(options: Options, search: Search) -> float:
    points = min(options["most"], search.budget)
    return FLOAT * (PROCESS * points**2 + 20 * (STARTS + points) * search.dim)  # type: ignore[no-any-return]


def _bo_leap(options: Options, search: Search) -> float:
    return _bo(options, search) + _cma_es(options, search)


def _ppo(options: Options, search: Search) -> float:
    each = POLICY + search.decisions * _transition(search)
    return options["episodes"] * each + _networks(search)  # type: ignore[no-any-return]


def _sac(options: Options, search: Search) -> float:
    transitions = options["memory"] + options["warmup"] * search.decisions
    return transitions * _transition(search) + options["batch"] * ROW + _networks(search)  # type: ignore[no-any-return]


def _transition(search: Search) -> float:
    """Return the bytes of what is seen before and after an action, and of the action, in float32."""
    return 4 * (2 * FEATURES + search.dim // search.decisions + 10)


def _networks(search: Search) -> float:
    """Return the bytes of a policy, its critics and their optimisers' moments."""
    return 4 * 64 * 20 * (FEATURES + search.dim // search.decisions)


NEEDS: dict[str, Callable[[Options, Search], float]] = {
    "random": _random,
    "cma-es": _cma_es,
    "descents": _descents,
    "bo": _bo,
    "bo-descents": _bo,
    "bo-leap": _bo_leap,
    "ppo": _ppo,
    "sac": _sac,
}
