"""The engines of a scene agree: Taichi's was written apart, by atomic sums and the compiler's derivatives."""

from importlib.util import find_spec

import pytest
import torch

from gradscape.envs.base import Fidelity
from gradscape.envs.mpm.fluid import SPAN
from gradscape.envs.mpm.plasticine_model import SPAN as SOFT_SPAN
from gradscape.envs.registry import entries, environment_class, make
from gradscape.landscapes.objective import Status

pytestmark = pytest.mark.skipif(find_spec("taichi") is None, reason="Taichi has no wheel for this machine")

SHEET = Fidelity("tiny", dt=1 / 500, precision="float64", resolution=4)
TINY = {
    "fluid": Fidelity("tiny", dt=SPAN / 2, precision="float64", resolution=6, sampling=1.5),
    "rolling-pin": Fidelity("tiny", dt=SOFT_SPAN / 5, precision="float64", resolution=16, particles=100),
    **dict.fromkeys(("swing-velocity", "swing-stiffness", "flip"), SHEET),
}


SHORT = {"rolling-pin": {"horizon": 0.4}}


@pytest.fixture(scope="module", params=TINY)
def both(request):
    how = {"fidelity": TINY[request.param], "device": "cpu", **SHORT.get(request.param, {})}
    return tuple(make(request.param, engine=engine, **how) for engine in ("warp", "taichi"))


def test_losses_and_gradients_agree(both):
    warp, taichi = both
    x = warp.space.uniform(3, seed=5)
    ours, theirs = (env.evaluate(x) for env in both)
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


def test_taichi_gets_one_thread_and_the_rows_of_all(both):
    warp, taichi = both
    assert taichi.threads == 1
    assert taichi.preferred_batch == warp.preferred_batch


def test_scenes_that_only_warp_has_refuse_taichi():
    for name in entries():
        kind = environment_class(name)
        if "taichi" not in kind.engines:
            with pytest.raises(ValueError, match=f"{name} has engine warp; got engine 'taichi'"):
                make(name, device="cpu", engine="taichi")


def test_taichi_refuses_to_be_deterministic():
    with pytest.raises(ValueError, match="fluid is deterministic on engine warp only; got engine taichi"):
        make("fluid", device="cpu", engine="taichi", deterministic=True)


@pytest.mark.parametrize(("name", "known"), [("fluid", "scoop"), ("assembly", "demonstration")])
def test_drafts_agree_as_far_as_float32_does(name, known):
    """Losses within 1e-3 and gradients within 1e-2 (here 7e-5 and 1e-4 at most)."""
    ours, theirs = (make(name, device="cpu", engine=engine) for engine in ("warp", "taichi"))
    x = ours.example(known)[None]
    one, two = ours.evaluate(x), theirs.evaluate(x)
    torch.testing.assert_close(two.loss, one.loss, rtol=1e-3, atol=0.0)
    assert (two.grad - one.grad).norm() < 1e-2 * one.grad.norm()
