"""How gradients grow with episodes, on motions whose exponents are known."""

import json
import math

import numpy as np
import pytest
import torch

from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.measures.lyapunov import GradientGrowth, measure_growth

TIME = np.array([0.4, 0.8, 1.2, 1.6, 2.0])


def test_the_logistic_map_diverges_by_ln_2_a_step() -> None:
    """At 4 x (1 - x) the exponent is ln 2 for almost every point."""
    steps = np.arange(4, 25, 4)
    x = (np.pi / 7 * np.arange(1, 2001) % 1.0 * 0.98 + 0.01).clip(0.01, 0.99)
    start = torch.tensor(x, dtype=torch.float64, requires_grad=True)
    norm, state, done = [], start, 0
    for step in steps:
        while done < step:
            state, done = 4 * state * (1 - state), done + 1
        norm.append(torch.autograd.grad(state.sum(), start, retain_graph=True)[0].abs().numpy())
    found = measure_growth(steps.astype(float), np.array(norm))
    assert found.is_exponential
    assert found.rate.low <= math.log(2) <= found.rate.high
    assert found.rate.value == pytest.approx(math.log(2), abs=0.02)
    assert "exp(0.69" in found.describe()


@pytest.mark.parametrize("rate", [3.0, 0.5])
def test_a_linear_motion_grows_by_its_own_rate(rate: float) -> None:
    scale = np.linspace(1, 5, 16)
    found = measure_growth(TIME, np.exp(rate * TIME)[:, None] * scale)
    assert found.is_exponential
    assert found.rate.value == pytest.approx(rate)
    assert (found.known, found.points) == (16, 16)
    assert found.norm[0] == pytest.approx(3 * math.exp(0.4 * rate))


@pytest.mark.parametrize("power", [1.0, 2.0, 4.0])
def test_a_flight_grows_by_a_power_of_time_and_does_not_diverge(power: float) -> None:
    noise = np.exp(0.01 * np.random.default_rng(0).standard_normal((5, 16)))
    found = measure_growth(TIME, TIME[:, None] ** power * noise)
    assert not found.is_exponential
    assert found.power.value == pytest.approx(power, abs=0.05)
    assert f"t^{power:.2g}" in found.describe()


def test_what_stays_or_shrinks_does_not_diverge() -> None:
    rng = np.random.default_rng(1)
    level = measure_growth(TIME, np.exp(rng.standard_normal((5, 16))))
    assert not level.is_exponential
    assert not measure_growth(TIME, np.exp(-2 * TIME)[:, None] * np.ones(16)).is_exponential


def test_points_without_a_gradient_are_left_out_and_too_few_say_nothing() -> None:
    norm = np.exp(TIME)[:, None] * np.ones(16)
    norm[2, 0], norm[4, 1] = 0.0, math.nan
    found = measure_growth(TIME, norm)
    assert (found.known, found.rate.value) == (14, pytest.approx(1.0))
    norm[0, :9] = 0.0
    nothing = measure_growth(TIME, norm)
    assert math.isnan(nothing.rate.value)
    assert nothing.describe().startswith("how gradients grow is not known: at 7 of 16 points")
    assert math.isnan(measure_growth(TIME[:3], norm[:3, 9:]).rate.value)


def test_it_is_read_as_it_was_written() -> None:
    found = measure_growth(TIME, np.exp(TIME)[:, None] * np.linspace(1, 2, 8))
    assert from_json(GradientGrowth, json.loads(json.dumps(to_json(found)))) == found
    with pytest.raises(ValueError, match="ascend"):
        measure_growth(TIME[::-1], np.ones((5, 4)))
