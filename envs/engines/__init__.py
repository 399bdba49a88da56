"""Simulation engines: the only place that knows Warp or Taichi."""

from . import taichi, warp
from .engine import Engine

ENGINES = {engine.name: engine for engine in (warp.ENGINE, taichi.ENGINE)}


def find_engine(name: str) -> Engine:
    """Return what an engine can do; one that a scene brings along is taken to do what is usual."""
    return ENGINES.get(name, Engine(name))
