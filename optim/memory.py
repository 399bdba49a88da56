"""What runs and methods take of this machine, by arithmetic: nothing is made to find out.

A method says by its `memory` what it takes itself. Constants are what was measured, rounded up.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..landscapes.capacity import BLOCK, Need, require

if TYPE_CHECKING:
    from .base import Optimizer

FLOAT = 8  # bytes
STORE = Need(50e3, 25 * BLOCK)  # of a run without a row: its attributes, and the files of its layout
COLUMNS, CHUNK = 9, 64  # of a run's table, and the rows that share a file

Options = Mapping[str, Any]


def require_runs(dim: int, budget: int, seeds: int, folder: Path, *, abreast: int = 1) -> None:
    """Refuse a budget that is too large for one seed, then more seeds than fit; each has a run of several methods."""
    require("budget", budget, lambda rows: run_need(dim, rows).times(abreast), folder)
    require("seeds", seeds, run_need(dim, budget).times(abreast).times, folder)


def run_need(dim: int, rows: int) -> Need:
    """Return what a run of so many rows takes: columns, a copy of them in a table, and room that they grow into."""
    row = FLOAT * (2 * dim + 5) + 2
    chunks = -(-rows // CHUNK)
    return Need(STORE.memory + 3.0 * row * rows, STORE.disk + float(row * rows + COLUMNS * BLOCK * chunks))


@dataclass(frozen=True)
class SearchSize:
    """Say what a method searches: how many parameters, decisions of an episode and, where that is known, episodes."""

    dim: int
    decisions: int = 1
    budget: int = 0


def require_method(method: type[Optimizer], options: Any, size: SearchSize) -> None:
    """Refuse a method that takes more memory than there is: for its dimension, or else for the option that is too much.

    `options` is the method's dataclass; its defaults are judged first, then with one option after the other. Raises
    TooLargeError.
    """
    name, known = method.name, asdict(type(options)())
    require(f"{name}: number of parameters", size.dim, lambda dim: Need(method.memory(known, replace(size, dim=dim))))
    for option in fields(options):
        value = getattr(options, option.name)
        if type(value) is int and value > 0:
            require(f"{name} option {option.name}", value, partial(_need_with, method, known, size, option.name))
        known[option.name] = value


def _need_with(method: type[Optimizer], options: Options, size: SearchSize, option: str, value: int) -> Need:
    return Need(float(method.memory({**options, option: value}, size)))
