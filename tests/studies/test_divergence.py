"""Rates at which neighbours part, of motions whose rate is known."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from gradscape.landscapes.convert import from_json, to_json
from gradscape.studies.divergence import Divergence, Response, fit_rate

Array = NDArray[np.float64]


def logistic(x: float, steps: int) -> Array:
    """Iterate x -> 4 x (1 - x), whose Lyapunov exponent is log 2."""
    found = [x]
    for _ in range(steps):
        found.append(4 * found[-1] * (1 - found[-1]))
    return np.array(found)


def sinai(angle: float, steps: int) -> Array:
    """Follow a point in a unit torus with a disc of radius 0.3 in its middle, sampled at equal times."""
    place, way, found = np.array([0.1, 0.0]), np.array([math.cos(angle), math.sin(angle)]), []
    left, dt, unwrapped = 0.25, 0.25, np.array([0.1, 0.0])
    while len(found) < steps:
        far, centre = left, None
        for shift in np.ndindex(5, 5):
            about = np.array(shift) - 2 + 0.5 - (place - np.floor(place))
            along = float(about @ way)
            under = along**2 - float(about @ about) + 0.09
            if under > 0 and 1e-12 < (hit := along - math.sqrt(under)) < far:
                far, centre = hit, about
        place, unwrapped, left = place + far * way, unwrapped + far * way, left - far
        if centre is not None:
            normal = (far * way - centre) / 0.3
            way = way - 2 * float(way @ normal) * normal
        else:
            found.append(unwrapped.copy())
            left = dt
    return np.array(found)


def test_the_logistic_map_parts_at_log_two() -> None:
    rates = []
    for start in np.linspace(0.11, 0.41, 30):
        distance = np.abs(logistic(start, 40) - logistic(start + 1e-12, 40))
        growth = fit_rate(np.arange(41.0), distance, extent=1.0)
        rates.append(growth.rate)
    assert np.mean(rates) == pytest.approx(math.log(2), rel=0.1)
    assert growth.chaotic


def test_a_billiard_with_a_disc_is_chaotic() -> None:
    time = 0.25 * np.arange(48)
    distances = np.linalg.norm(sinai(0.7, 48) - sinai(0.7 + 1e-10, 48), axis=1)
    growth = fit_rate(time, distances, extent=1.0)
    assert growth.chaotic
    assert 0.5 < growth.rate < 4.0


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
