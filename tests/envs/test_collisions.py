"""Scenes of colliding balls against closed forms, and against the numbers of the paper they are from."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar

import gradscape as gs
from gradscape.envs.base import Environment
from gradscape.envs.closed_forms import HELD, two_balls

SCENES = ("bounce-once", "ground-wall", "two-balls")


def rows(env: Environment, count: int = 200) -> torch.Tensor:
    """Return the paper's start, and random points."""
    return torch.cat([env.space.center[None], env.space.uniform(count, seed=1)])


def apart(env: Environment, x: torch.Tensor) -> torch.Tensor:
    """Return how far gradients are from the closed form's, as shares of it."""
    exact, found = env.closed_form(x), env.evaluate(x)
    assert exact is not None
    assert exact.grad is not None
    assert found.grad is not None
    return (found.grad - exact.grad).norm(dim=1) / exact.grad.norm(dim=1)


def at_start(name: str, **options: Any) -> tuple[float, list[float]]:
    env = gs.make(name, **options)
    found = env.evaluate(env.space.center[None])
    assert found.grad is not None
    return float(found.loss), found.grad[0].tolist()


def test_task_1_has_the_slopes_of_reflected_flight() -> None:
    """The height is 0.2 m minus that of free flight, so the slopes are -1, -T and what a first push adds to both."""
    loss, slope = at_start("bounce-once")
    assert loss == pytest.approx(1.2, abs=1e-12)
    assert slope[:4] == pytest.approx([0.0, -1.0, 0.0, -1.0], abs=1e-12)
    assert slope[4:] == pytest.approx([0.0, -(HELD * 1.0 - HELD**2 / 2)], abs=1e-12)


def test_task_3_has_the_papers_slopes() -> None:
    loss, slope = at_start("two-balls")
    assert loss - 0.1 * 18 == pytest.approx(0.50906**2, abs=1e-5)
    assert slope[:4] == pytest.approx([-0.39867, -0.39867, -0.32125, -0.32125], abs=5e-6)
    assert slope[4:8] == pytest.approx([-0.49779, -0.49779, -0.22213, -0.22213], abs=5e-6)


def cost(touch: float) -> float:
    """Return what the best push costs that makes balls touch at a time; it is linear in time until then.

    The ball covers `way` and touches at the velocity c [m/s], of either coordinate: integral u = c, integral of
    u (touch - t) = way. The least integral of u^2 is 4 c^2 / s - 12 c way / s^2 + 12 way^2 / s^3; the second ball is
    then at -1 + c (1 - s). The best c is where the sum, which is quadratic, is least.
    """
    price, way = 0.1, 1 - 0.4 / np.sqrt(2)
    square = 2 * (price * 4 / touch + (1 - touch) ** 2)
    linear = 2 * (-12 * price * way / touch**2 - 2 * (1 - touch))
    rest = 2 * (12 * price * way**2 / touch**3 + 1)
    return float(rest - linear**2 / (4 * square))


def test_the_best_push_of_task_3_costs_what_the_paper_says_and_in_short_pieces_that_in_the_simulation() -> None:
    from gradscape.envs.collisions import PRICE, TwoBalls
    from gradscape.envs.engines.balls.collisions import run

    s, pieces = minimize_scalar(cost, bounds=(0.3, 0.95), method="bounded").x, 480
    way, price = 1 - 0.4 / np.sqrt(2), 0.1
    c = (12 * price * way / s**2 + 2 * (1 - s)) / (2 * (price * 4 / s + (1 - s) ** 2))
    t = (torch.arange(pieces, dtype=torch.float64) + 0.5) / pieces
    push = torch.where(t < s, 6 * way / s**2 - 2 * c / s + (6 * c / s**2 - 12 * way / s**3) * t, 0.0)
    x = torch.tensor([[[-2.0, -2.0], [-1.0, -1.0]]], dtype=torch.float64)
    given = [(torch.stack([one.expand(2), torch.zeros(2, dtype=torch.float64)])[None], 1 / pieces) for one in push]
    end = run(TwoBalls.table, x, torch.zeros_like(x), given, 1 / pieces, "touch")[-1, 0, 1]
    assert cost(s) == pytest.approx(1.396542, abs=1e-6)
    loss = float(end.square().sum() + PRICE * 2 * push.square().sum() / pieces)
    assert loss == pytest.approx(1.396542, abs=1e-4)  # of the piece in which balls touch, a part is a waste


@pytest.mark.parametrize(
    ("name", "dt", "horizon"),
    [
        *((name, dt, 1.0) for name in SCENES for dt in (1 / 480, 1 / 1920)),
        *((name, 1 / 480, horizon) for name in ("bounce-once", "two-balls") for horizon in (0.2, 0.7, 1.2)),
    ],
)
def test_with_the_time_of_touch_losses_and_slopes_are_the_closed_forms(name: str, dt: float, horizon: float) -> None:
    """Before the touch too, at short horizons."""
    env = gs.make(name, fidelity=gs.Fidelity("own", dt=dt, precision="float64"), horizon=horizon)
    x = rows(env)
    exact = env.closed_form(x)
    assert exact is not None
    torch.testing.assert_close(env.evaluate(x).loss, exact.loss, rtol=1e-12, atol=1e-12)
    assert float(apart(env, x).max()) < 1e-11


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("contacts", ["step", "shift"])
def test_losses_of_whole_steps_converge_at_first_order(name: str, contacts: str) -> None:
    off = []
    for dt in (1 / 480, 1 / 960, 1 / 1920):
        env = gs.make(name, contacts=contacts, fidelity=gs.Fidelity("own", dt=dt, precision="float64"))
        x = rows(env)
        exact = env.closed_form(x)
        assert exact is not None
        off.append(float((env.evaluate(x, grad=False).loss - exact.loss).abs().median()))
    assert off[2] < 0.5 * off[0] + 1e-12


@pytest.mark.parametrize(
    ("name", "contacts", "least"),
    [("bounce-once", "step", 1.0), ("ground-wall", "step", 1.0), ("two-balls", "step", 0.4),
     ("ground-wall", "shift", 0.15), ("two-balls", "shift", 0.15)],
)  # fmt: skip
def test_their_slopes_do_not_however_short_the_steps(name: str, contacts: str, least: float) -> None:
    for dt in (1 / 480, 1 / 1920):
        env = gs.make(name, contacts=contacts, fidelity=gs.Fidelity("own", dt=dt, precision="float64"))
        assert float(apart(env, rows(env, 60)).median()) > least


def test_shifted_places_are_enough_where_nothing_accelerates() -> None:
    """So task 1 alone does not tell DiffTaichi's correction from the time of touch: it leaves velocities out."""
    env = gs.make("bounce-once", contacts="shift")
    assert float(apart(env, rows(env)).max()) < 1e-5


def test_momentum_and_energy_of_two_balls_are_kept() -> None:
    from gradscape.envs.collisions import TwoBalls
    from gradscape.envs.engines.balls.collisions import fly

    x = torch.tensor([[[-1.0, 0.05], [0.0, 0.0]]], dtype=torch.float64)
    v = torch.tensor([[[3.0, 0.1], [-0.5, 0.2]]], dtype=torch.float64)
    _, after = fly(TwoBalls.table, x, v, torch.zeros_like(x), 1.0, 1 / 480)
    assert not torch.equal(after, v)
    torch.testing.assert_close(after.sum(dim=1), v.sum(dim=1), rtol=0, atol=1e-12)
    torch.testing.assert_close(after.square().sum(), v.square().sum(), rtol=1e-12, atol=0)


def test_balls_that_miss_one_another_fly_on() -> None:
    x = torch.tensor([[[-2.0, -2.0], [-1.0, 1.0]]], dtype=torch.float64)
    end = two_balls(x, torch.zeros_like(x), torch.tensor([[3.0, 0.0]], dtype=torch.float64), 1.0)
    assert end.tolist() == [[-1.0, 1.0]]


BY_OTHERS = (
    "mjx-ground-wall", "newton-bounce-once", "newton-ground-wall",
    *(pytest.param(name, marks=pytest.mark.nightly) for name in ("mjx-bounce-once", "mjx-two-balls")),  # JAX takes long
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", BY_OTHERS)
def test_by_other_engines_a_flight_that_touches_nothing_has_the_closed_form(name: str) -> None:
    """So parameters set what they name, and the gradient is by them, in their order."""
    env = gs.make(name, fidelity="standard", horizon=0.2)
    x = env.space.center + 0.05 * (env.space.uniform(4, seed=0) - env.space.center)
    exact, found = env.closed_form(x), env.evaluate(x)
    assert exact is not None
    torch.testing.assert_close(found.loss, exact.loss, rtol=5e-3, atol=1e-4)  # semi-implicit Euler: g T dt / 2
    torch.testing.assert_close(found.grad, exact.grad, rtol=5e-3, atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", BY_OTHERS)
def test_by_other_engines_a_contact_lasts_as_long_as_its_spring_says(name: str) -> None:
    """Pi sqrt(m / k) s against a wall or the ground; that much later a ball comes back, at about the same speed."""
    env = gs.make(name, fidelity="standard")
    x = env.space.center[None]
    exact = env.closed_form(x)
    assert exact is not None
    if name.endswith("bounce-once"):
        assert float(exact.loss - env.evaluate(x).loss) == pytest.approx(2.0 * np.pi / 100, rel=0.1)
    else:
        assert float(env.evaluate(x).loss) == pytest.approx(float(exact.loss), rel=0.1)
