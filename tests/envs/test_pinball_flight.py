"""Pinball's exact flights: the same ends at any step, those of an independent hand, and the parts of the model."""

import numpy as np
import pytest
import torch

from gradscape.envs.base import Fidelity
from gradscape.envs.engines.balls.impacts import Board, Solver
from gradscape.envs.pinball import BALL, BAR, HEIGHT, WIDTH, Pinball2, Pinball16

from .pinball_oracle import end_of_flight

SCENES = [Pinball2, Pinball16]


def ends(scene, x):
    with scene._solvers.lend() as solver:
        return solver.run(x, scene._start).clone()


def made(cls, dt, precision="float64", **options):
    return cls(fidelity=Fidelity("one", dt=dt, precision=precision), device="cpu", **options)


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
    one, other = (ends(made(cls, dt), x) for dt in (1 / 15, 1 / 60))
    apart = (one - other).norm(dim=1)
    assert float((apart < 1e-6).double().mean()) >= 0.98
    assert float((apart < 1e-3).double().mean()) >= 0.99


def test_single_precision_is_what_remains():
    x = Pinball2.space.uniform(100, seed=21)
    apart = (ends(made(Pinball2, 1 / 30, "float32"), x).double() - ends(made(Pinball2, 1 / 30), x)).norm(dim=1)
    assert float((apart < 1e-3).double().mean()) >= 0.95


def test_a_ball_that_cannot_spin_is_braked_by_friction_as_a_point_is():
    """Dropped on a slope that friction cannot hold, it slides down at g (sin - mu cos)."""
    tilt, time, mu = 0.5, 0.4, 0.2
    scene = made(Pinball2, 1 / 30, spin=False)
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
    whole, without = (made(cls, 1 / 30, **how).evaluate(x) for how in ({}, part.options))
    assert not torch.equal(whole.loss, without.loss)
    assert bool(without.grad.isfinite().all())
