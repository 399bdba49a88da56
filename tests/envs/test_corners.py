"""Environments at the corners of their box, beyond it, and where no float32 goes; `benchmarks/corners.py` asks more."""

import pytest
from benchmarks.corners import GOOD, answers, small

from gradscape.envs.mjx.scene import MjxScene
from gradscape.envs.registry import entries

from .scenes import made_once, of_family


@pytest.mark.parametrize("name", entries())
def test_whatever_is_called_ok_is_finite_and_was_simulated_there(name: str) -> None:
    env = made_once(name) if name in of_family(MjxScene) else small(name)
    found = list(answers(env, outward=(0.0, 0.1, 1e39), most=2))
    assert not [answer for answer in found if answer.outcome not in GOOD]
