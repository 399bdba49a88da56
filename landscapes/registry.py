"""What is found by name: ours, and what other packages register by entry points. Nothing is imported to list it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Protocol, TypeVar


class Registered(Protocol):
    """Something with a name, and where it is: mostly "module:Class"."""

    @property
    def name(self) -> str:
        """What it is called."""

    @property
    def target(self) -> Any:
        """Where it is."""


Entry = TypeVar("Entry", bound=Registered)


def collect(
    builtin: Iterable[Entry], group: str, kind: str, make: Callable[[str, str, str], Entry]
) -> dict[str, Entry]:
    """Return entries by name, ours before those of a group of entry points.

    `make` takes the name and the target of one of these, and by whom it is registered. Raises ValueError where two of a
    `kind` have the same name.
    """
    found = {entry.name: entry for entry in builtin}
    for point in entry_points(group=group):
        if point.name in found:
            raise ValueError(
                f"two {kind}s are called {point.name!r}: {found[point.name].target} and {point.value}; "
                "uninstall one of the packages or rename its entry point"
            )
        package = point.dist.name if point.dist else "another package"
        found[point.name] = make(point.name, point.value, f"registered by {package}")
    return found


def find(known: Mapping[str, Entry], name: str, kind: str, there: str) -> Entry:
    """Return the entry of a name.

    Raises ValueError, with a name that comes close and a sentence about what is `there`, where nothing has it.
    """
    if name not in known:
        close = get_close_matches(name, known, n=1)
        raise ValueError(f"no {kind} is called {name!r}{f'; did you mean {close[0]}?' if close else ';'} {there}")
    return known[name]


def load(name: str, target: str, import_named: Callable[[str], Any] = import_module) -> Any:
    """Import what is registered under a name. Raises ValueError where its module or its attribute is not there."""
    module, _, attribute = target.rpartition(":")
    try:
        return getattr(import_named(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{name} is registered as {target}, which cannot be imported: {error}") from error
