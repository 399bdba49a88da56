"""Which methods search an environment here: those that are named, or all that can."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..optim.registry import find_method, methods
from .search import make_optimizer
from .watch import Watch

if TYPE_CHECKING:
    from ..envs.base import Environment

ALL = "all"  # methods that can search an environment here


def able_methods(env: Environment, watch: Watch) -> list[str]:
    """Return the methods that can search an environment here, and say of the others why they cannot."""
    able = []
    for method in methods():
        try:
            make_optimizer(method, env)
        except ValueError as error:
            watch.note(f"without {method}: {error}")
        else:
            able.append(method)
    return able


def check_methods(names: Sequence[str]) -> list[str]:
    """Return methods without repetitions, none for `all`. Raises ValueError where one is not registered."""
    found = [find_method(name).name for name in dict.fromkeys(names) if name != ALL]
    return [] if ALL in names else found
