"""Values and records as plain JSON and back; what JSON would not keep, or is no such record, is refused."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar, Literal

import numpy as np
import pytest
import torch

from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.plain import finite, jsonable, plain_json
from gradscape.landscapes.statistics import Estimate


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
    with pytest.raises(KeyError, match="name"):
        from_json(Whole, {key: value for key, value in data.items() if key != "name"})
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


def test_whatever_is_measured_becomes_strict_json():
    found = {
        "nan": float("nan"),
        "pair": (np.float32(0.5), np.int64(3)),
        "array": np.array([[1.0, np.inf]]),
        "tensor": torch.tensor([1, 2]),
        "estimate": Estimate(1.0, float("-inf"), 2.0),
        "flag": np.True_,
        "whole": 4,
    }
    wanted = {
        "nan": None,
        "pair": [0.5, 3],
        "array": [[1.0, None]],
        "tensor": [1, 2],
        "estimate": {"value": 1.0, "low": None, "high": 2.0},
        "flag": True,
        "whole": 4,
    }
    assert jsonable(found) == wanted
    assert json.loads(json.dumps(jsonable(found), allow_nan=False)) == wanted
    assert isinstance(jsonable(4), int)
    assert finite(float("inf")) is None


def test_what_json_does_not_know_is_refused():
    with pytest.raises(TypeError, match="set has no form in JSON"):
        jsonable({"a": {1, 2}})
    with pytest.raises(ValueError, match="a run's identity must be plain JSON"):
        plain_json({"a": float("nan")}, "a run's identity")
    assert plain_json({"a": (1, 2)}, "settings") == {"a": [1, 2]}
