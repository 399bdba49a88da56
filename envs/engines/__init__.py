"""Simulation engines: the only place that knows Warp, Taichi, MuJoCo or Newton."""

from . import mjx, newton, taichi, warp
from .engine import Engine

ENGINES = {engine.name: engine for engine in (warp.ENGINE, taichi.ENGINE, mjx.ENGINE, newton.ENGINE)}


def find_engine(name: str) -> Engine:
    """Return what an engine can do; one that a scene brings along is taken to do what is usual."""
    return ENGINES.get(name, Engine(name))
