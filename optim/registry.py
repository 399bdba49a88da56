"""Find optimisers by name; import each only when it is made.

Another package registers its own optimiser by an entry point of the group `gradscape.optimizers`:

    [project.entry-points."gradscape.optimizers"]
    my-search = "my_package.search:MySearch"

The class derives from `gradscape.optim.base.Optimizer`, and its `name` is that of the entry point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

from ..landscapes import registry

if TYPE_CHECKING:
    from .base import Optimizer

GROUP = "gradscape.optimizers"
ALL = "all"  # methods that can search an environment here


@dataclass(frozen=True)
class Method:
    """Describe an optimiser without importing it; `target` is "module:Class", `extra` the extra it needs."""

    name: str
    target: str
    summary: str
    extra: str = ""


def _own(name: str, target: str, summary: str, extra: str = "") -> Method:
    return Method(name, f"gradscape.optim.methods.{target}", summary, extra)


BUILTIN = (
    _own("random", "random:RandomSearch", "points drawn uniformly from the box"),
    _own("cma-es", "cmaes:CMAES", "covariance matrix adaptation, restarted after convergence"),
    _own("descents", "descent:Descents", "gradient descents from random starts"),
    _own("bo", "bayes:BO", "Bayesian optimisation: the lower confidence bound of a Gaussian process"),
    _own("bo-descents", "bayes:BODescents", "Bayesian optimisation proposes, gradient descent refines"),
    _own("bo-leap", "bo_leap:BOLeap", "BO-Leap: Bayesian optimisation, then leaps of populations and descents"),
    _own("l-bfgs-b", "quasi_newton:LBFGSB", "L-BFGS-B from random starts"),
    _own("basin-hopping", "quasi_newton:BasinHopping", "basin hopping: L-BFGS-B and random hops between minima"),
    _own("adam", "descent:Adam", "Adam from random starts"),
    _own("cma-es-gradient", "cmaes:CMAESGradient", "CMA-ES that injects a gradient step from its mean"),
    _own(
        "turbo", "bayes:TuRBO", "TuRBO-1: Bayesian optimisation in a trust region, restarted when the region has shrunk"
    ),
    _own(
        "continuation",
        "continuation:Continuation",
        "descents on a smoothed loss, from strong to weak smoothing, then L-BFGS-B",
    ),
    _own("bo-gradient", "bayes:BOGradient", "Bayesian optimisation by a Gaussian process of losses and gradients"),
    _own("auto", "auto:Auto", "measures the landscape, then uses the method advised for such landscapes"),
    _own("ppo", "policy:PPO", "proximal policy optimisation of a neural policy", "rl"),
    _own("sac", "policy:SAC", "soft actor-critic for a neural policy", "rl"),
)


@cache
def methods() -> dict[str, Method]:
    """Return every registered optimiser by name, ours before those of other packages.

    Raises ValueError where two have the same name.
    """
    return registry.collect(BUILTIN, GROUP, "method", Method)


def find_method(name: str) -> Method:
    """Return the method registered by a name. Raises ValueError, with all names, for an unknown one."""
    return registry.find(methods(), name, "method", f"the methods are {', '.join(methods())}")


def check_methods(names: Sequence[str]) -> list[str]:
    """Return methods without repetitions, none for `all`. Raises ValueError where one is not registered."""
    found = [find_method(name).name for name in dict.fromkeys(names) if name != ALL]
    return [] if ALL in names else found


def optimizer_class(name: str) -> type[Optimizer]:
    """Import and return the class of a method.

    Raises ValueError for an unknown name, where its extra is not installed, and where another package's entry point
    leads nowhere or to an optimiser with another name.
    """
    method = find_method(name)
    try:
        kind: type[Optimizer] = registry.load(name, method.target)
    except ValueError as error:
        if method.extra:
            install = f"pip install '.[{method.extra}]' in gradscape's sources"
            raise ValueError(f"{name} needs the extra {method.extra}: {install} ({error.__cause__})") from error
        raise
    if getattr(kind, "name", None) != name:
        raise ValueError(
            f"{name} is registered as {method.target}, whose name is {getattr(kind, 'name', None)!r}; give entry "
            "point and class the same name"
        )
    return kind
