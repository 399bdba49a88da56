"""Numbers of every scene are those of its model's version, at draft.

`test_contract` holds those of every scene at its cheapest in float64, `test_engines` those of Taichi: what these
evaluate anyway.
"""

from dataclasses import replace

import pytest
import torch

from gradscape.envs.base import Environment
from gradscape.envs.mjx.scene import MjxScene
from gradscape.envs.registry import environment_class, make
from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.space import ParameterSpace

from .numbers import moved, points_of, stored
from .scenes import REGISTERED, TAICHI, one_of_each

DRAFTS = [name for name in REGISTERED if not issubclass(environment_class(name), MjxScene)]


@pytest.mark.parametrize("name", one_of_each(DRAFTS))
def test_drafts_are_those_of_the_model_version(name):
    assert not moved(make(name, device="cpu"), "draft")


def test_every_scene_has_numbers_of_its_version_on_every_engine_and_of_no_later_one():
    assert stored().keys() == set(REGISTERED)
    for name, versions in stored().items():
        kind = environment_class(name)
        latest = {engine: kind.version_on(engine) for engine in kind.engines}
        assert max(map(int, versions)) == max(latest.values())
        wanted = {f"{kind.engines[0]} tiny"}
        wanted |= {f"{kind.engines[0]} draft"} if name in DRAFTS else set()
        assert wanted <= versions[str(latest[kind.engines[0]])].keys()
        if name in TAICHI:
            assert "taichi compared" in versions[str(latest["taichi"])]


@pytest.fixture
def bounce():
    return make("bounce", device="cpu")


@pytest.mark.parametrize("kind", ["loss", "slope"])
def test_numbers_that_moved_are_named_with_both(bounce, kind):
    kept = stored()["bounce"]["1"]["warp draft"]
    found = bounce.evaluate(points_of(bounce, "draft"))
    assert not moved(bounce, "draft", found)
    share = 1 + 1e-3
    other = replace(found, loss=found.loss * share) if kind == "loss" else replace(found, grad=found.grad * share)
    said = moved(bounce, "draft", other)
    assert said.startswith(f"numbers of bounce moved ({kind} ")
    assert said.endswith("raise model_version or revert")
    values = kept.kinds[kind].flatten()
    assert any(f"{float(one):.6g} stored, {float(one * share):.6g} now" in said for one in values)


class Spring(Environment):
    """A leaf whose engines are of different versions."""

    space = ParameterSpace.box(["x"], 0.0, 1.0)
    engines = ("warp", "taichi", "own")
    model_version = {"warp": 3, "taichi": 2}  # noqa: RUF012 -- as a scene says it

    def _evaluate(self, x: torch.Tensor, *, grad: bool) -> Evaluation:
        return Evaluation.from_results(x[:, 0] ** 2, 2 * x)


def test_a_version_may_be_of_an_engine_and_is_in_the_identity():
    assert [Spring.version_on(engine) for engine in Spring.engines] == [3, 2, 1]
    found = Spring(engine="taichi", device="cpu").identity()
    assert found["model_version"] == 2
    assert "code" not in found
