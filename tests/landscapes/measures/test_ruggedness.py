"""Measures of losses on functions whose answers are known."""

import math
import tracemalloc

import numpy as np
import pytest
import torch

from gradscape import ParameterSpace, Plane, from_torch, sample
from gradscape.landscapes.convert import to_json
from gradscape.landscapes.measures import ruggedness
from gradscape.landscapes.measures.profile import own_cost
from gradscape.landscapes.storage.store import SliceStore


def grid(points: int, low: float = -1.0, high: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    axis = np.linspace(low, high, points)
    u, v = np.meshgrid(axis, axis)
    return u, v


def rastrigin(x: np.ndarray) -> np.ndarray:
    return x**2 - 10 * np.cos(2 * np.pi * x) + 10


def test_rastrigin_has_as_many_minima_as_whole_numbers_in_its_box() -> None:
    u, v = grid(129, -5.12, 5.12)
    loss = rastrigin(u) + rastrigin(v)
    found = ruggedness.minima(loss)
    assert found.count(0.0) == 11**2
    assert found.sample[0] == np.argmin(loss)
    assert found.depth[0] == ruggedness.span(loss)
    u, v = grid(90, -2.5, 1.5)  # the whole numbers -2 to 1
    assert ruggedness.minima(rastrigin(u) + rastrigin(v)).count(1.0) == 4**2


def test_depth_of_a_minimum_is_the_climb_to_a_lower_one() -> None:
    loss = np.array([3.0, 1.0, 4.0, 0.5, 9.0, 8.0, 8.5])
    found = ruggedness.minima(loss)
    np.testing.assert_array_equal(found.sample, [3, 1, 5])
    np.testing.assert_allclose(found.depth, [8.5, 3.0, 1.0])
    assert [found.count(depth) for depth in (0.0, 2.0, 3.0)] == [3, 2, 1]


def test_a_diagonal_valley_is_one_minimum_and_a_failure_is_no_hill() -> None:
    loss = np.full((9, 9), 5.0)
    np.fill_diagonal(loss, 1.0 + np.arange(9) / 100)
    assert ruggedness.minima(loss).count(0.0) == 1
    loss[4, 4] = np.nan
    assert ruggedness.minima(loss).count(0.0) == 2  # nothing is known of what lies between them
    assert ruggedness.minima(np.full((3, 3), np.nan)).count(0.0) == 0


def weierstrass(u: np.ndarray, a: float, b: float) -> np.ndarray:
    """Its Hölder exponent is -ln a / ln b at every point; terms finer than a sample are left out."""
    return sum(a**n * np.cos(b**n * np.pi * u + n) for n in range(40) if b**n < 4 / abs(u[1] - u[0]))


@pytest.mark.parametrize(("a", "b"), [(0.5, 4.0), (0.5, 3.0), (0.7, 3.0), (0.8, 2.0)])
@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_the_exponent_of_weierstrass_function_is_its_own(a: float, b: float, scale: float) -> None:
    u = np.linspace(0, 1, 1025)
    wanted = -math.log(a) / math.log(b)
    loss = scale * weierstrass(u, a, b)
    assert ruggedness.holder_exponent(loss, 0, 0.0) == pytest.approx(wanted, abs=0.07)
    plane = loss[::2, None] + loss[None, ::2] ** 2 / scale
    assert ruggedness.holder_exponent(plane, 0, 0.0) == pytest.approx(wanted, abs=0.1)


def test_the_exponent_of_what_is_smooth_is_one_of_a_jump_a_half_and_of_noise_none() -> None:
    u = np.linspace(-1, 1, 513)
    assert ruggedness.holder_exponent(3 * u, 0, 0.0) == pytest.approx(1.0)
    assert ruggedness.holder_exponent(u**2, 0, 0.0) == pytest.approx(1.0, abs=0.1)
    assert ruggedness.holder_exponent((u > 0.1).astype(float), 0, 0.0) == pytest.approx(0.5, abs=0.03)
    noise = np.random.default_rng(0).standard_normal(513)
    assert ruggedness.holder_exponent(noise, 0, 0.0) == pytest.approx(0.0, abs=0.05)


def test_no_exponent_comes_from_too_few_distances_failures_or_noise() -> None:
    u = np.linspace(-1, 1, 513)
    assert math.isnan(ruggedness.holder_exponent(u[:16], 0, 0.0))  # 1 and 2 steps
    assert math.isnan(ruggedness.holder_exponent(np.zeros(99), 0, 0.0))
    assert math.isnan(ruggedness.holder_exponent(np.full(99, np.nan), 0, 0.0))
    torn = u.copy()
    torn[::7] = np.nan
    assert ruggedness.holder_exponent(torn, 0, 0.0) == pytest.approx(1.0)
    quiet = 1e-3 * u + 1e-5 * np.random.default_rng(0).standard_normal(513)
    assert ruggedness.holder_exponent(quiet, 0, 0.0) < 0.9 < ruggedness.holder_exponent(quiet, 0, 6e-5)


def test_basins_are_the_parts_that_drain_to_each_minimum() -> None:
    u = np.linspace(0, 1, 101)
    loss = np.minimum((u - 0.2) ** 2, 0.01 + (u - 0.7) ** 2)  # they meet at 0.46
    found = ruggedness.minima(loss)
    np.testing.assert_allclose(ruggedness.basins(loss, found.sample), [0.46, 0.54], atol=0.01)


def test_noise_on_a_bowl_makes_minima_and_none_above_its_floor() -> None:
    u, v = grid(48)
    loss = 0.02 * (u**2 + v**2) + 1e-3 * np.random.default_rng(0).normal(size=u.shape)
    floor = 2 * 1e-3 * math.sqrt(2 * math.log(loss.size))
    found = ruggedness.minima(loss)
    assert found.count(0.0) > 50
    assert found.count(floor) == 1


@pytest.mark.parametrize("periods", [10, 20])
def test_correlation_length_of_a_sine_is_in_closed_form(periods: int) -> None:
    u, v = grid(401, 0, 1)
    loss = np.sin(2 * np.pi * periods * u) + 100 * v
    wanted = math.acos(1 / math.e) / (2 * math.pi * periods)  # the autocorrelation is a cosine
    assert ruggedness.correlation_length(loss, axis=1) == pytest.approx(wanted, rel=0.03)


def test_total_variation_counts_the_times_a_line_goes_through_its_range() -> None:
    u, v = grid(41)
    assert ruggedness.total_variation(np.exp(u) + 0 * v, axis=1) == pytest.approx(1)
    assert ruggedness.total_variation(u**2 + v, axis=1) == pytest.approx(2)
    assert math.isnan(ruggedness.total_variation(u, axis=0))


def test_turns_are_seen_however_finely_a_line_is_sampled() -> None:
    assert ruggedness.turns(np.linspace(0, 1, 50) ** 3) == 0
    assert ruggedness.turns(np.array([0.0, 1.0] * 25)) == pytest.approx(48 / 49)
    for points in (100, 1000):
        waves = np.sin(np.linspace(0, 6 * np.pi, points))
        assert ruggedness.turns(waves) == pytest.approx(6 / (points - 1))


def test_information_content_of_a_zigzag_and_of_a_ramp() -> None:
    zigzag = np.array([0.0, 1.0] * 30)  # up-down and down-up, half each
    most, settled = ruggedness.information_content(zigzag)
    assert most == pytest.approx(math.log(2) / math.log(6), abs=1e-3)
    assert 59 <= 10**settled < 59 * 10**0.1  # steps of one range over 1/59 of the box
    assert ruggedness.information_content(np.linspace(0, 1, 60))[0] == pytest.approx(0)


def test_dispersion_tells_one_valley_from_two() -> None:
    u, v = grid(41)
    assert ruggedness.dispersion(u**2 + v**2) < 0.3
    assert ruggedness.dispersion(-((u + v) ** 2)) > 1
    scattered = np.random.default_rng(0).random((41, 41))
    assert ruggedness.dispersion(scattered) == pytest.approx(1, abs=0.15)


def test_fitness_distance_correlation_of_a_cone_is_one() -> None:
    u, v = grid(41)
    assert ruggedness.fitness_distance(np.hypot(u, v)) == pytest.approx(1)
    assert math.isnan(ruggedness.fitness_distance(0 * u))


def test_level_samples_are_those_like_their_neighbours() -> None:
    loss = np.array([0.0, 0.0, 0.0, 0.5, 0.5, np.nan])
    np.testing.assert_array_equal(ruggedness.level_samples(loss, 0.0), [1, 1, 0, 0, 1, np.nan])
    assert np.nansum(ruggedness.level_samples(loss, 0.5)) == 5


def test_a_plateau_is_flat_where_it_is_and_failures_count_as_nothing() -> None:
    def fn(x: torch.Tensor) -> torch.Tensor:
        loss = torch.relu(x[:, 0] - 0.25) + 1e-9 * x[:, 1]
        return torch.where(x[:, 1] > 0.9, torch.nan, loss)

    space = ParameterSpace.box(("x", "y"), 0.0, 1.0)
    dataset = sample(from_torch(fn, space), Plane.through(space, space.center, (0, 1), resolution=24))
    found = ruggedness.ruggedness(dataset, floor=1e-6)
    flat = float((np.linspace(0, 1, 24) < 0.25).mean())
    assert found.flat.value == pytest.approx(flat)
    assert found.zero.value == 0  # it slopes by 1e-9
    assert found.flat.low < flat < found.flat.high
    assert found.failed == 24 * 3  # 0.913, 0.957 and 1 of the upper axis
    assert found.notable == 1
    assert found.total_variation[0].value == pytest.approx(1)


def test_a_slice_that_failed_everywhere_has_no_numbers_and_no_error() -> None:
    space = ParameterSpace.box(("x", "y"), 0.0, 1.0)
    fails = from_torch(lambda x: torch.sqrt(-1 - x.sum(1)), space)
    dataset = sample(fails, Plane.through(space, space.center, (0, 1), resolution=6))
    found = ruggedness.ruggedness(dataset, floor=0.0)
    assert (found.failed, found.minima) == (36, 0)
    assert to_json(found.fitness_distance) == {"value": None, "low": None, "high": None}


@pytest.mark.parametrize("shape", [(40,), (9, 13), (12, 12)])
def test_a_mean_distance_without_pairs_is_that_of_all_pairs(
    monkeypatch: pytest.MonkeyPatch, shape: tuple[int, ...]
) -> None:
    for count in (2, 7, math.prod(shape)):
        places = np.argwhere(np.ones(shape))[np.random.default_rng(0).permutation(math.prod(shape))[:count]]
        by_pairs = ruggedness.mean_distance(places, shape)
        with monkeypatch.context() as patch:
            patch.setattr(ruggedness, "PAIRED", 0)
            assert ruggedness.mean_distance(places, shape) == pytest.approx(by_pairs, rel=1e-13)


def entropy(walks: list[np.ndarray], size: float) -> float:
    """Munoz et al. 2015, eqs. 6 and 7, for one size."""
    counts = np.zeros(9)
    for walk in walks:
        symbol = np.where(np.abs(walk) <= size, 0.0, np.sign(walk))
        both = np.isfinite(walk[:, :-1]) & np.isfinite(walk[:, 1:])
        counts += np.bincount((3 * (symbol[:, :-1] + 1) + symbol[:, 1:] + 1)[both].astype(int), minlength=9)
    shares = counts.reshape(3, 3)[~np.eye(3, dtype=bool)] / counts.sum()
    return float(-(shares[shares > 0] * np.log(shares[shares > 0])).sum() / math.log(6))


def test_the_entropies_of_all_sizes_in_one_pass_are_those_of_each_to_the_bit() -> None:
    random = np.random.default_rng(0)
    walks = [random.normal(size=(5, 30)), np.round(random.normal(size=(30, 4)), 1)]
    walks[0][1, 7] = np.nan
    sizes = np.array([0.0, 0.1, 0.2, 0.7, 1.5, 9.0])
    found = [ruggedness._entropy(counts) for counts in ruggedness._pair_counts(walks, sizes)]
    assert found == [entropy(walks, size) for size in sizes]


def test_a_slice_of_many_samples_is_measured_in_the_memory_that_is_foretold() -> None:
    """All pairs of 96 x 96 samples alone would be 340 MB."""
    space = ParameterSpace.box(["a", "b"], -1.0, 1.0)
    plane = Plane.through(space, space.center, ("a", "b"), resolution=96)
    dataset = SliceStore.in_memory(plane, space).dataset()
    a, b = np.meshgrid(dataset["u"], dataset["v"])
    dataset["loss"].values[...], dataset["grad"].values[...] = np.sin(9 * a) + b**2, 1.0
    tracemalloc.start()
    ruggedness.ruggedness(dataset, floor=0.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < own_cost(dataset["loss"].size)[1]
