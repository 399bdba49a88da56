"""Simulation engines: the only place that knows Warp, Taichi, MuJoCo or Newton."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version

from ... import __version__
from ...landscapes.identity import PACKAGE

IMPORTED_AT = time.time()  # a file of ours that is changed later is not what this process runs
EXTRAS = {"mjx": ("mujoco", "mujoco-mjx", "jax"), "newton": ("newton",)}  # of this package, and what each brings


def installed_version(package: str) -> str | None:
    """Return the version of a package, without importing it; None where it is not installed."""
    if package == PACKAGE:  # what pip wrote about a clone can be older than its code
        return __version__
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def is_installed(package: str) -> bool:
    """Return whether a package is installed, without importing it."""
    return installed_version(package) is not None


def install_line(extra: str) -> str:
    """Return the command that installs an extra of this package."""
    return f"pip install 'gradscape[{extra}]'"


@dataclass(frozen=True)
class Engine:
    """Describe an engine without loading it.

    `solvers` maps what is simulated (mpm, springs) to the module with its solver, relative to this folder. A
    `deterministic` engine gives the same bits every time, also on a GPU, whatever else is in a batch. Solvers of a
    `concurrent` engine run in parallel in the threads of one process; a solver of any other engine uses all cores. A
    `profiled` engine reports times by kernel. An optional engine has an `extra` of this package. `newest_python` is the
    last Python with wheels for it, if that is not the newest.
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
                f"{self.name.capitalize()} has no wheels past Python {newest}, but this is Python {here}; use engine "
                f"warp, or install gradscape with Python {newest}"
            )
        return f"{error}; {install_line(self.extra)}" if self.extra else str(error)


ENGINES = {
    engine.name: engine
    for engine in (
        Engine("warp", {"mpm": "mpm.solver", "springs": "sheets.springs"}, profiled=True),  # of every simulated scene
        Engine(  # the independent reference: solvers written again in another language, with the compiler's gradients
            "taichi",
            {"mpm": "taichi.mpm", "springs": "taichi.springs"},
            deterministic=False,
            concurrent=False,
            newest_python=(3, 12),
        ),
        Engine("torch", {"collisions": "balls.collisions"}, concurrent=False),  # by autograd
        Engine("mjx", {"model": "mjx.model", "rollout": "mjx.rollout"}, concurrent=False, extra="mjx"),  # MuJoCo in JAX
        Engine("newton", {"rollout": "newton.rollout"}, concurrent=False, extra="newton"),  # by Warp's tape
    )
}


def find_engine(name: str) -> Engine:
    """Return the abilities of an engine; an unknown engine of a scene has the default ones."""
    return ENGINES.get(name, Engine(name))
