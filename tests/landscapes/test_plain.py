"""Values as plain JSON, and the refusal of what JSON would not keep."""

import json

import numpy as np
import pytest
import torch

from gradscape.landscapes.plain import finite, jsonable, plain_json
from gradscape.landscapes.statistics import Estimate


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
