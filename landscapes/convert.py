"""Convert records to JSON and back: a dataclass declares the fields of a record once, and a library converts them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from typing import TYPE_CHECKING, Any, Final, TypeVar

from .plain import jsonable

if TYPE_CHECKING:
    from cattrs import Converter

Record = TypeVar("Record")
NOT_JSON: Final = {"json": False}  # the metadata of a field that JSON leaves out; it needs a default


def to_json(record: Any) -> Any:
    """Return a record in JSON form, at any depth; see `from_json`.

    Dataclasses become dicts of their fields, except fields with the metadata `NOT_JSON`. After these come the
    properties that their class names in `derived`, which are only for readers. NaN and infinity become None; arrays,
    tensors and tuples become lists. Raises TypeError for values without a JSON form.
    """
    return jsonable(record)


def from_json(kind: type[Record], data: Any) -> Record:
    """Return a record of a class from a result of `to_json`.

    The field types of the class are the only schema, so they are imported where the class is defined, not under
    TYPE_CHECKING. None becomes NaN for number fields; unknown fields are ignored. Raises any kind of error for other
    input; `storage.records.reading` names the damaged file.
    """
    return _converter().structure(data, kind)


@cache
def _converter() -> Converter:
    """Return a converter that never turns one type into another: no text into a number, no number into text."""
    from cattrs import Converter

    converter = Converter(detailed_validation=False)
    converter.register_structure_hook_factory(is_dataclass, lambda kind: _reader(kind, converter))
    for kind, read in ((float, _number), (int, _integer), (str, _exactly), (bool, _exactly)):
        converter.register_structure_hook(kind, read)
    return converter


def _reader(kind: type[Any], converter: Converter) -> Callable[[Any, Any], Any]:
    from cattrs.gen import make_dict_structure_fn, override

    left_out: Any = {one.name: override(omit=True) for one in fields(kind) if not one.metadata.get("json", True)}
    return make_dict_structure_fn(kind, converter, **left_out)


def _number(value: Any, _: object) -> float:
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError(f"{value!r} is no number")
    return float(value)


def _integer(value: Any, _: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float) or value != int(value):
        raise TypeError(f"{value!r} is no whole number")
    return int(value)


def _exactly(value: Any, kind: type[Any]) -> Any:
    if issubclass(kind, Enum):
        return kind(value)
    if not isinstance(value, kind):
        raise TypeError(f"{value!r} is no {'text' if kind is str else 'yes or no'}")
    return value


def to_attribute(name: str, record: Any) -> dict[str, str]:
    """Return the text of the attribute in which a slice stores a record."""
    return {name: json.dumps(to_json(record))}


def from_attribute(kind: type[Record], attributes: Mapping[Any, Any], name: str) -> Record | None:
    """Read a record from a slice's attributes, None where there is no such attribute or record."""
    try:
        return from_json(kind, json.loads(attributes[name]))
    except Exception:  # text of any content makes the converter raise anything at all
        return None
