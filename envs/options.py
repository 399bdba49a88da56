"""Scene options: declared as a frozen dataclass, read from values or from the command line's text."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal, get_args, get_origin, get_type_hints


@dataclasses.dataclass(frozen=True)
class NoOptions:
    """The options of a scene that has none."""


def read_options(owner: str, declared: type[Any], given: Mapping[str, Any]) -> Any:
    """Return `declared` filled from `given`; values may be text.

    Raises ValueError where an option does not exist or a value is not of its type; `owner` says whose options they are.
    """
    hints = get_type_hints(declared)
    for name in given:
        if name not in hints:
            raise ValueError(f"{owner} has no option {name!r}; it has {describe(declared) or 'none'}")
    return declared(**{name: _read(owner, name, hints[name], value) for name, value in given.items()})


def describe(declared: type[Any]) -> str:
    """Return every option with what it takes and its default, as one line."""
    hints = get_type_hints(declared)
    return ", ".join(f"{f.name}={_wanted(hints[f.name])} (default {f.default})" for f in dataclasses.fields(declared))


def _read(owner: str, name: str, kind: Any, value: Any) -> Any:
    choices = get_args(kind) if get_origin(kind) is Literal else (True, False) if kind is bool else ()
    if choices:
        by_text = {str(choice).lower(): choice for choice in choices}
        if str(value).lower() in by_text:
            return by_text[str(value).lower()]
    else:
        try:
            return _number(kind, value)
        except (TypeError, ValueError, OverflowError):
            pass
    raise ValueError(f"{owner} option {name} takes {_wanted(kind)}; got {value!r}")


def _number(kind: Any, value: Any) -> Any:
    number = kind(value)
    if kind is float and not math.isfinite(number):
        raise ValueError("not finite")
    if kind is int and not isinstance(value, str) and number != value:
        raise ValueError("not whole")
    return number


def _wanted(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return "|".join(map(str, get_args(kind)))
    return {bool: "true|false", int: "a whole number", float: "a number"}.get(kind, str(kind))
