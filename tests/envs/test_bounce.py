"""Bounce against closed forms: flight, contact, restitution, friction, and the paper's finding about its gradients."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from gradscape.envs.bounce import DURATION, START, Bounce
from gradscape.envs.engines.balls.rigid import Ball, Solver
from gradscape.envs.engines.runtime import to_torch

from . import oracles

BALL = Ball(radius=0.1, mass=1.0, gravity=9.8, ke=1e4, kd=10.0, kf=1e3, mu=0.25)
HEIGHT = START[1]
SPEEDS = torch.linspace(-9.9, 9.7, 32, dtype=torch.float64)


@pytest.fixture(scope="module")
def bounce():
    return Bounce(fidelity=dataclasses.replace(Bounce.fidelities["standard"], precision="float64"), device="cpu")


def fly(velocity, *, ball=BALL, dt, duration=DURATION):
    """Return positions and velocities of all steps, shape (step + 1, batch, 3), in float64."""
    steps = round(duration / dt)
    solver = Solver(ball, dt=dt, steps=steps, name="float64", capacity=len(velocity), device="cpu")
    x = solver.run(torch.tensor(START, dtype=torch.float64), velocity)
    return x.clone(), to_torch(solver.v).clone()


def upright(speeds):
    return torch.stack([torch.zeros_like(speeds), speeds, torch.zeros_like(speeds)], dim=1)


def random_velocities(count, seed):
    return Bounce.space.uniform(count, seed=seed)


def end_heights(flight, ball=BALL):
    return torch.tensor([flight(ball, HEIGHT, float(v), DURATION).y for v in SPEEDS], dtype=torch.float64)


def test_free_flight_misses_the_parabola_by_the_integrators_first_order_term_exactly():
    dt, t = 1 / 480, 0.25
    velocity = random_velocities(50, seed=0).abs()
    x, _ = fly(velocity, dt=dt, duration=t)
    parabola = torch.tensor(START, dtype=torch.float64) + velocity * t
    parabola[:, 1] -= BALL.gravity * t**2 / 2
    miss = torch.tensor([0.0, -BALL.gravity * t * dt / 2, 0.0], dtype=torch.float64)
    torch.testing.assert_close(x[-1] - parabola, miss.expand(50, 3), rtol=0, atol=1e-13)


def test_a_bounce_converges_to_the_closed_form_at_first_order():
    dts = np.array([1 / 960, 1 / 1920, 1 / 3840, 1 / 7680])
    exact = end_heights(oracles.penalty_flight)
    errors = [float((fly(upright(SPEEDS), dt=dt)[0][-1, :, 1] - exact).abs().mean()) for dt in dts]
    order = np.polyfit(np.log(dts), np.log(errors), 1)[0]
    assert 0.8 < order < 1.3
    assert errors[-1] < 0.01


def test_a_stiffer_contact_comes_closer_to_an_instantaneous_bounce():
    gaps = []
    for stiffer in (1.0, 4.0, 16.0):  # at the same damping ratio, so that the restitution stays
        ball = dataclasses.replace(BALL, ke=stiffer * BALL.ke, kd=math.sqrt(stiffer) * BALL.kd)
        assert oracles.restitution(ball) == pytest.approx(oracles.restitution(BALL))
        end = fly(upright(SPEEDS), ball=ball, dt=1 / 7680)[0][-1, :, 1]
        gaps.append(float((end - end_heights(oracles.instant_flight, ball)).abs().mean()))
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
    ball = dataclasses.replace(BALL, kf=kf)
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
    ball = dataclasses.replace(BALL, kf=1e5, mu=5.0)
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


def test_bounces_are_counted_as_the_closed_form_has_them():
    fine = Bounce(fidelity="reference", device="cpu")
    speeds = torch.linspace(-9.9, 9.9, 67, dtype=torch.float64)

    def exact(shift=0.0, later=0.0):
        """Return the counts of throws a little faster, at a moment a little later."""
        flights = (oracles.penalty_flight(BALL, HEIGHT, float(v) + shift, DURATION + later) for v in speeds)
        return torch.tensor([flight.bounces for flight in flights])

    near = [exact(-0.05), exact(0.05), exact(later=-1e-3), exact(later=1e-3)]
    clear = torch.stack([counts == exact() for counts in near]).all(dim=0)
    assert clear.sum() > 50
    assert exact()[clear].unique().tolist() == [0, 1, 2]
    counts = fine.bounces(upright(speeds))
    assert torch.equal(counts[clear], exact()[clear])
    assert fine.bounces(upright(speeds)[:0]).shape == (0,)


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


def test_an_episode_starts_at_the_hand_and_ends_where_the_loss_is_measured(bounce):
    aim = bounce.example("aim")
    episode = bounce.episode(aim)
    flight = episode.points["ball"]
    flight = flight.reshape(-1, 3)
    torch.testing.assert_close(flight[0], torch.tensor(START, dtype=torch.float64))
    assert float(episode.time[-1]) == pytest.approx(DURATION)
    miss = (flight[-1] - episode.tools["target"][-1]).square().sum()
    torch.testing.assert_close(miss, bounce.evaluate(aim[None], grad=False).loss[0])
