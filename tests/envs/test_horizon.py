"""The horizon: episodes that end earlier or later, and are otherwise the same."""

import pytest
import torch

from gradscape.envs.mpm.fluid import EASING
from gradscape.envs.registry import environment_class, make

from .scenes import REGISTERED, SETTINGS, SMALL_STEPS, SOFT
from .test_contract import refusal

ENGINES = ("bounce", "cartpole", "flip", "fluid", "pinball-2", "pinch")  # a scene each
CONTROLLED = ("cartpole", "flip", "fluid", "rolling-pin", "rope")


def made(name, **options):
    return make(name, device="cpu", **SETTINGS[name], **options)


def points(env, rows=2):
    return env.space.uniform(rows, seed=11)


def moving(episode):
    """Return all that an episode says of where things are, frame by frame."""
    return [*episode.points.values(), *episode.tools.values()]


@pytest.fixture(scope="module", params=ENGINES)
def name(request):
    return request.param


def test_every_simulated_scene_has_the_option_and_no_function_has():
    timed = {name for name in REGISTERED if hasattr(environment_class(name).Options(), "horizon")}
    assert timed == set(SETTINGS)


@pytest.mark.parametrize("scene", sorted({*ENGINES, *CONTROLLED, "pinball-16", "swing-velocity"}))
def test_horizon_1_is_the_scene_itself_to_the_bit(scene):
    usual, whole, half = made(scene), made(scene, horizon=1), made(scene, horizon=0.5)
    x = points(usual)
    wanted, found = usual.evaluate(x), whole.evaluate(x)
    assert torch.equal(found.loss, wanted.loss)
    assert torch.equal(found.grad, wanted.grad)
    assert bool((half.evaluate(x, grad=False).loss != wanted.loss).all())
    episodes = usual.episode(x[0]), whole.episode(x[0])
    for one, other in zip(*map(moving, episodes), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("horizon", [0.5, 1.5])
def test_gradcheck(name, horizon):
    options = {"loss": "sum"} if name in SOFT else {}
    env = made(name, horizon=horizon, **options)
    x = points(env, rows=1).requires_grad_()
    assert torch.autograd.gradcheck(env, (x,), eps=SMALL_STEPS.get(name, 1e-6), fast_mode=True)


@pytest.mark.parametrize("scene", [*ENGINES, "rolling-pin", "swing-velocity"])
def test_a_shorter_episode_is_the_beginning_of_a_longer_one(scene):
    half, whole, more = (made(scene, horizon=horizon) for horizon in (0.5, 1.0, 1.5))
    x = whole.space.uniform(1, seed=3)[0]
    short, own, long = (env.episode(x) for env in (half, whole, more))
    assert float(short.time[-1]) == pytest.approx(float(own.time[-1]) / 2)
    assert float(long.time[-1]) == pytest.approx(1.5 * float(own.time[-1]))
    for few, some, many in zip(moving(short), moving(own), moving(long), strict=True):
        assert torch.equal(few, some[: len(few)])
        assert torch.equal(some, many[: len(some)])
    assert any(bool((path != path[:1]).any()) for path in moving(short))


def test_the_loss_is_that_of_the_last_frame():
    for scene, end, squared in (("bounce", "ball", True), ("cartpole", "links", False), ("pinball-2", "ball", False)):
        for horizon in (0.5, 1.5):
            env = made(scene, horizon=horizon)
            x = points(env, rows=1)
            episode = env.episode(x[0])
            (target,) = episode.tools.values()
            miss = (episode.points[end][-1, -1] - target[-1]).norm()
            assert float(env.evaluate(x).loss) == pytest.approx(float(miss**2 if squared else miss), rel=1e-12)


@pytest.mark.parametrize("scene", CONTROLLED)
def test_controls_that_are_not_reached_have_no_gradient(scene):
    env = made(scene, horizon=0.5)
    first = env.space.dim * (1 if scene == "cartpole" else 6) // (2 if scene == "cartpole" else 10)
    slope = env.evaluate(points(env)).grad
    assert bool((slope[:, first:] == 0).all())
    per = env.space.dim // env.decisions
    assert bool((slope[:, first - per : first] != 0).any(dim=1).all())
    other = points(env)
    other[:, first:] *= 0.3
    assert torch.equal(env.evaluate(other).loss, env.evaluate(points(env)).loss)


@pytest.mark.parametrize("scene", CONTROLLED)
def test_tools_rest_after_the_last_control(scene):
    env = made(scene, horizon=1.5)
    episode = env.episode(points(env)[0])
    own = len(episode.time) * 2 // 3 + (EASING - 1 if scene == "fluid" else 0)  # a ladle slows down
    paths = [episode.points["cart"]] if scene == "cartpole" else list(episode.tools.values())
    for path in paths:
        assert torch.equal(path[own:], path[own : own + 1].expand_as(path[own:]))
    assert bool((paths[0][own] != paths[0][0]).any())


def test_work_and_memory_follow_the_horizon(name):
    one, two, least = (made(name, horizon=horizon) for horizon in (1, 2, 1e-6))
    assert two.work().count == 2 * one.work().count
    assert two.memory() >= one.memory() > 0
    assert least.work().count < one.work().count / 10
    assert bool(least.evaluate(points(least)).loss.isfinite().all())


def test_summed_losses_are_of_the_steps_there_are():
    x = points(made("pinch"), rows=1)
    each = [float(made("pinch", horizon=step / 50).evaluate(x).loss) for step in (1, 2, 3)]
    assert float(made("pinch", loss="sum", horizon=3 / 50).evaluate(x).loss) == pytest.approx(sum(each), rel=1e-12)


@pytest.mark.parametrize("scene", ["pinch", "swing-velocity"])
def test_the_target_is_that_of_horizon_1(scene):
    short, own = made(scene, horizon=0.5), made(scene)
    shown = [env.episode(points(own)[0]).parts[-1] for env in (short, own)]
    assert shown[0].material == "target"
    assert torch.equal(shown[0].at[0], shown[1].at[0])
    x = own.example("demonstration" if scene == "pinch" else "target")[None]
    terms = (lambda env: env.terms(x)["density"]) if scene == "pinch" else (lambda env: env.evaluate(x).loss)
    assert float(terms(own)) == pytest.approx(0.0, abs=1e-6)
    assert float(terms(short)) > 1e-3


@pytest.mark.parametrize("wrong", [0, -1.0, "nan", float("nan"), 9, "inf", "long"])
def test_other_horizons_are_refused(wrong):
    said = refusal(lambda: make("bounce", horizon=wrong))
    assert said == f"bounce option horizon takes a number above 0, at most 8; got {wrong!r}"


def test_decisions_are_those_of_horizon_1():
    fluid, bounce = made("fluid", horizon=0.5), made("bounce", horizon=0.5)
    said = refusal(lambda: fluid.observe(points(fluid), 0))
    assert said == "fluid takes decisions at horizon 1 only; got horizon 0.5"
    assert bounce.observe(points(bounce), 0).shape == (2, 1)
