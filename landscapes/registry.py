"""Find things by name: ours, and those that other packages register by entry points. Listing imports nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Protocol, TypeVar


class Registered(Protocol):
    """Something with a name, and its location: mostly "module:Class"."""

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def target(self) -> Any:
        """Its location."""


Entry = TypeVar("Entry", bound=Registered)


def collect(
    builtin: Iterable[Entry], group: str, kind: str, make: Callable[[str, str, str], Entry]
) -> dict[str, Entry]:
    """Return entries by name, ours before those of a group of entry points.

    `make` takes the name and the target of one of these, and the package that registers it. Raises ValueError where two
    of a `kind` have the same name.
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

    Raises ValueError, with a similar name and the sentence `there`, for an unknown one.
    """
    if name not in known:
        close = get_close_matches(name, known, n=1)
        raise ValueError(f"no {kind} is called {name!r}{f'; did you mean {close[0]}?' if close else ';'} {there}")
    return known[name]


def load(name: str, target: str, import_named: Callable[[str], Any] = import_module) -> Any:
    """Import the target registered under a name. Raises ValueError where its module or its attribute does not exist."""
    module, _, attribute = target.rpartition(":")
    try:
        return getattr(import_named(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{name} is registered as {target}, which cannot be imported: {error}") from error
