"""`gs.testing.assert_gradients` in somebody's tests: silent where gradients are right, a readable error where not."""

from __future__ import annotations

import re
from typing import Any

import jax.numpy as jnp
import pytest
import torch

import gradscape as gs
from gradscape.testing import assert_gradients

SPACE = gs.ParameterSpace({"a": (0, 1), "b": (0, 1)})


def bowl(x: Any) -> Any:
    """Return losses and gradients, which are half of the truth in 43 % of the box."""
    slope = 2 * (x - 0.2)
    slope[(x[:, 0] > 0.52) & (x[:, 0] < 0.95)] *= 0.5
    return ((x - 0.2) ** 2).sum(1), slope


def test_right_gradients_pass_in_silence_and_give_the_report(capsys: pytest.CaptureFixture[str]) -> None:
    report = assert_gradients(gs.from_torch(lambda x: (x**2).sum(1), SPACE, name="right"))
    assert report.passed
    assert report.command == "gradscape.testing.assert_gradients(right)"
    assert capsys.readouterr() == ("", "")


def test_a_wrong_region_is_said_with_interval_place_cause_and_remedy() -> None:
    with pytest.raises(AssertionError) as raised:
        gs.testing.assert_gradients(gs.from_numpy(bowl, SPACE, name="region"), power="10%", seed=1)
    first, cause, *_ = str(raised.value).splitlines()
    assert re.fullmatch(r"region fails its check: gradients are wrong at \d+ % \(\d+ to \d+ %\) of \d+ points", first)
    assert cause.startswith("- the gradient is 0.5 times the slope")
    assert re.search(r"\ba between 0\.5\d* and 0\.9\d*", cause)
    assert ". Try: Look for the factor 2" in cause


def test_a_nan_is_said_with_the_line_that_makes_it() -> None:
    def norm(p: Any) -> Any:
        return jnp.linalg.norm(p - 0.5) ** 2

    with pytest.raises(AssertionError, match=r"NaN at .*sqrt in line \d+ of test_testing.py .*Try: "):
        assert_gradients(gs.from_jax(norm, SPACE, name="norm"))


def test_a_promise_that_is_broken_is_said_by_its_check() -> None:
    def shifting(x: torch.Tensor) -> torch.Tensor:
        return (x**2).sum(1) + 1e-3 * torch.rand(len(x), dtype=x.dtype)

    with pytest.raises(AssertionError, match=r"(?m)^- \w[^:]*: "):
        assert_gradients(gs.from_torch(shifting, SPACE, name="shifting"))


def test_keywords_of_a_scene_are_taken_and_wrong_ones_refused() -> None:
    report = assert_gradients("branin", power=0.2, seed=3)
    assert (report.env, report.power, report.seed) == ("branin", 0.2, 3)
    with pytest.raises(ValueError, match="branin has fidelities exact"):
        assert_gradients("branin", fidelity="finest")
    with pytest.raises(ValueError, match="power"):
        assert_gradients("branin", power=2.0)
