"""Cartpole: its geometry, gradients that are slopes near and far, converged losses, and the swing-up."""

from dataclasses import replace

import pytest
import torch

from gradscape.envs.base import Fidelity
from gradscape.envs.cartpole import Cartpole
from gradscape.landscapes.objective import Status

SPACE = Cartpole.space
ALL = tuple(Cartpole.fidelities)


def made(fidelity, **options):
    return Cartpole(fidelity=fidelity, device="cpu", **options)


def exact(dt):
    return made(Fidelity(f"dt {dt}", dt=dt, precision="float64"))


@pytest.fixture(scope="module")
def cartpole():
    return made(replace(Cartpole.fidelities["standard"], precision="float64"))


def slopes(env, x, step):
    """Return central differences of the loss along `step`."""
    ahead, back = (env.evaluate(x + sign * step, grad=False).loss for sign in (1, -1))
    return (ahead - back) / 2


def test_an_episode_starts_hanging_and_ends_where_the_loss_is_measured(cartpole):
    x = SPACE.uniform(1, seed=0)[0]
    episode = cartpole.episode(x)
    cart, links, target = episode.points["cart"], episode.points["links"], episode.tools["target"]
    assert cart.shape == (201, 1, 3)
    assert links.shape == (201, 4, 3)
    assert episode.time.tolist() == pytest.approx([0.01 * step for step in range(201)])
    hanging = torch.tensor([[0.0, -y, 0.0] for y in range(4)], dtype=torch.float64)
    torch.testing.assert_close(links[0], hanging)
    assert torch.equal(links[:, :1], cart)
    torch.testing.assert_close(links.diff(dim=1).norm(dim=2), torch.ones(201, 3, dtype=torch.float64))
    speed = (cart[1:, 0, 0] - cart[:-1, 0, 0]) / 0.01
    torch.testing.assert_close(speed, x[::4].repeat_interleave(2))
    assert (cart[:, 0, 1:] == 0).all()
    torch.testing.assert_close((links[-1, -1] - target[-1]).norm(), cartpole.evaluate(x[None], grad=False).loss[0])


def test_a_tip_that_meets_the_target_has_a_gradient_of_zero():
    below = made("standard", target_y=-3.0).evaluate(SPACE.center[None])
    assert below.status.tolist() == [Status.OK]
    assert float(below.loss) == 0
    assert (below.grad == 0).all()


def test_the_mirror_image_of_the_controls_has_the_mirrored_gradient(cartpole):
    x = SPACE.uniform(8, seed=1)
    one, other = cartpole.evaluate(x), cartpole.evaluate(-x)
    torch.testing.assert_close(one.loss, other.loss, rtol=0, atol=1e-12)
    torch.testing.assert_close(one.grad, -other.grad, rtol=0, atol=1e-10)


def test_gradients_still_hold_where_every_parameter_moves_by_up_to_a_hundredth_of_the_box(cartpole):
    """The paper's finding: the landscape is very smooth."""
    x, along = SPACE.uniform(64, seed=5), SPACE.uniform(64, seed=6)
    got = (cartpole.evaluate(x).grad * along).sum(dim=1)
    assert (slopes(cartpole, x, 2e-2 * along) / 2e-2 - got).norm() < 0.03 * got.norm()


def test_across_the_box_the_loss_turns_once_at_most_along_one_parameter(cartpole):
    """The paper's finding: gradients are of good quality."""
    for seed, parameter in enumerate(range(0, SPACE.dim, 27)):
        x = SPACE.uniform(1, seed=seed).repeat(33, 1)
        x[:, parameter] = torch.linspace(-1, 1, 33, dtype=torch.float64) * SPACE.upper[parameter]
        slope = cartpole.evaluate(x).grad[:, parameter]
        assert int((slope[1:] * slope[:-1] < 0).sum()) <= 1


@pytest.mark.parametrize(("fidelity", "loss", "grad"), [("draft", 1e-2, 3e-2), ("standard", 5e-4, 2e-3)])
def test_cheaper_fidelities_agree_with_the_reference(fidelity, loss, grad):
    x = SPACE.uniform(128, seed=0)
    one, best = (made(name).evaluate(x) for name in (fidelity, "reference"))
    assert (one.loss - best.loss).abs().max() < loss
    assert ((one.grad - best.grad).norm(dim=1) < grad * best.grad.norm(dim=1)).all()


@pytest.mark.parametrize("fidelity", ALL)
def test_the_example_swings_the_tip_up_to_the_target(fidelity):
    env = made(fidelity)
    upright = env.example("upright")
    assert (upright.abs() <= SPACE.upper).all()
    assert float(env.evaluate(upright[None], grad=False).loss) < 0.05
    links = env.episode(upright).points["links"]
    assert (links[-1, :, 1].diff() > 0.95).all()


def test_a_step_that_does_not_divide_the_time_of_a_control_is_refused():
    for dt in (0.03, 0.015, 0.04):
        with pytest.raises(ValueError, match=f"cartpole keeps each control for 0.02 s.*got dt {dt} s"):
            exact(dt)


def test_weightless_links_stay_where_they_are_and_uniform_links_are_heavier():
    still = made("draft", gravity=0.0, horizon=0.5).evaluate(SPACE.center[None], grad=False)
    assert float(still.loss) == 6
    assert made("draft", taper=False).chain.masses == (1.0, 1.0, 1.0)


@pytest.mark.parametrize("part", Cartpole.model_parts, ids=lambda part: part.name)
def test_every_part_of_the_model_has_a_gradient_that_is_the_slope(part):
    env = Cartpole(fidelity=Fidelity("f", dt=0.02, precision="float64"), device="cpu", **part.options)
    x, along = SPACE.uniform(4, seed=2), SPACE.uniform(4, seed=3)
    got = (env.evaluate(x).grad * along).sum(dim=1)
    torch.testing.assert_close(got, slopes(env, x, 1e-6 * along) / 1e-6, rtol=1e-6, atol=1e-8)
    assert not torch.equal(env.evaluate(x).loss, exact(0.02).evaluate(x).loss)
