"""Pinball: the landscape the paper describes, gradients that are true, and episodes that agree at every fidelity."""

from dataclasses import replace
from itertools import product

import pytest
import torch

from gradscape.envs.pinball import BALL, BAR, HEIGHT, WIDTH, Pinball2, Pinball16
from gradscape.landscapes.objective import Status

SCENES = [Pinball2, Pinball16]
MIDDLE = {Pinball2: (0, 1), Pinball16: (13, 14)}  # the slices of the paper


def made(cls, fidelity="draft", **options):
    return cls(fidelity=fidelity, device="cpu", **options)


def exact(cls, fidelity="draft", **options):
    return made(cls, replace(cls.fidelities[fidelity], precision="float64"), **options)


def slice_points(cls, count):
    """Return the points of the paper's slice through the centre, shape (count^2, dim)."""
    side = torch.linspace(-1, 1, count, dtype=torch.float64)
    x = cls.space.center.repeat(count * count, 1)
    x[:, MIDDLE[cls]] = torch.cartesian_prod(side, side)
    return x


def corners(cls, count):
    """Return so many corners of the box, or all."""
    if 2**cls.space.dim <= count:
        return torch.tensor(list(product((-1.0, 1.0), repeat=cls.space.dim)), dtype=torch.float64)
    return 2 * (cls.space.uniform(count, seed=9) > 0).double() - 1


@pytest.mark.parametrize("cls", SCENES)
def test_the_slice_of_the_paper_is_flat_in_large_parts_and_spans_its_losses(cls):
    """Colour bars of the paper: 0.4 to 8.5 m and 0.32 to 6.8 m."""
    x = slice_points(cls, 40)
    result = made(cls).evaluate(x)
    flat = (result.grad[:, MIDDLE[cls]] == 0).all(dim=1)
    assert 0.2 < float(flat.double().mean()) < 0.6
    assert 0 < float(result.loss.min()) < 0.5
    highest = {Pinball2: 8.5, Pinball16: 6.8}[cls]
    assert highest - 0.5 < float(result.loss.max()) < highest + 0.5


def test_the_flat_region_of_two_bars_is_where_the_ball_falls_between_them_untouched():
    scene = exact(Pinball2)
    x = slice_points(Pinball2, 40)
    result = scene.evaluate(x)
    gap = torch.tensor([abs(scene.start[0] - px) for px, _ in scene.pivots], dtype=torch.float64)
    clear = (scene.half_length * x.cos() + BALL + BAR < gap).all(dim=1)
    assert torch.equal((result.grad == 0).all(dim=1), clear)
    assert len(result.loss[clear].unique()) == 1
    assert torch.equal(scene.events(x)["impacts"][clear].unique(), torch.tensor([5]))  # those with the floor


def test_losses_jump_beside_the_flat_region():
    scene = exact(Pinball2)
    edge = torch.tensor((scene.start[0] - scene.pivots[0][0] - BALL - BAR) / scene.half_length).double().acos()
    x = torch.stack([edge + torch.tensor([-1e-3, 1e-3], dtype=torch.float64), torch.zeros(2).double() + 0.9], dim=1)
    result = scene.evaluate(x)
    assert float(result.grad[1].abs().max()) == 0.0
    assert float(result.grad[0, 0].abs()) > 10.0


@pytest.mark.parametrize("fidelity", ["draft", "standard"])
@pytest.mark.parametrize("cls", SCENES)
def test_everywhere_in_the_box_there_is_a_loss_on_the_board_and_a_gradient(cls, fidelity):
    x = torch.cat([corners(cls, 128), cls.space.uniform(128, seed=4)])
    result = made(cls, fidelity).evaluate(x)
    assert (result.status == Status.OK).all()
    assert float(result.loss.max()) < (WIDTH**2 + HEIGHT**2) ** 0.5


@pytest.mark.parametrize("cls", SCENES)
def test_the_example_and_other_balls_with_few_impacts_end_where_the_reference_has_them(cls):
    x = cls.space.uniform(128, seed=6)
    draft, standard = (made(cls, fidelity) for fidelity in ("draft", "standard"))
    calm = (draft.events(x)["impacts"] < 7) & (standard.evaluate(x).grad.norm(dim=1) < 30)
    few = torch.cat([standard.example("aim")[None], x[calm][:8]])
    assert len(few) == 9
    true = made(cls, "reference").evaluate(few, grad=False).loss
    gaps = {scene.fidelity.name: (scene.evaluate(few, grad=False).loss - true).abs() for scene in (draft, standard)}
    assert float(true[0]) < 0.1
    assert float(gaps["standard"].max()) < 0.01
    assert float(gaps["draft"].max()) < 0.1


@pytest.mark.parametrize("contacts", ["impact", "step"])
@pytest.mark.parametrize("cls", SCENES)
def test_gradient_is_the_slope_of_the_loss(cls, contacts):
    """Where differences of two sizes agree, so that no event lies between and chaos leaves them their digits."""
    scene = exact(cls, contacts=contacts)
    x = cls.space.uniform(24, seed=2)
    grad = scene.evaluate(x).grad

    directions = torch.nn.functional.normalize(cls.space.uniform(3, seed=3), dim=1)

    def slope(direction, h):
        ends = [scene.evaluate(x + sign * h * direction, grad=False).loss for sign in (1, -1)]
        return (ends[0] - ends[1]) / (2 * h)

    compared = 0
    for direction in directions:
        coarse, fine = slope(direction, 4e-7), slope(direction, 2e-7)
        calm = ((coarse - fine).abs() < 1e-5 * (1 + fine.abs())) & (grad.norm(dim=1) < 200)
        wanted = (4 * fine - coarse) / 3  # of fourth order
        torch.testing.assert_close((grad @ direction)[calm], wanted[calm], rtol=1e-6, atol=2e-6)
        compared += int((calm & (grad != 0).any(dim=1)).sum())
    assert compared > 12


def test_fixed_steps_turn_the_slope_of_many_an_episode_round():
    """Without the time of impact, bounces off the floor push the gradient the wrong way."""
    x = Pinball2.space.uniform(256, seed=3)
    by_impact, by_step = (
        exact(Pinball2, "standard", contacts=contacts).evaluate(x).grad for contacts in ("impact", "step")
    )
    sloped = (by_impact.norm(dim=1) > 0) & (by_impact.norm(dim=1) < 100) & (by_step.norm(dim=1) > 0)
    cosine = torch.nn.functional.cosine_similarity(by_impact[sloped], by_step[sloped])
    assert float((cosine < 0).double().mean()) > 0.25


def test_a_bar_the_ball_never_comes_near_has_no_influence():
    scene = made(Pinball16)
    x = Pinball16.space.uniform(64, seed=8)
    left = [0, 4, 8, 12]
    path = torch.stack([scene.episode(row).points["ball"][:, 0, 0].amin() for row in x[:16]])
    far = path > scene.pivots[0][0] + scene.half_length + BAR + BALL
    assert int(far.sum()) > 3
    grad = scene.evaluate(x[:16]).grad
    assert (grad[far][:, left] == 0).all()
    assert (grad[far] != 0).any()


@pytest.mark.parametrize("cls", SCENES)
def test_an_episode_starts_at_the_hand_and_ends_where_the_loss_is_measured(cls):
    scene = made(cls)
    aim = scene.example("aim")
    episode = scene.episode(aim)
    ball, bars = episode.points["ball"], episode.points["bars"]
    assert ball.shape == (scene.steps + 1, 1, 3)
    assert bars.shape == (scene.steps + 1, 2 * len(scene.pivots), 3)
    assert float(episode.time[-1]) == pytest.approx(4.0)
    torch.testing.assert_close(ball[0, 0], torch.tensor([*scene.start, 0.0], dtype=torch.float64), rtol=0, atol=1e-6)
    miss = (ball[-1, 0] - episode.tools["goal"][-1]).norm()
    torch.testing.assert_close(miss, scene.evaluate(aim[None], grad=False).loss[0])
    axis = bars[0, 1] - bars[0, 0]
    torch.testing.assert_close(torch.atan2(axis[1], axis[0]), aim[0])
    torch.testing.assert_close((bars[0, 1] + bars[0, 0])[:2] / 2, torch.tensor(scene.pivots[0], dtype=torch.float64))


def test_options_change_what_they_say():
    x = torch.tensor([[0.9, 0.9]], dtype=torch.float64)  # the ball falls to the floor below its start
    start = torch.tensor(Pinball2.start, dtype=torch.float64)
    dead = made(Pinball2, restitution=0.0, goal_x=float(start[0]), goal_y=BALL)
    assert float(dead.evaluate(x).loss) == pytest.approx(0.0, abs=1e-5)
    assert float(made(Pinball2, restitution=1.0).evaluate(x).loss) != float(made(Pinball2).evaluate(x).loss)
    bent = Pinball2.space.uniform(1, seed=1) * torch.tensor([0.0, 1.0]) + torch.tensor([0.5, 0.0])
    assert float(made(Pinball2, friction=0.0).evaluate(bent).loss) != float(made(Pinball2).evaluate(bent).loss)
