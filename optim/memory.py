"""Estimate the memory of runs and methods by arithmetic, without allocating anything.

A method estimates its own memory (`Optimizer.memory`). Constants are measurements, rounded up.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..landscapes.capacity import BLOCK, Need, require

FLOAT = 8  # bytes
STORE = Need(50e3, 25 * BLOCK)  # of a run without a row: its attributes, and the files of its layout
COLUMNS, CHUNK = 9, 64  # of a run's table, and the rows that share a file


def require_runs(dim: int, budget: int, seeds: int, folder: Path, *, abreast: int = 1) -> None:
    """Refuse a budget that is too large for one seed, then more seeds than fit; each has a run of several methods."""
    require("budget", budget, lambda rows: run_need(dim, rows).times(abreast), folder)
    require("seeds", seeds, run_need(dim, budget).times(abreast).times, folder)


def run_need(dim: int, rows: int) -> Need:
    """Return the memory of a run of this many rows: columns, a copy of them in a table, and room to grow."""
    row = FLOAT * (2 * dim + 5) + 2
    chunks = -(-rows // CHUNK)
    return Need(STORE.memory + 3.0 * row * rows, STORE.disk + float(row * rows + COLUMNS * BLOCK * chunks))


@dataclass(frozen=True)
class SearchSize:
    """Say what a method searches: how many parameters, decisions of an episode and, where that is known, episodes."""

    dim: int
    decisions: int = 1
    budget: int = 0
