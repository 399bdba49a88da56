import pytest
import torch

from gradscape.envs.cartpole import SPAN as CONTROL_SPAN
from gradscape.envs.cartpole import TEMPO
from gradscape.envs.controls import watch
from gradscape.envs.mpm.fluid import SPAN
from gradscape.envs.mpm.fluid import Fluid as FluidScene
from gradscape.envs.mpm.scene import STEPS, MpmScene
from gradscape.envs.registry import entries, environment_class, make

from .scenes import SETTINGS, of_family

STAGED = {name: environment_class(name).decisions for name in entries() if environment_class(name).decisions > 1}
ROWS = 3


def made(name):
    return make(name, device="cpu", **({"fidelity": "draft"} if name == "cartpole" else SETTINGS[name]))


@pytest.fixture(scope="module", params=["fluid", "rolling-pin", "rope", "flip", "cartpole"])
def env(request):
    return made(request.param)


@pytest.fixture(scope="module")
def x(env):
    return env.space.uniform(ROWS, seed=4)


def inner(env):
    """A few decisions: the first, two more, the last."""
    return sorted({0, 1, env.decisions // 2, env.decisions - 1})


def test_scenes_with_controls_have_five_decisions_and_cartpole_one_for_every_control():
    assert STAGED.pop("cartpole") == 100
    assert set(STAGED) >= {"flip", *of_family(MpmScene)}
    assert set(STAGED.values()) == {5}


def test_every_scenes_parameters_are_shared_equally_by_its_decisions():
    for name in entries():
        cls = environment_class(name)
        dim = entries()[name].dim
        assert not dim.isdigit() or int(dim) % cls.decisions == 0, name


def test_what_is_seen_does_not_depend_on_this_decision_nor_on_later_ones(env, x):
    per = env.space.dim // env.decisions
    other = env.space.uniform(ROWS, seed=5)
    for decision in inner(env):
        changed = torch.cat([x[:, : per * decision], other[:, per * decision :]], dim=1)
        assert torch.equal(env.observe(changed, decision), env.observe(x, decision))


def test_what_is_seen_depends_on_the_decision_before(env, x):
    per = env.space.dim // env.decisions
    for decision in inner(env)[1:]:
        changed = x.clone()
        changed[:, per * (decision - 1) : per * decision] *= 0.5
        assert bool((env.observe(changed, decision) != env.observe(x, decision)).any(dim=1).all())


def test_rows_do_not_depend_on_their_batch(env, x):
    decision = env.decisions - 1
    together = env.observe(x, decision)
    assert torch.equal(torch.cat([env.observe(row[None], decision) for row in x]), together)


def test_it_is_of_a_scale_that_a_network_takes(env, x):
    seen = torch.stack([env.observe(x, decision) for decision in inner(env)])
    assert bool(seen.isfinite().all())
    assert 0.03 < float(seen.square().mean().sqrt()) < 3
    assert float(seen.abs().max()) < 30
    assert seen[:, 0, -1].tolist() == [decision / env.decisions for decision in inner(env)]


def test_at_the_start_nothing_has_moved(env, x):
    still = env.observe(x, 0)
    if env.name != "cartpole":  # which shows where it is, not how far it has come
        assert bool((still == 0).all())
    assert torch.equal(still[0], still[-1])


def test_the_fluid_policy_sees_the_ladle_and_the_cube_where_the_episode_has_them():
    env = made("fluid")
    x = env.space.uniform(1, seed=4)
    frames, step = env.episode(x[0]), 3 * STEPS // 5
    cube, ladle = frames.points["cube"].mean(dim=1), frames.tools["ladle"]
    seen = env.observe(x, 3)[0, :-1].view(2, -1, 3)  # how far, how fast; points; axes
    half_tank, decision = 0.2, 0.1
    syrup = min(32, frames.points["syrup"].shape[1]) + 1
    torch.testing.assert_close(seen[0, syrup] * half_tank, cube[step] - cube[0], atol=1e-7, rtol=1e-6)
    torch.testing.assert_close(seen[0, -1] * half_tank, ladle[step] - ladle[0])
    velocity = (ladle[step] - ladle[step - 1]) / SPAN
    torch.testing.assert_close(seen[1, -1] * half_tank / decision, velocity)


def test_the_cartpole_policy_sees_cart_and_links_where_the_episode_has_them():
    env = made("cartpole")
    x = env.space.uniform(1, seed=4)
    frames, decision = env.episode(x[0]), 40
    seen = env.observe(x, decision)[0]
    assert seen[0] == frames.points["cart"][decision, 0, 0]
    links = frames.points["links"][decision, 1:, :2] - frames.points["links"][decision, :-1, :2]
    torch.testing.assert_close(torch.stack([seen[1:4], -seen[4:7]], dim=1), links)
    assert seen[7] / TEMPO == pytest.approx(float(x[0, 4 * (decision - 1)]))
    assert env.fidelity.dt == CONTROL_SPAN  # so that the last step is the last control's


def test_points_are_watched_all_over_a_body():
    x = torch.arange(2 * 100 * 3, dtype=torch.float64).view(2, 100, 3)
    seen = watch(x, [90, 10])
    assert seen.shape == (2, 33 + 11, 3)
    torch.testing.assert_close(seen[:, 0], x[:, :90].mean(dim=1))
    assert torch.equal(seen[:, 1], x[:, 0])
    assert torch.equal(seen[:, 32], x[:, 89])
    assert torch.equal(seen[:, 34:], x[:, 90:])


def test_a_decision_that_does_not_exist_is_refused():
    env = made("fluid")
    with pytest.raises(ValueError, match="fluid numbers its decisions 0 to 4; got 5"):
        env.observe(FluidScene.space.center[None], 5)
