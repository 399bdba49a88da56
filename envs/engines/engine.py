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

    def lacking_wheels(self) -> str:
        """Return why the engine is not to be had for this Python, and what to do; empty where it is."""
        newest, here = self.newest_python, sys.version_info[:2]
        if newest is None or here <= newest:
            return ""
        last, ours = (".".join(map(str, version)) for version in (newest, here))
        return (
            f"{self.name.capitalize()} has no wheels past Python {last}, and this is Python {ours}; take engine warp, "
            f"or install gradscape with Python {last}"
        )

    def with_advice(self, why: str) -> str:
        """Return why the engine cannot be imported, and what installs it."""
        return f"{why}; {install_line(self.extra)}" if self.extra else why
