"""How gradients grow with episodes, on motions whose exponents are known."""

import json
import math
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
import torch

from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.measures.lyapunov import GradientGrowth, Shape, measure_growth

TIME = np.array([0.4, 0.8, 1.2, 1.6, 2.0])
COUNT = 100  # curves of a kind


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
    assert found.shape is Shape.EXPONENTIAL
    assert found.rate.low <= math.log(2) <= found.rate.high
    assert found.rate.value == pytest.approx(math.log(2), abs=0.02)
    assert "exp(0.69" in found.describe()


@pytest.mark.parametrize(("rate", "power"), [(3.0, 0.0), (0.5, 0.0), (0.0, 1.0), (0.0, 2.0), (0.0, 4.0)])
def test_a_motion_grows_by_its_own_rate_or_power(rate: float, power: float) -> None:
    noise = np.exp(0.01 * np.random.default_rng(0).standard_normal((5, 16)))
    found = measure_growth(TIME, (np.exp(rate * TIME) * TIME**power)[:, None] * (np.linspace(1, 5, 16) * noise))
    assert found.shape is (Shape.EXPONENTIAL if rate else Shape.POWER)
    assert (found.rate if rate else found.power).value == pytest.approx(rate or power, abs=0.05)
    assert (found.known, found.points) == (16, 16)
    assert found.norm[0] == pytest.approx(3 * math.exp(0.4 * rate) * 0.4**power, rel=0.15)
    assert (f"exp({rate:.0g}" if rate == 3 else "exp(0.5" if rate else f"t^{power:.2g}") in found.describe()


def test_what_stays_or_shrinks_does_not_diverge() -> None:
    rng = np.random.default_rng(1)
    level = measure_growth(TIME, np.exp(0.3 * rng.standard_normal((5, 16))))
    shrinking = measure_growth(TIME, np.exp(-2 * TIME)[:, None] * np.ones(16))
    assert (level.shape, shrinking.shape) == (Shape.BOUNDED, Shape.BOUNDED)
    assert level.describe().startswith("gradients stay bounded")


def shapes(draw: Callable[[np.random.Generator], np.ndarray], count: int = COUNT) -> Counter[Shape]:
    """Count the answers for many curves of shape (horizon,). Each has 16 points, which differ from it by a third."""
    rng = np.random.default_rng(2)
    apart = (np.exp(0.3 * rng.standard_normal((5, 16))) for _ in range(count))
    return Counter(measure_growth(TIME, draw(rng)[:, None] * one).shape for one in apart)


def test_a_linear_oscillation_is_not_called_exponential_however_many_points_swing_together() -> None:
    """Its gradient is |cos(w t + phase)| at every point: each has the same rising stretch, and none diverges."""

    def swing(rng: np.random.Generator) -> np.ndarray:
        return np.abs(np.cos(rng.uniform(1.5, 20) * TIME + rng.uniform(0, 2 * np.pi))) + 1e-6

    def stiffness(rng: np.random.Generator) -> np.ndarray:  # cos(w t) by w
        return np.abs(TIME * np.sin(rng.uniform(1.5, 20) * TIME)) + 1e-6

    for draw in (swing, stiffness):
        found = shapes(draw)
        assert found[Shape.EXPONENTIAL] <= 0.05 * COUNT
        assert found[Shape.UNDECIDED] + found[Shape.BOUNDED] > COUNT / 2
    whole = np.abs(np.cos(np.array([1.47, 1.3, 1.1, 0.9, 0.6])))[:, None] * np.ones(16)  # a quarter of a swing, rising
    assert measure_growth(TIME, whole).shape is not Shape.EXPONENTIAL


def test_growth_that_ends_is_bounded() -> None:
    found = measure_growth(TIME, (1 - np.exp(-TIME / 0.4))[:, None] * np.linspace(1, 2, 16))
    assert found.shape is Shape.BOUNDED
    noisy = shapes(lambda rng: (1 - np.exp(-TIME / 0.3)) * np.exp(0.05 * rng.standard_normal(5)))
    assert noisy[Shape.EXPONENTIAL] <= 0.05 * COUNT


@pytest.mark.parametrize("noise", [0.05, 0.2, 1.0])
def test_shapes_are_told_as_far_as_noise_that_all_points_share_lets_them(noise: float) -> None:
    """The wrong one of exponential and power is rare at any noise, and 'cannot tell' takes over as it rises."""
    exponential = shapes(lambda rng: np.exp(3 * TIME + noise * rng.standard_normal(5)))
    power = shapes(lambda rng: TIME**2 * np.exp(noise * rng.standard_normal(5)))
    assert exponential[Shape.POWER] + power[Shape.EXPONENTIAL] <= 0.2 * COUNT
    if noise == 0.05:
        assert min(exponential[Shape.EXPONENTIAL], power[Shape.POWER]) > 0.93 * COUNT
    if noise == 1.0:
        assert min(exponential[Shape.UNDECIDED], power[Shape.UNDECIDED]) > 0.4 * COUNT


def test_it_says_that_it_cannot_tell() -> None:
    found = measure_growth(TIME, np.array([1.0, 6.0, 2.0, 9.0, 5.0])[:, None] * np.linspace(1, 2, 16))
    assert found.shape is Shape.UNDECIDED
    assert found.rate.low < 0 < found.rate.high  # sixteen points are not sixteen measurements
    assert found.describe().startswith("the growth of gradients is undecided: an exponential has ")


def test_points_without_a_gradient_are_left_out_and_too_few_say_nothing() -> None:
    norm = np.exp(TIME)[:, None] * np.ones(16)
    norm[2, 0], norm[4, 1] = 0.0, math.nan
    found = measure_growth(TIME, norm)
    assert (found.known, found.rate.value) == (14, pytest.approx(1.0))
    norm[0, :9] = 0.0
    nothing = measure_growth(TIME, norm)
    assert math.isnan(nothing.rate.value)
    assert nothing.describe().startswith(
        "the growth of gradients is unknown: they exist at every horizon at 7 of 16 points"
    )
    assert math.isnan(measure_growth(TIME[:3], norm[:3, 9:]).rate.value)


def test_it_is_read_as_it_was_written() -> None:
    found = measure_growth(TIME, np.exp(TIME)[:, None] * np.linspace(1, 2, 8))
    assert from_json(GradientGrowth, json.loads(json.dumps(to_json(found)))) == found
    with pytest.raises(ValueError, match="ascend"):
        measure_growth(TIME[::-1], np.ones((5, 4)))
