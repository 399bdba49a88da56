"""Values as plain JSON and plain text: the allowed content of records, names and terminals."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

# What a terminal obeys and does not show, but for tabs and line ends; and what turns the direction of writing.
CONTROL = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """Return text for a terminal: a control character becomes its escape, as in Python's strings."""
    return CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def finite(value: float) -> float | None:
    """Return a number in JSON form: None for NaN and infinity."""
    return float(value) if math.isfinite(value) else None


def jsonable(value: Any) -> Any:
    """Return a value in JSON form, at any depth.

    NaN and infinity become None; arrays, tensors and tuples become lists, numbers of numpy those of Python. An object
    with a `record` becomes the result of that. Any other dataclass becomes its fields, and the properties that it names
    in `derived`. Raises TypeError for anything else.
    """
    if callable(record := getattr(value, "record", None)):
        return jsonable(record())
    if is_dataclass(value):
        names = [*(one.name for one in fields(value) if one.metadata.get("json", True)), *getattr(value, "derived", ())]
        return {name: jsonable(getattr(value, name)) for name in names}
    if isinstance(value, Mapping):
        return {name: jsonable(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(inner) for inner in value]
    if hasattr(value, "tolist"):
        return jsonable(value.tolist())
    if isinstance(value, float):
        return finite(value)
    if value is None or isinstance(value, str | int):
        return value
    raise TypeError(f"{type(value).__name__} has no form in JSON; give numbers, strings, lists or dicts")


def plain_json(settings: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Return settings exactly as they come back from JSON: tuples are lists, keys are strings.

    Raises ValueError, naming `what` they are, where JSON would change them: NaN and infinity are refused, too.
    """
    try:
        found: dict[str, Any] = json.loads(json.dumps(settings, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} must be plain JSON (numbers, strings, lists, dicts): {error}") from None
    return found


def text(value: Any) -> str:
    """Return a string unchanged.

    Raises TypeError for anything else.
    """
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no text")
    return value


def number(value: Any) -> float:
    """Return a finite number unchanged.

    Raises TypeError for anything else.
    """
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError(f"{value!r} is no number")
    return value


def read_share(text: str) -> float:
    """Return a share given as 5% or 0.05. Raises ValueError for another form."""
    text = text.strip()
    return float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)


def plain_name(text: str) -> str:
    """Return a name of letters, digits, dots, dashes and underscores, for recordings and folders."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", text).strip("-.") or "points"


def digest(settings: Any) -> str:
    """Return six digits that are the same for the same settings, which are plain JSON."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:6]
