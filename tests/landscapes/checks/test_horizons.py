"""The first step at which a gradient is wrong, found by bisection."""

import math

import pytest
import torch

import gradscape as gs
from gradscape.landscapes.checks.horizons import FirstWrong, first_wrong_step

SPACE = gs.ParameterSpace({"v": (0.5, 2.0, "m/s"), "k": (0.1, 1.0, "1/s")})
POINT = torch.tensor([1.3, 0.4], dtype=torch.float64)


def slowing(x, steps=64, detached=math.inf, dt=0.05):
    """How far something comes that slows down; from one step on its speed is detached."""
    place, speed = torch.zeros_like(x[:, 0]), x[:, 0]
    for step in range(1, steps + 1):
        speed = speed - dt * x[:, 1] * (speed.detach() if step >= detached else speed)
        place = place + dt * speed
    return place


def differs_from_differences(env):
    x = torch.cat([POINT + sign * 1e-6 * one for one in torch.eye(2).double() for sign in (1, -1)]).reshape(4, 2)
    up, down = env.evaluate(x, grad=False).loss.reshape(2, 2).T
    return not torch.allclose((up - down) / 2e-6, env.evaluate(POINT[None]).grad[0], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("first", [1, 2, 13, 63, 64])
def test_the_step_from_which_a_speed_is_detached_is_found_among_64_by_7_trials(first):
    env = gs.from_torch(slowing, SPACE, horizon="steps", options={"steps": 64, "detached": first, "dt": 0.05})
    tried = list[gs.Environment]()
    found = first_wrong_step(
        env.with_horizon, range(1, 65), lambda one: tried.append(one) or differs_from_differences(one)
    )
    assert found == FirstWrong(first, first - 1 or None)
    assert len(tried) <= 7


def test_a_length_among_the_settings_of_a_fidelity_is_bisected_too():
    fidelities = {"draft": {"steps": 32, "dt": 0.1}, "reference": {"steps": 64, "dt": 0.05}}
    env = gs.from_torch(slowing, SPACE, horizon="steps", fidelities=fidelities, options={"detached": 11})
    for fidelity, whole in (("draft", 32), ("reference", 64)):
        chosen = env.remake(fidelity=fidelity)
        assert first_wrong_step(chosen.with_horizon, range(1, whole + 1), differs_from_differences).length == 11


def test_the_first_bounce_of_a_scene_is_found_as_by_trying_every_length():
    """Until it touches the ground a ball flies freely: its loss has the gradient of a flight, and no other after."""
    env = gs.make("bounce", device="cpu", fidelity="draft")
    x = env.space.center[None]
    lengths = [step / 40 for step in range(1, 41)]

    def has_bounced(short):
        return any(int(count) > 0 for count in short.events(x).values())

    wanted = next(length for length in lengths if has_bounced(env.with_horizon(length)))
    found = first_wrong_step(env.with_horizon, lengths, has_bounced)
    assert found == FirstWrong(wanted, pytest.approx(wanted - 1 / 40))


@pytest.mark.parametrize("refused", [set(), {8}, {3, 4, 5}, {1, 2}, {4, 7, 8}, set(range(1, 9))])
def test_lengths_that_are_refused_are_passed_over_and_none_is_found_where_the_longest_is_right(refused):
    def make(length):
        if length in refused:
            raise ValueError(f"no episode of {length} steps")
        return length

    left = [length for length in range(1, 9) if length not in refused]
    for first in range(1, 10):
        wrong = [length for length in left if length >= first]
        right = max((length for length in left if length < first), default=None)
        found = first_wrong_step(make, range(1, 9), lambda length, first=first: length >= first)
        assert found == (FirstWrong(wrong[0], right) if wrong else None)


def test_what_is_no_refusal_is_raised():
    with pytest.raises(ZeroDivisionError):
        first_wrong_step(lambda length: 1 / 0, [1, 2], bool)
    assert first_wrong_step(float, [], bool) is None
    assert first_wrong_step(float, [2.0], bool) == FirstWrong(2.0, None)
