"""Which methods search an environment here: those that are named, or all that can."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..optim.memory import SearchSize, require_method, require_runs
from ..optim.registry import find_method, methods
from .watch import Watch

if TYPE_CHECKING:
    from ..envs.base import Environment

ALL = "all"  # methods that can search an environment here


def able_methods(env: Environment, watch: Watch) -> list[str]:
    """Return the methods that can search an environment here, and say of the others why they cannot."""
    able, unable = divide_methods(env)
    for method, why in unable.items():
        watch.note(f"without {method}: {why}")
    return able


def divide_methods(env: Environment, names: Sequence[str] = (), *, budget: int = 0) -> tuple[list[str], dict[str, str]]:
    """Return which methods, by default of all, can search an environment here, and why the others cannot."""
    from .search import make_optimizer

    able, unable = list[str](), dict[str, str]()
    for method in names or methods():
        try:
            made = make_optimizer(method, env)
            require_method(type(made), made.options, SearchSize(env.space.dim, env.decisions, budget))
        except ValueError as error:
            unable[method] = " ".join(str(error).split())
        else:
            able.append(method)
    return able, unable


def check_methods(names: Sequence[str]) -> list[str]:
    """Return methods without repetitions, none for `all`. Raises ValueError where one is not registered."""
    found = [find_method(name).name for name in dict.fromkeys(names) if name != ALL]
    return [] if ALL in names else found


def require_room(
    env: Environment,
    methods: Sequence[str],
    options: Mapping[str, Mapping[str, Any]],
    *,
    seeds: int,
    budget: int,
    folder: Path,
) -> None:
    """Raise TooLargeError where a race of these methods, with these options by method, is larger than this machine."""
    from .search import make_optimizer

    require_runs(env.space.dim, budget, seeds, folder, abreast=len(methods))
    for method in methods:
        optimizer = make_optimizer(method, env, options=options.get(method))
        require_method(type(optimizer), optimizer.options, SearchSize(env.space.dim, env.decisions, budget))
