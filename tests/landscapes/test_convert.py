"""Records come back from JSON as they were, and what is no such record is refused."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar, Literal

import pytest

from gradscape.landscapes.convert import from_json, to_json


class Side(StrEnum):
    LEFT = "left"
    RIGHT = "right"


@dataclass(frozen=True)
class Part:
    value: float
    error: float | None
    side: Side
    kind: Literal["slice", "run"] = "slice"


@dataclass(frozen=True)
class Whole:
    derived: ClassVar = ("count",)

    name: str
    parts: tuple[Part, ...]
    base: tuple[float, float]
    options: dict[str, Any]
    failed: bool = False

    @property
    def count(self) -> int:
        return len(self.parts)


WHOLE = Whole("rope", (Part(1.5, None, Side.LEFT), Part(2, 0.25, Side.RIGHT, "run")), (1, 2), {"a": [1, "x"]})


def test_a_record_comes_back_from_json() -> None:
    data = json.loads(json.dumps(to_json(WHOLE)))
    assert data["count"] == 2
    assert from_json(Whole, data) == WHOLE


def test_what_is_not_finite_is_none_in_json_and_nan_in_a_record() -> None:
    data = to_json(Part(math.nan, math.inf, Side.LEFT))
    assert data["value"] is data["error"] is None
    assert math.isnan(from_json(Part, data).value)
    assert from_json(Part, data).error is None


@pytest.mark.parametrize(
    "changed",
    [{"name": 3}, {"parts": 3}, {"base": [1]}, {"base": ["1", 2]}, {"failed": "yes"}, {"options": []}]
    + [{"parts": [to_json(WHOLE.parts[0]) | one]} for one in ({"side": "top"}, {"kind": "race"}, {"value": "1"})],
)
def test_what_is_no_record_is_refused(changed: dict[str, Any]) -> None:
    with pytest.raises(Exception, match=r".+"):
        from_json(Whole, to_json(WHOLE) | changed)


def test_a_record_without_a_field_is_refused() -> None:
    with pytest.raises(KeyError, match="name"):
        from_json(Whole, {key: value for key, value in to_json(WHOLE).items() if key != "name"})
