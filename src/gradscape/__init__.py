"""See, measure and search the loss landscapes of differentiable simulators."""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# What `gradscape.<name>` means, imported when first used: nothing heavy loads before it is needed.
_HOMES = {
    "ParameterSpace": "landscapes.space",
    "Evaluation": "landscapes.objective",
    "Objective": "landscapes.objective",
    "Status": "landscapes.objective",
    "Plane": "landscapes.plane",
    "from_numpy": "landscapes.adapters",
    "from_torch": "landscapes.adapters",
    "open_slice": "landscapes.storage.store",
    "open_run": "api.search",
    "optimize": "api.search",
    "race": "api.search",
    "overlay": "api.overlay",
    "sample": "landscapes.sampling.fill",
    "Environment": "envs.base",
    "Episode": "envs.base",
    "Fidelity": "envs.base",
    "make": "envs.registry",
    "register": "envs.registry",
}

__all__ = sorted([*_HOMES, "__version__"])


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'gradscape' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    return __all__
