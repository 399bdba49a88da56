"""See, measure and search the loss landscapes of differentiable simulators."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.3.0"

if TYPE_CHECKING:
    from . import testing
    from .api.compare import compare
    from .api.environments import list_envs
    from .api.explore import explore
    from .api.export import export
    from .api.measure import bench, card, census, check, hessian, pairs, remedy
    from .api.overlay import overlay
    from .api.plan import plan
    from .api.replay import replay
    from .api.report import report
    from .api.search import advise, league, open_run, optimize, race
    from .api.slice import bounce, open_slice, sample, slice, slices
    from .api.study import study
    from .api.surface import surface
    from .api.sweep import sweep
    from .envs.adapters import from_jax, from_numpy, from_step, from_torch, from_warp
    from .envs.base import Environment, Fidelity
    from .envs.registry import as_environment, make, register
    from .envs.remedies import average, clip, rescale, shorten, smooth, soften
    from .jobs.scene import SceneSpec
    from .landscapes.episode import Episode
    from .landscapes.objective import Evaluation, Status
    from .landscapes.plane import Plane
    from .landscapes.slice import Slice
    from .landscapes.space import ParameterSpace, log
    from .optim.race import Race
    from .optim.runs.run import Run

# Where public names are, imported when first used: nothing heavy loads before it is needed.
_HOMES = {
    "api.compare": ("compare",),
    "api.environments": ("list_envs",),
    "api.explore": ("explore",),
    "api.export": ("export",),
    "api.measure": ("bench", "card", "census", "check", "hessian", "pairs", "remedy"),
    "api.overlay": ("overlay",),
    "api.plan": ("plan",),
    "api.replay": ("replay",),
    "api.report": ("report",),
    "api.search": ("advise", "league", "open_run", "optimize", "race"),
    "api.slice": ("bounce", "open_slice", "sample", "slice", "slices"),
    "api.study": ("study",),
    "api.surface": ("surface",),
    "api.sweep": ("sweep",),
    "envs.adapters": ("from_jax", "from_numpy", "from_step", "from_torch", "from_warp"),
    "envs.base": ("Environment", "Fidelity"),
    "envs.registry": ("as_environment", "make", "register"),
    "envs.remedies": ("average", "clip", "rescale", "shorten", "smooth", "soften"),
    "jobs.scene": ("SceneSpec",),
    "landscapes.episode": ("Episode",),
    "landscapes.objective": ("Evaluation", "Status"),
    "landscapes.plane": ("Plane",),
    "landscapes.slice": ("Slice",),
    "landscapes.space": ("ParameterSpace", "log"),
    "optim.race": ("Race",),
    "optim.runs.run": ("Run",),
}
_MODULES = ("testing",)
_FORMER = {"tradeoff": "study('fidelity', ...)", "extremes": "study('extremes', ...)"}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
__all__ = sorted([*_HOME_OF, "__version__"])


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f".{name}", __name__)
    if name in _FORMER:
        raise AttributeError(f"gradscape.{name} is now gradscape.{_FORMER[name]}")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'gradscape' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(f".{_HOME_OF[name]}", __name__), name)


def __dir__() -> list[str]:
    return [*__all__, *_MODULES]
