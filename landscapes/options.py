"""Options of scenes and methods: a frozen dataclass declares them, values or the command line's text fill it."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Mapping
from typing import Any, Literal, get_args, get_origin, get_type_hints

ADDED = "added"  # in a field's metadata


@dataclasses.dataclass(frozen=True)
class NoOptions:
    """No options."""


def read_options(owner: str, declared: type[Any], given: Mapping[str, Any]) -> Any:
    """Return `declared` filled from `given`; values can be text.

    Raises ValueError where an option does not exist or a value has another type; `owner` names whose options they are.
    """
    known = _list_options(declared)
    for name in given:
        if name not in known:
            raise ValueError(f"{owner} has no option {name!r}; it has {describe(declared) or 'none'}")
    return declared(**{name: _read(owner, known[name], value) for name, value in given.items()})


def record_options(options: Any) -> dict[str, Any]:
    """Return options by name, as identities store them.

    An option that was added later has the metadata ADDED in its field. It is left out while it has its default, because
    earlier results lack it and are the same.
    """
    later = [f for f in dataclasses.fields(options) if f.metadata.get(ADDED)]
    left = {f.name for f in later if getattr(options, f.name) == f.default}
    return {name: value for name, value in dataclasses.asdict(options).items() if name not in left}


def added(default: Any, **metadata: Any) -> Any:
    """Declare an option that earlier results lack: its default is the setting they were made with."""
    return dataclasses.field(default=default, metadata={ADDED: True, **metadata})


def describe(declared: type[Any]) -> str:
    """Return every option with its values and its default, as one line."""
    return ", ".join(f"{o.name}={o.wanted} (default {o.default})" for o in _list_options(declared).values())


def in_full(declared: type[Any]) -> str:
    """Return every option on its own line, then their meaning, from the docstrings of all declaring classes."""
    known = _list_options(declared).values()
    if not known:
        return "options: none"
    lines = "\n".join(f"  {option.name}={option.wanted} (default {option.default})" for option in known)
    return f"options:\n{lines}\n\n{_explain(declared)}".rstrip()


def _explain(declared: type[Any]) -> str:
    """Return the docstrings of a class and its base classes, without those that dataclasses generate."""
    docs = [(kind.__name__, kind.__doc__ or "") for kind in declared.__mro__ if dataclasses.is_dataclass(kind)]
    return "\n\n".join(inspect.cleandoc(doc) for name, doc in docs if doc and not doc.startswith(f"{name}("))


@dataclasses.dataclass(frozen=True)
class _Option:
    """A declared option; a number with a `most` is above 0."""

    name: str
    kind: Any
    default: Any
    most: float | None

    @property
    def wanted(self) -> str:
        if get_origin(self.kind) is Literal:
            return "|".join(map(str, get_args(self.kind)))
        names = {bool: "true|false", int: "a whole number", float: "a number", str: "a word"}
        return names.get(self.kind, str(self.kind)) + (f" above 0, at most {self.most:g}" if self.most else "")


def _list_options(declared: type[Any]) -> dict[str, _Option]:
    hints = get_type_hints(declared)
    own_first = sorted(dataclasses.fields(declared), key=lambda field: bool(field.kw_only))
    return {f.name: _Option(f.name, hints[f.name], f.default, f.metadata.get("most")) for f in own_first}


def _read(owner: str, option: _Option, value: Any) -> Any:
    kind = option.kind
    choices = get_args(kind) if get_origin(kind) is Literal else (True, False) if kind is bool else ()
    if choices:
        by_text = {str(choice).lower(): choice for choice in choices}
        if str(value).lower() in by_text:
            return by_text[str(value).lower()]
    else:
        try:
            return _number(kind, value, option.most)
        except (TypeError, ValueError, OverflowError):
            pass
    raise ValueError(f"{owner} option {option.name} takes {option.wanted}; got {value!r}")


def _number(kind: Any, value: Any, most: float | None) -> Any:
    number = kind(value)
    if most is not None and not 0 < number <= most:
        raise ValueError("out of range")
    if kind is float and not math.isfinite(number):
        raise ValueError("not finite")
    if kind is int and not isinstance(value, str) and number != value:
        raise ValueError("not whole")
    return number
