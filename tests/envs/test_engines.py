"""The engines of a scene agree: Taichi's was written apart, by atomic sums and the compiler's derivatives."""

from importlib.util import find_spec

import pytest
import torch

from gradscape.envs.base import Environment
from gradscape.envs.engines import ENGINES, Engine
from gradscape.envs.registry import entries, environment_class, make
from gradscape.landscapes.objective import Status
from gradscape.landscapes.space import ParameterSpace

from ..command import needs_taichi
from .numbers import moved, points_of
from .scenes import SETTINGS, SHORT, TAICHI, assert_returns_stay

pytestmark = [needs_taichi, pytest.mark.slow]


@pytest.fixture(scope="module", params=TAICHI)
def both(request):
    how = {**SETTINGS[request.param], "device": "cpu", **SHORT.get(request.param, {})}
    return tuple(make(request.param, engine=engine, **how) for engine in ("warp", "taichi"))


def test_losses_and_gradients_agree(both):
    warp, taichi = both
    x = points_of(warp, "compared")
    ours, theirs = (env.evaluate(x) for env in both)
    assert not moved(taichi, "compared", theirs)
    assert (ours.status == Status.OK).all()
    assert torch.equal(ours.status, theirs.status)
    torch.testing.assert_close(theirs.loss, ours.loss, rtol=1e-9, atol=0.0)
    scale = float(ours.grad.abs().max())
    torch.testing.assert_close(theirs.grad, ours.grad, rtol=1e-6, atol=1e-8 * scale)
    torch.testing.assert_close(taichi.evaluate(x, grad=False).loss, ours.loss, rtol=1e-9, atol=0.0)


def test_episodes_agree(both):
    x = both[0].space.uniform(1, seed=6)[0]
    ours, theirs = (env.episode(x) for env in both)
    assert ours.points.keys() == theirs.points.keys()
    for body, points in ours.points.items():
        torch.testing.assert_close(theirs.points[body], points, rtol=0.0, atol=1e-9)


def test_another_call_leaves_what_was_returned_as_it_was(both):
    assert_returns_stay(both[1])


def test_taichi_gets_one_thread_and_the_rows_of_all(both):
    warp, taichi = both
    assert taichi.threads == 1
    assert taichi.preferred_batch == warp.preferred_batch


def test_scenes_that_only_warp_has_refuse_taichi():
    for name in entries():
        kind = environment_class(name)
        if "taichi" not in kind.engines:
            with pytest.raises(ValueError, match=f"{name} has engine {kind.engines[0]}; got engine 'taichi'"):
                make(name, device="cpu", engine="taichi")


def test_every_engine_of_a_scene_is_known_and_has_its_solvers():
    for name in entries():
        for engine in environment_class(name).engines:
            assert ENGINES[engine].name == engine
    for engine in ENGINES.values():
        for module in engine.solvers.values():
            assert find_spec(f"gradscape.envs.engines.{module}") is not None


def test_a_scene_may_bring_an_engine_of_its_own():
    class Rod(Environment):
        engines = ("own",)
        space = ParameterSpace.box(["x"], 0.0, 1.0)

        def _evaluate(self, x, *, grad):
            raise NotImplementedError

    rod = Rod(engine="own", deterministic=True)
    assert (rod.capabilities, rod.threads) == (Engine("own"), 1)


def test_taichi_refuses_to_be_deterministic():
    with pytest.raises(ValueError, match="fluid is deterministic on engine warp only; got engine taichi"):
        make("fluid", device="cpu", engine="taichi", deterministic=True)


@pytest.mark.parametrize(("name", "known"), [("fluid", "scoop"), ("assembly", "demonstration")])
def test_drafts_agree_as_far_as_float32_does(name, known):
    """Over two fifths of an episode, when tools are at work: losses within 1e-4 and gradients within 1e-3."""
    ours, theirs = (make(name, device="cpu", engine=engine, horizon=0.4) for engine in ("warp", "taichi"))
    x = ours.example(known)[None]
    one, two = ours.evaluate(x), theirs.evaluate(x)
    assert one.grad.norm() > 0.01
    torch.testing.assert_close(two.loss, one.loss, rtol=1e-4, atol=0.0)
    assert (two.grad - one.grad).norm() < 1e-3 * one.grad.norm()
