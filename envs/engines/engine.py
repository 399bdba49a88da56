"""What an engine is: where its solvers are, and what they can do."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field

from ..installed import install_line


@dataclass(frozen=True)
class Engine:
    """Describe an engine without loading it.

    `solvers` maps what is simulated (mpm, springs) to the module with its solver, from this folder on. An engine that
    is `deterministic` gives the same bits every time, on a GPU too, whatever else is in a batch. Solvers of a
    `concurrent` engine run beside each other in the threads of one process; a solver of any other has all cores to
    itself. A `profiled` engine tells the time by kernel. An engine that is not always installed comes with an `extra`
    of this package. `newest_python` is the last Python that it has wheels for, where that is not the newest there is.
    """

    name: str
    solvers: Mapping[str, str] = field(default_factory=dict)
    deterministic: bool = True
    concurrent: bool = True
    profiled: bool = False
    extra: str = ""
    newest_python: tuple[int, int] | None = None

    def explain(self, error: ImportError) -> str:
        """Return why the engine cannot be imported here, and what to do."""
        if self.newest_python and sys.version_info[:2] > self.newest_python:
            newest, here = (".".join(map(str, one)) for one in (self.newest_python, sys.version_info[:2]))
            return (
                f"{self.name.capitalize()} has no wheels past Python {newest}, and this is Python {here}; take engine "
                f"warp, or install gradscape with Python {newest}"
            )
        return f"{error}; {install_line(self.extra)}" if self.extra else str(error)
