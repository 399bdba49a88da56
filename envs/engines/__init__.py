"""Simulation engines: the only place that knows Warp, Taichi, MuJoCo or Newton."""

from ..installed import is_installed
from . import mjx, newton, taichi, warp
from .engine import Engine

ENGINES = {engine.name: engine for engine in (warp.ENGINE, taichi.ENGINE, mjx.ENGINE, newton.ENGINE)}


def refuse_engine(scene: str, name: str) -> None:
    """Raise ValueError for an engine of one of our scenes that nobody has, or nobody with this Python."""
    if name not in ENGINES:
        raise ValueError(f"{scene} has no engine {name!r}; there are {', '.join(ENGINES)}")
    if (why := ENGINES[name].lacking_wheels()) and not is_installed(name):
        raise ValueError(f"{scene} cannot run on engine {name} here: {why}")


def find_engine(name: str) -> Engine:
    """Return what an engine can do; one that a scene brings along is taken to do what is usual."""
    return ENGINES.get(name, Engine(name))
