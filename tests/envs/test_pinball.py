"""Pinball: the landscape the paper describes, exact flights by another hand, and the parts of the model."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gradscape.envs.base import Fidelity
from gradscape.envs.engines.balls.impacts import Board, Solver
from gradscape.envs.pinball import BALL, BAR, HEIGHT, WIDTH, Pinball2, Pinball16

from .pinball_oracle import end_of_flight

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


def ends(scene, x):
    with scene._solvers.lend() as solver:
        return solver.run(x, scene._start).clone()


def at_step(cls, dt, precision="float64", **options):
    return made(cls, Fidelity("one", dt=dt, precision=precision), **options)


@pytest.mark.parametrize("cls", SCENES)
def test_balls_end_where_an_independent_hand_has_them_at_any_step(cls):
    """Of 100 random boards at high restitution those count whose ball meets nothing slowly."""
    time, x = 1.6, cls.space.uniform(100, seed=31)
    board = Board(WIDTH, HEIGHT, cls.pivots, cls.half_length, BAR, BALL, restitution=0.9, friction=0.2)
    wanted = [end_of_flight(board, row, cls.start, time) for row in x.numpy()]
    known = [k for k, end in enumerate(wanted) if end is not None]
    assert len(known) > 60
    for dt in (time, time / 40):
        solver = Solver(board, dt=dt, steps=round(time / dt), name="float64", capacity=100, device="cpu")
        end = solver.run(x, torch.tensor(cls.start, dtype=torch.float64)).numpy()
        misses = np.linalg.norm(end[known] - np.stack([wanted[k] for k in known]), axis=1)
        assert np.median(misses) < 1e-11
        assert misses.max() < 1e-7  # impacts amplify rounding


@pytest.mark.parametrize("cls", SCENES)
def test_whole_episodes_end_at_the_same_place_at_any_step(cls):
    """Rolling and resting included; impacts amplify rounding in a few."""
    x = cls.space.uniform(100, seed=21)
    one, other = (ends(at_step(cls, dt), x) for dt in (1 / 15, 1 / 60))
    apart = (one - other).norm(dim=1)
    assert float((apart < 1e-6).double().mean()) >= 0.98
    assert float((apart < 1e-3).double().mean()) >= 0.99


def test_single_precision_is_what_remains():
    x = Pinball2.space.uniform(100, seed=21)
    apart = (ends(at_step(Pinball2, 1 / 30, "float32"), x).double() - ends(at_step(Pinball2, 1 / 30), x)).norm(dim=1)
    assert float((apart < 1e-3).double().mean()) >= 0.95


def test_a_ball_that_cannot_spin_is_braked_by_friction_as_a_point_is():
    """Dropped on a slope that friction cannot hold, it slides down at g (sin - mu cos)."""
    tilt, time, mu = 0.5, 0.4, 0.2
    scene = at_step(Pinball2, 1 / 30, spin=False)
    board = Board(WIDTH, HEIGHT, ((4.0, 5.0),), 1.6, BAR, BALL, 0.5, mu, inertia=scene.board.inertia)
    solver = Solver(board, dt=time, steps=1, name="float64", capacity=1, device="cpu")
    n = np.array([-np.sin(tilt), np.cos(tilt)])
    start = np.array([4.0, 5.0]) + (BALL + BAR) * n
    end = solver.run(torch.tensor([[tilt]]), torch.from_numpy(start))[0].numpy()
    a = board.gravity * (np.sin(tilt) - mu * np.cos(tilt))
    np.testing.assert_allclose(end - start, -a * time**2 / 2 * np.array([np.cos(tilt), np.sin(tilt)]), atol=1e-7)
    assert abs(float(solver.at_end("spin"))) < 1e-6


@pytest.mark.parametrize("cls", SCENES)
@pytest.mark.parametrize("part", Pinball2.model_parts, ids=lambda part: part.name)
def test_every_part_of_the_model_matters_somewhere(cls, part):
    x = cls.space.uniform(16, seed=5)
    whole, without = (at_step(cls, 1 / 30, **how).evaluate(x) for how in ({}, part.options))
    assert not torch.equal(whole.loss, without.loss)
    assert bool(without.grad.isfinite().all())
