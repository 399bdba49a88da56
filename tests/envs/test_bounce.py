"""Bounce against closed forms and an oracle: flight, the ways of contact, spin, drag, and the paper's finding."""

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

from .contact_oracle import instant_flight, restitution, throw

BALL = Ball(radius=0.1, mass=1.0, gravity=9.8, ke=1e4, kd=10.0, kf=1e3, mu=0.25)
HEIGHT = START[1]
TARGET = np.array([2.0, 1.0, 0.0])
LAWS = ("step", "touch", "smooth")
DTS = (1 / 1920, 1 / 15360)
SHORT = 0.3  # of an episode: time for one bounce
SPEEDS = torch.linspace(-9.9, 9.7, 32, dtype=torch.float64)


def made(law, dt, **options):
    return Bounce(fidelity=Fidelity("one", dt=dt, precision="float64"), device="cpu", contacts=law, **options)


@pytest.fixture(scope="module")
def bounce():
    return made("step", 1 / 480)


def solver_of(ball, *, dt, duration, rows=1, contacts="step"):
    how = {"name": "float64", "capacity": rows, "device": "cpu", "contacts": contacts}
    return Solver(ball, dt=dt, steps=round(duration / dt), **how)


def fly(velocity, *, ball=BALL, dt, duration=DURATION):
    """Return positions and velocities of all steps, shape (step + 1, batch, 3), in float64."""
    solver = solver_of(ball, dt=dt, duration=duration, rows=len(velocity))
    x = solver.run(torch.tensor(START, dtype=torch.float64), velocity)
    return x.clone(), to_torch(solver.v).clone()


def upright(speeds):
    return torch.stack([torch.zeros_like(speeds), speeds, torch.zeros_like(speeds)], dim=1)


def random_velocities(count, seed):
    return Bounce.space.uniform(count, seed=seed)


def test_free_flight_misses_the_parabola_by_the_integrators_first_order_term_exactly():
    dt, t = 1 / 480, 0.25
    velocity = random_velocities(50, seed=0).abs()
    x, _ = fly(velocity, dt=dt, duration=t)
    parabola = torch.tensor(START, dtype=torch.float64) + velocity * t
    parabola[:, 1] -= BALL.gravity * t**2 / 2
    miss = torch.tensor([0.0, -BALL.gravity * t * dt / 2, 0.0], dtype=torch.float64)
    torch.testing.assert_close(x[-1] - parabola, miss.expand(50, 3), rtol=0, atol=1e-13)


def test_a_stiffer_contact_comes_closer_to_an_instantaneous_bounce():
    gaps = []
    for stiffer in (1.0, 4.0, 16.0):  # at the same damping ratio, so that the restitution stays
        ball = replace(BALL, ke=stiffer * BALL.ke, kd=math.sqrt(stiffer) * BALL.kd)
        assert restitution(ball) == pytest.approx(restitution(BALL))
        end = fly(upright(SPEEDS), ball=ball, dt=1 / 7680)[0][-1, :, 1]
        instant = torch.tensor([instant_flight(ball, HEIGHT, float(v), DURATION) for v in SPEEDS])
        gaps.append(float((end - instant).abs().mean()))
    # What is left is the length of the contact, pi sqrt(m / ke).
    np.testing.assert_allclose(np.array(gaps[:-1]) / gaps[1:], 2, atol=0.35)


def integrated_energy(ball, dt, x, v):
    """Return the energy [J] of height and vertical speed that semi-implicit Euler conserves exactly between contacts.

    It is U + m v^2 / 2 - dt v U' / 2, where U is that of gravity and of the contact's spring.
    """
    c = (x[:, :, 1] - ball.radius).clamp_max(0)
    potential = ball.mass * ball.gravity * x[:, :, 1] + ball.ke * c.square() / 2
    slope = ball.mass * ball.gravity + ball.ke * c
    return potential + ball.mass * v[:, :, 1].square() / 2 - dt * v[:, :, 1] * slope / 2


@pytest.mark.parametrize("dt", [1 / 240, 1 / 480, 1 / 1920])
@pytest.mark.parametrize("kf", [10.0, 1e3, 1e5])
def test_contact_never_adds_energy_beyond_the_integrators_own_error(dt, kf):
    ball = replace(BALL, kf=kf)
    x, v = fly(random_velocities(200, seed=1), ball=ball, dt=dt)

    sliding = v[:, :, ::2].square()
    assert (sliding[1:] <= sliding[:-1]).all()  # friction slows, in every step, along both axes

    gain = integrated_energy(ball, dt, x, v).diff(dim=0)
    before, after = v[:-1, :, 1], v[1:, :, 1]
    touching, touching_next = (y < ball.radius for y in (x[:-1, :, 1], x[1:, :, 1]))
    # While it approaches, damping takes energy but for the step about the lowest point: the worst speed there gains
    # dt^3 kd a^2 / (8 (2 - dt kd / m)), a being the acceleration. A step off the ground ends up to dt v above it: at
    # most dt^2 v^2 ke / 8 of the spring's energy is kept.
    a = ball.ke * (ball.radius - x[:-1, :, 1]) / ball.mass - ball.gravity
    turning = dt**3 * ball.kd * a.square() / (8 * (2 - dt * ball.kd / ball.mass))
    leaving = ball.ke * (dt * after).square() / 8
    allowed = turning * (touching & (before < 0)) + leaving * (touching & ~touching_next)
    assert (touching & ~touching_next).any()
    assert (gain <= allowed + 1e-10).all()


def test_friction_takes_mu_times_the_normal_impulse_while_the_ball_slides():
    dt = 1 / 1920
    velocity = torch.tensor([[9.0, -4.0, 3.0], [-7.0, -8.0, 0.0], [0.0, -2.0, 8.0]], dtype=torch.float64)
    x, v = fly(velocity, dt=dt, duration=0.5)
    touching = x[:-1, :, 1] < BALL.radius
    normal = v[:, :, 1].diff(dim=0) + BALL.gravity * dt  # impulse by mass [m/s]
    tangential = v[:, :, ::2].norm(dim=2).diff(dim=0)
    assert (touching.sum(dim=0) > 20).all()
    torch.testing.assert_close(tangential[touching], -BALL.mu * normal[touching], rtol=0, atol=1e-12)
    torch.testing.assert_close(tangential[~touching], torch.zeros_like(tangential[~touching]), rtol=0, atol=1e-12)


def test_strong_friction_stops_a_slow_ball_and_never_turns_it_round():
    ball = replace(BALL, kf=1e5, mu=5.0)
    _, v = fly(torch.tensor([[0.3, -9.0, -0.2]], dtype=torch.float64), ball=ball, dt=1 / 240)
    assert v[-1, 0, ::2].abs().max() < 1e-12
    assert v[:, 0, 0].min() > -1e-15
    assert v[:, 0, 2].max() < 1e-15


def gradient_along(bounce, axis):
    """Return the loss's slope along one velocity at 512 values of it, the others those of `aim`."""
    x = bounce.example("aim").repeat(512, 1)
    x[:, axis] = torch.linspace(-10, 10, 512, dtype=torch.float64)
    return bounce.evaluate(x).grad[:, axis]


def test_gradients_over_horizontal_velocity_are_smoother_than_over_vertical_velocity(bounce):
    """The paper's finding; a monotone gradient has a variation of 1 and changes its sign once at the most."""
    variation, sign_changes = {}, {}
    for axis in (0, 1):
        slope = gradient_along(bounce, axis)
        variation[axis] = float(slope.diff().abs().sum() / (slope.max() - slope.min()))
        sign_changes[axis] = int((slope[1:] * slope[:-1] < 0).sum())
    assert variation[0] < 1.5
    assert variation[1] > 5 * variation[0]
    assert sign_changes[0] == 1
    assert sign_changes[1] > 10


def test_the_number_of_bounces_changes_as_a_throw_does_and_not_with_what_a_step_hits():
    """In whole steps it changed 401 times along this line."""
    env = Bounce(fidelity="standard", device="cpu", **Bounce.preset_options("paper"))
    x = env.example("aim").repeat(2000, 1)
    x[:, 1] = torch.linspace(float(env.space.lower[1]), float(env.space.upper[1]), len(x), dtype=torch.float64)
    assert x[-1, 1] == 0.0  # no velocity upwards
    assert 1 < int((env.events(x)["bounces"].diff() != 0).sum()) < 8


@pytest.mark.parametrize("fidelity", ["draft", "standard"])
def test_the_aimed_throw_meets_the_target_after_one_bounce(fidelity):
    bounce = Bounce(fidelity=fidelity, device="cpu")
    aim = bounce.example("aim")[None]
    assert bounce.bounces(aim).tolist() == [1]
    if fidelity == "standard":
        assert float(bounce.evaluate(aim, grad=False).loss) < 0.01


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
        solver = solver_of(ball, dt=1 / 480, duration=0.1, contacts=law)
        solver.run(torch.tensor([0.0, 0.0999, 0.0]), torch.zeros(1, 3))
        assert bool(solver.gradient(torch.ones(1, 3)).isfinite().all())


def test_restitution_of_smooth_damping_falls_with_speed_as_the_energy_it_takes():
    """Of an impact at v the approach takes kd / d0 v^3 m / (3 ke), to first order in damping."""
    solver = solver_of(replace(BALL, kd=0.2, gravity=0.0), dt=1e-5, duration=0.04, rows=2, contacts="smooth")
    speed = torch.tensor([2.0, 8.0], dtype=torch.float64)
    velocity = torch.stack([torch.zeros(2), -speed, torch.zeros(2)], dim=1).double()
    solver.run(torch.tensor([0.0, 0.10001, 0.0]), velocity)
    after = to_torch(solver.v)[-1, :, 1]
    lost = (speed.square() - after.square()) / 2
    torch.testing.assert_close(lost, 0.2 / 0.025 * speed**3 / (3 * BALL.ke), rtol=0.02, atol=0)


def test_a_ball_that_slides_ends_rolling_at_five_sevenths_of_its_speed():
    ball = replace(BALL, turning=2.5, kd=200.0, mu=0.5, kf=1e5)
    solver = solver_of(ball, dt=1 / 960, duration=2.0)
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
        end = solver_of(ball, dt=time / steps, duration=time).run(torch.tensor([0.0, 50.0, 0.0]), torch.zeros(1, 3))[
            -1, 0, 1
        ]
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
