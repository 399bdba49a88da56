"""Rates at which neighbours part, and distances of distributions of losses, against closed forms."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import ks_2samp, wasserstein_distance

from gradscape.landscapes.convert import from_json, to_json
from gradscape.studies.divergence import Divergence, Response, compare_distributions, distances, fit_rate

Array = NDArray[np.float64]


def logistic(x: float, steps: int) -> Array:
    """Iterate x -> 4 x (1 - x), whose Lyapunov exponent is log 2."""
    found = [x]
    for _ in range(steps):
        found.append(4 * found[-1] * (1 - found[-1]))
    return np.array(found)


def test_the_logistic_map_parts_at_log_two() -> None:
    rates = []
    for start in np.linspace(0.11, 0.41, 30):
        distance = np.abs(logistic(start, 40) - logistic(start + 1e-12, 40))
        growth = fit_rate(np.arange(41.0), distance, extent=1.0)
        rates.append(growth.rate)
    assert np.mean(rates) == pytest.approx(math.log(2), rel=0.1)
    assert growth.chaotic


def test_oscillators_flights_and_powers_of_time_are_not_chaotic() -> None:
    time = np.linspace(0, 10, 401)
    swing = 1e-8 * np.hypot(np.cos(time), np.sin(time))
    assert fit_rate(time, swing, extent=1.0).rate == pytest.approx(0, abs=1e-12)
    wobble = np.abs(np.cos(time) - np.cos(time + 1e-8))
    assert not fit_rate(time, wobble, extent=1.0).chaotic
    for power in (1, 2, 4):
        growth = fit_rate(time, 1e-8 * time**power, extent=1e9)
        assert growth.rate * growth.duration < 2 * power * math.log(2) * 1.1  # 2^n in the latter half
        assert not growth.chaotic


def test_neighbours_that_stay_together_have_no_rate_to_fit() -> None:
    time = np.linspace(0, 1, 50)
    growth = fit_rate(time, np.zeros(50), extent=1.0)
    assert (growth.rate, growth.chaotic) == (0.0, False)
    sudden = np.where(time > 0.98, 1.0, 0.0)
    assert math.isnan(fit_rate(time, sudden, extent=1.0).rate)


def test_half_chaotic_points_make_a_chaotic_scene() -> None:
    time = np.linspace(0, 1, 101)
    tame = fit_rate(time, np.full(101, 1e-8), extent=1.0)
    wild = fit_rate(time, 1e-8 * np.exp(12 * time), extent=1.0)
    responses = [Response(1e-9, 1e-6), Response(1e-5, 0.3), Response(1e-3, None)]
    found = Divergence.of([tame, wild], responses, size=1e-8)
    assert found.is_chaos
    assert found.saturates_at == 1e-5
    assert found.rate.value == pytest.approx(6)
    assert not Divergence.of([tame, tame, wild], responses, size=1e-8).is_chaos
    assert from_json(Divergence, to_json(found)) == found


def test_distances_are_those_of_scipy() -> None:
    generator = np.random.default_rng(3)
    for sizes in ((5, 9), (40, 40)):
        a, b = (generator.integers(0, 12, size).astype(float) for size in sizes)
        wanted = [ks_2samp(a, b).statistic, wasserstein_distance(a, b) / 3]
        assert distances(a, b, scale=3.0) == pytest.approx(wanted, abs=1e-12)


def test_the_same_distribution_is_not_told_apart_and_another_is() -> None:
    generator = np.random.default_rng(0)
    base = generator.normal(size=(8, 1))
    first, second, again, wide = (base + generator.normal(size=(8, 64)) for _ in range(4))
    found = compare_distributions(
        (first, second), {"again": again, "same": second, "shifted": wide + 0.7}, scale=4.0, radius=0.02, seed=0
    )
    again_, same, shifted = found.compared
    assert (again_.told, same.told) == ((), ())
    assert same.distance == found.noise
    assert set(shifted.told) == {"kolmogorov", "wasserstein"}
    assert shifted.distance.wasserstein.value == pytest.approx(0.7 / 4, rel=0.2)


def test_a_fidelity_of_the_same_distribution_is_told_apart_about_once_in_twenty() -> None:
    told = 0
    for seed in range(20):
        first, second, third = np.random.default_rng(seed).normal(size=(3, 4, 24))
        found = compare_distributions((first, second), {"same": third}, scale=1.0, radius=0.02, seed=seed)
        told += "wasserstein" in found.compared[0].told
    assert told <= 4


def test_failures_are_left_out_and_all_of_them_leave_nothing() -> None:
    a = np.array([1.0, 2.0, np.nan])
    assert distances(a, np.array([1.0, 2.0]), scale=1.0).tolist() == [0.0, 0.0]
    assert np.isnan(distances(a, np.full(3, np.nan), scale=1.0)).all()
