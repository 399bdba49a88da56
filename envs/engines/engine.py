"""What an engine is: where its solvers are, and what they can do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Engine:
    """Describe an engine without loading it.

    `solvers` maps what is simulated (mpm, springs) to the module with its solver, from this folder on. An engine that
    is `deterministic` gives the same bits every time, on a GPU too, whatever else is in a batch. Solvers of a
    `concurrent` engine run beside each other in the threads of one process; a solver of any other has all cores to
    itself. A `profiled` engine tells the time by kernel. An engine that is not always installed comes with an `extra`
    of this package.
    """

    name: str
    solvers: Mapping[str, str] = field(default_factory=dict)
    deterministic: bool = True
    concurrent: bool = True
    profiled: bool = False
    extra: str = ""
