"""The ways in which the ball of `bounce` meets the ground, and its spin and drag, against oracles and closed forms."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from gradscape.envs.base import Fidelity
from gradscape.envs.bounce import DURATION, START, Bounce
from gradscape.envs.engines.balls.rigid import Ball, Solver
from gradscape.envs.engines.runtime import to_torch

from .contact_oracle import throw

BALL = Ball(radius=0.1, mass=1.0, gravity=9.8, ke=1e4, kd=10.0, kf=1e3, mu=0.25)
TARGET = np.array([2.0, 1.0, 0.0])
LAWS = ("step", "touch", "smooth")
DTS = (1 / 1920, 1 / 15360)
SHORT = 0.3  # of an episode: time for one bounce


def thrown(count=8):
    """Throw down at 3 to 9 m/s: nothing but one bounce happens within the short episode."""
    x = Bounce.space.uniform(count, seed=5)
    return x * torch.tensor([0.6, 0.3, 0.4]) - torch.tensor([0.0, 6.0, 0.0])


def oracle(x, law, **how):
    """Return losses and their derivatives by vy."""
    found = [judge(tuple(v), law, **how) for v in x.tolist()]
    return tuple(np.array(values) for values in zip(*found, strict=True))


@cache
def judge(v, law, **how):
    end = throw(BALL, START, v, SHORT * DURATION, smooth=law == "smooth", **how)
    miss = end.x - TARGET
    return miss @ miss, 2 * miss @ end.dx


def made(law, dt, **options):
    return Bounce(fidelity=Fidelity("one", dt=dt, precision="float64"), device="cpu", contacts=law, **options)


@pytest.fixture(scope="module")
def found():
    """Losses and derivatives by vy of every law at two steps, of balls that bounce."""
    x = thrown()
    results = {(law, dt): made(law, dt, horizon=SHORT).evaluate(x) for law in LAWS for dt in DTS}
    return x, {key: (result.loss.numpy(), result.grad[:, 1].numpy()) for key, result in results.items()}


@pytest.mark.parametrize("law", LAWS)
def test_the_oracle_differentiates_itself(law):
    x = thrown(1)
    h = torch.tensor([0.0, 1e-5, 0.0], dtype=torch.float64)
    differences = (oracle(x + h, law)[0] - oracle(x - h, law)[0]) / 2e-5
    np.testing.assert_allclose(oracle(x, law)[1], differences, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("law", LAWS)
def test_losses_converge_to_the_oracle_at_first_order(found, law):
    x, results = found
    true = oracle(x, law)[0]
    coarse, fine = (np.mean(np.abs(results[law, dt][0] - true)) for dt in DTS)
    assert 4 < coarse / fine < 20


@pytest.mark.parametrize("law", ["touch", "smooth"])
def test_with_the_time_of_touch_or_smooth_damping_slopes_converge_at_first_order(found, law):
    x, results = found
    true = oracle(x, law)[1]
    coarse, fine = (np.median(np.abs(results[law, dt][1] / true - 1)) for dt in DTS)
    assert coarse / fine > 4
    assert fine < 0.05
    assert (np.sign(results[law, DTS[1]][1]) == np.sign(true)).all()


def test_in_whole_steps_slopes_converge_to_those_of_a_motion_that_always_touches_at_the_same_time(found):
    """The force jumps at touch, and whole steps do not differentiate when that is: they miss the model's slope."""
    x, results = found
    true, without = (oracle(x, "step", touch_moves=moves)[1] for moves in (True, False))
    coarse, fine = (np.median(np.abs(results["step", dt][1] / without - 1)) for dt in DTS)
    assert coarse / fine > 3
    assert fine < 0.05
    assert np.median(np.abs(without / true - 1)) > 1


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("options", [{}, {"spin": True}, {"drag": 0.47, "spin": True, "mu": 0.1}])
def test_gradient_is_the_slope_of_the_program(law, options):
    bounce, x = made(law, 1 / 480, **options), Bounce.space.uniform(16, seed=2)
    grad = bounce.evaluate(x).grad
    compared = 0
    for axis in range(3):
        shift = torch.eye(3, dtype=torch.float64)[axis]
        coarse, fine = (
            (bounce.evaluate(x + h * shift, grad=False).loss - bounce.evaluate(x - h * shift, grad=False).loss) / 2 / h
            for h in (2e-6, 1e-6)
        )
        calm = (coarse - fine).abs() < 1e-5 * (1 + fine.abs())  # no step is taken otherwise in between
        torch.testing.assert_close(grad[calm, axis], fine[calm], rtol=1e-6, atol=2e-5)
        compared += int(calm.sum())
    assert compared > 40


def test_at_rest_everything_has_a_derivative():
    """A ball laid down without velocity: neither friction nor drag divides by its speed."""
    ball = replace(BALL, drag=0.01, turning=2.5)
    for law in LAWS:
        solver = Solver(ball, dt=1 / 480, steps=48, name="float64", capacity=1, device="cpu", contacts=law)
        solver.run(torch.tensor([0.0, 0.0999, 0.0]), torch.zeros(1, 3))
        assert bool(solver.gradient(torch.ones(1, 3)).isfinite().all())


def test_splitting_the_step_at_touch_leaves_flights_that_never_touch_as_they_are():
    x = torch.tensor([[1.0, 9.9, 2.0]], dtype=torch.float64)
    one, other = (made(law, 1 / 480, horizon=0.5).evaluate(x) for law in ("step", "touch"))
    torch.testing.assert_close(one.loss, other.loss, rtol=1e-14, atol=0)
    torch.testing.assert_close(one.grad, other.grad, rtol=1e-14, atol=0)


def test_restitution_of_smooth_damping_falls_with_speed_as_the_energy_it_takes():
    """Of an impact at v the approach takes kd / d0 v^3 m / (3 ke), to first order in damping."""
    solver = Solver(
        replace(BALL, kd=0.2, gravity=0.0), dt=1e-5, steps=4000, name="float64", capacity=2, device="cpu",
        contacts="smooth",
    )  # fmt: skip
    speed = torch.tensor([2.0, 8.0], dtype=torch.float64)
    velocity = torch.stack([torch.zeros(2), -speed, torch.zeros(2)], dim=1).double()
    solver.run(torch.tensor([0.0, 0.10001, 0.0]), velocity)
    after = to_torch(solver.v)[-1, :, 1]
    lost = (speed.square() - after.square()) / 2
    torch.testing.assert_close(lost, 0.2 / 0.025 * speed**3 / (3 * BALL.ke), rtol=0.02, atol=0)


def test_a_ball_that_slides_ends_rolling_at_five_sevenths_of_its_speed():
    ball = replace(BALL, turning=2.5, kd=200.0, mu=0.5, kf=1e5)
    solver = Solver(ball, dt=1 / 960, steps=1920, name="float64", capacity=1, device="cpu")
    solver.run(torch.tensor([0.0, 0.0995, 0.0]), torch.tensor([[3.0, 0.0, -1.0]]))
    v, roll = (to_torch(state)[:, 0, ::2] for state in (solver.v, solver.roll))
    torch.testing.assert_close(v - roll / ball.turning, v[:1].expand_as(v), rtol=0, atol=1e-12)  # about the contact
    torch.testing.assert_close(v[-1], 5 / 7 * v[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(roll[-1], -v[-1], rtol=0, atol=1e-9)


def test_air_slows_a_falling_ball_as_the_closed_form_says():
    """y = y0 - V^2 / g log cosh(g t / V), where V is the speed at which drag balances gravity."""
    ball, time = replace(BALL, drag=0.05), 2.0
    terminal = math.sqrt(ball.mass * ball.gravity / ball.drag)
    fallen = terminal**2 / ball.gravity * math.log(math.cosh(ball.gravity * time / terminal))
    errors = []
    for steps in (400, 800):
        solver = Solver(ball, dt=time / steps, steps=steps, name="float64", capacity=1, device="cpu")
        end = solver.run(torch.tensor([0.0, 50.0, 0.0]), torch.zeros(1, 3))[-1, 0, 1]
        errors.append(50.0 - float(end) - fallen)
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.02)
    assert abs(2 * errors[1] - errors[0]) < 1e-3 * abs(errors[1])  # Richardson's extrapolation


def test_options_reach_the_ball():
    ball = Bounce(device="cpu", spin=True, drag=0.5).ball
    assert ball.turning == 2.5
    assert ball.drag == pytest.approx(0.5 * 1.2 / 2 * math.pi * 0.1**2)
    x = torch.tensor([[6.0, -9.0, 1.0]], dtype=torch.float64)
    losses = [float(made("step", 1 / 480, **how).evaluate(x).loss) for how in ({}, {"spin": True}, {"drag": 0.47})]
    assert len(set(losses)) == 3
