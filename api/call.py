"""How a public function was called: the command that is kept with its results, and who watches it work."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast, get_args

from cyclopts import Parameter
from cyclopts.validators import Number

from ..jobs.watch import Watch

Given = ParamSpec("Given")
Result = TypeVar("Result")

RENAMED = {  # keywords of earlier versions, and today's
    "also": "second_fidelity",
    "extent": "window",
    "prints": "figure_width_mm",
}


@dataclass(frozen=True)
class Call:
    """Record the command that makes a result again, and the watch that shows its progress.

    Your own function is sampled in memory unless its results go `on_disk`.
    """

    command: str
    watch: Watch
    on_disk: bool = False


_CURRENT: ContextVar[Call | None] = ContextVar("call", default=None)


def current() -> Call:
    """Return the call under way."""
    return _CURRENT.get() or Call("", Watch())


@contextmanager
def calling(call: Call) -> Iterator[None]:
    """Let the public functions that are called within this context work for one call."""
    token = _CURRENT.set(call)
    try:
        yield
    finally:
        _CURRENT.reset(token)


def verb(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Make a function one of the public ones: its signature and docstring declare a verb of the command, too.

    A call from Python is kept with its results as it was written. It shows bars in a notebook or a terminal.
    """

    @wraps(function)
    def call(*given: Given.args, **named: Given.kwargs) -> Result:
        if old := next((name for name in named if name in RENAMED), None):
            raise ValueError(f"{function.__name__} now takes {RENAMED[old]}=; got {old}=")
        _check_numbers(function, given, named)
        if _CURRENT.get() is not None:
            return function(*given, **named)
        from .progress import default_watch

        words = [*map(_written, given), *(f"{name}={_written(value)}" for name, value in named.items())]
        with calling(Call(f"gradscape.{function.__name__}({', '.join(words)})", default_watch())):
            return function(*given, **named)

    return call


def hint_of(function: Callable[..., object] | None, written: Any) -> Any:
    """Return the type of a parameter from its annotation, Any where only type checkers know its name."""
    try:
        return eval(written, vars(import_module(str(function.__module__))))
    except NameError:
        return Any


def _check_numbers(function: Callable[..., object], given: tuple[object, ...], named: dict[str, Any]) -> None:
    """Raise ValueError for a number that is outside the limits in the function's signature, or that is not whole."""
    slots = signature(function).parameters
    for name, value in (dict(zip(slots, given, strict=False)) | named).items():
        if name in slots and isinstance(value, int | float) and not isinstance(value, bool):
            wanted = _wanted(name, value, hint_of(function, slots[name].annotation))
            if wanted:
                raise ValueError(f"{function.__name__} takes {wanted}; got {value}")


def _wanted(name: str, value: float, hint: Any) -> str:
    """Describe the number that a parameter takes, by its type and limits; empty if `value` is one."""
    kind, *marks = get_args(hint) if hasattr(hint, "__metadata__") else (hint,)
    if int in (kind, *get_args(kind)) and isinstance(value, float) and not value.is_integer():
        return f"a whole number for {name}"
    for mark in (one for one in marks if isinstance(one, Parameter)):
        for limit in (one for one in cast("tuple[object, ...]", mark.validator) if isinstance(one, Number)):
            try:
                limit(type(value), value)
            except ValueError as error:
                return f"{name} {str(error).removeprefix('Must be ').rstrip('.')}"
    return ""


def _written(value: object) -> str:
    """Return a value as one writes it in Python: simulators, slices and runs by their names."""
    if isinstance(value, Path):
        return repr(str(value))
    if isinstance(value, type):
        return value.__name__
    if isinstance(value, list | tuple):
        ends = "[]" if isinstance(value, list) else "()"
        comma = "," if len(value) == 1 and isinstance(value, tuple) else ""
        return f"{ends[0]}{', '.join(map(_written, value))}{comma}{ends[1]}"
    if hasattr(value, "tolist"):
        return repr(value.tolist())
    name = getattr(value, "name", getattr(value, "folder", None))
    return repr(value) if name is None or isinstance(value, str) else str(name)
