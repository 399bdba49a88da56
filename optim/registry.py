"""Find optimisers by name; import them only when one is made."""

from __future__ import annotations

import hashlib
import sys
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .base import Optimizer


@dataclass(frozen=True)
class Method:
    """Say what an optimiser is without importing it; `target` is "module:Class", `extra` what must be installed."""

    name: str
    target: str
    summary: str
    extra: str = ""


BUILTIN = (
    Method("random", "random:RandomSearch", "points drawn uniformly from the box"),
    Method("cma-es", "cmaes:CMAES", "covariance matrix adaptation, restarted when it has converged"),
    Method("descents", "descent:Descents", "gradient descents from random starts"),
    Method("bo", "bayes:BO", "Bayesian optimisation: the lower confidence bound of a Gaussian process"),
    Method("bo-descents", "bayes:BODescents", "Bayesian optimisation proposes, gradient descent refines"),
    Method("bo-leap", "bo_leap:BOLeap", "BO-Leap: Bayesian optimisation, then leaps of populations and descents"),
    Method("ppo", "policy:PPO", "proximal policy optimisation of a neural policy", "rl"),
    Method("sac", "policy:SAC", "soft actor-critic for a neural policy", "rl"),
)
METHODS = {method.name: method for method in BUILTIN}


def optimizer_class(name: str) -> type[Optimizer]:
    """Import and return the class of a method."""
    if name not in METHODS:
        close = get_close_matches(name, METHODS, n=1)
        hint = f"; did you mean {close[0]}?" if close else ";"
        raise ValueError(f"no method is called {name!r}{hint} there are {', '.join(METHODS)}")
    method = METHODS[name]
    module, _, attribute = method.target.partition(":")
    try:
        found: type[Optimizer] = getattr(import_module(f".{module}", __package__), attribute)
    except ImportError as error:
        if not method.extra:
            raise
        raise ValueError(
            f"{name} needs the extra {method.extra}: pip install '.[{method.extra}]' in gradscape's sources ({error})"
        ) from error
    return found


def code_digest(kind: type[Optimizer]) -> str:
    """Return a digest of the code a method's points come from: its module, and those of this folder it draws on."""
    found: set[str] = set()
    left = [kind.__module__]
    while left:
        name = left.pop()
        if name not in found:
            found.add(name)
            used = {getattr(value, "__module__", None) or "" for value in vars(sys.modules[name]).values()}
            left += [other for other in used if other.startswith(f"{__package__}.")]
    files = sorted(Path(str(sys.modules[name].__file__)) for name in found)
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]
