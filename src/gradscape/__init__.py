"""See, measure and search the loss landscapes of differentiable simulators."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from .api.compare import compare
    from .api.environments import list_envs
    from .api.league import league
    from .api.measure import card, census, check, extremes, pairs, report
    from .api.overlay import overlay
    from .api.search import open_run, optimize, race
    from .api.slice import open_slice, sample, slice
    from .api.sweep import sweep
    from .api.tradeoff import tradeoff
    from .envs.adapters import from_jax, from_numpy, from_step, from_torch, from_warp
    from .envs.base import Environment, Fidelity
    from .envs.registry import as_environment, make, register
    from .jobs.scene import SceneSpec
    from .landscapes.episode import Episode
    from .landscapes.objective import Evaluation, Status
    from .landscapes.plane import Plane
    from .landscapes.slice import Slice
    from .landscapes.space import ParameterSpace, log
    from .optim.race import Race
    from .optim.runs.run import Run

# Where `gradscape.<name>` is, imported when first used: nothing heavy loads before it is needed.
_HOMES = {
    "Environment": "envs.base",
    "Episode": "landscapes.episode",
    "Evaluation": "landscapes.objective",
    "Fidelity": "envs.base",
    "ParameterSpace": "landscapes.space",
    "Plane": "landscapes.plane",
    "Race": "optim.race",
    "Run": "optim.runs.run",
    "SceneSpec": "jobs.scene",
    "Slice": "landscapes.slice",
    "Status": "landscapes.objective",
    "as_environment": "envs.registry",
    "card": "api.measure",
    "check": "api.measure",
    "compare": "api.compare",
    "extremes": "api.measure",
    "from_jax": "envs.adapters",
    "from_numpy": "envs.adapters",
    "from_step": "envs.adapters",
    "from_torch": "envs.adapters",
    "from_warp": "envs.adapters",
    "league": "api.league",
    "list_envs": "api.environments",
    "log": "landscapes.space",
    "make": "envs.registry",
    "open_run": "api.search",
    "open_slice": "api.slice",
    "optimize": "api.search",
    "overlay": "api.overlay",
    "census": "api.measure",
    "pairs": "api.measure",
    "race": "api.search",
    "register": "envs.registry",
    "report": "api.measure",
    "sample": "api.slice",
    "slice": "api.slice",
    "sweep": "api.sweep",
    "tradeoff": "api.tradeoff",
}

__all__ = [
    "Environment",
    "Episode",
    "Evaluation",
    "Fidelity",
    "ParameterSpace",
    "Plane",
    "Race",
    "Run",
    "SceneSpec",
    "Slice",
    "Status",
    "__version__",
    "as_environment",
    "card",
    "census",
    "check",
    "compare",
    "extremes",
    "from_jax",
    "from_numpy",
    "from_step",
    "from_torch",
    "from_warp",
    "league",
    "list_envs",
    "log",
    "make",
    "open_run",
    "open_slice",
    "optimize",
    "overlay",
    "pairs",
    "race",
    "register",
    "report",
    "sample",
    "slice",
    "sweep",
    "tradeoff",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'gradscape' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    return __all__
