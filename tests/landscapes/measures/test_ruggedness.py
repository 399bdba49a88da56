"""Measures of losses on functions whose answers are known."""

import itertools
import math
import tracemalloc
from collections import Counter

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


def test_minima_are_those_of_rastrigin_and_as_deep_as_the_climb_to_a_lower_one() -> None:
    u, v = grid(129, -5.12, 5.12)
    loss = rastrigin(u) + rastrigin(v)
    found = ruggedness.minima(loss)
    assert found.count(0.0) == 11**2  # the whole numbers in its box
    assert found.sample[0] == np.argmin(loss)
    assert found.depth[0] == ruggedness.span(loss)
    line = ruggedness.minima(np.array([3.0, 1.0, 4.0, 0.5, 9.0, 8.0, 8.5]))
    np.testing.assert_array_equal(line.sample, [3, 1, 5])
    np.testing.assert_allclose(line.depth, [8.5, 3.0, 1.0])
    assert [line.count(depth) for depth in (0.0, 2.0, 3.0)] == [3, 2, 1]
    valley = np.full((9, 9), 5.0)
    np.fill_diagonal(valley, 1.0 + np.arange(9) / 100)
    assert ruggedness.minima(valley).count(0.0) == 1  # though it is diagonal
    valley[4, 4] = np.nan
    assert ruggedness.minima(valley).count(0.0) == 2  # nothing is known of what lies between them
    assert ruggedness.minima(np.full((3, 3), np.nan)).count(0.0) == 0


def weierstrass(u: np.ndarray, a: float, b: float) -> np.ndarray:
    """Its Hölder exponent is -ln a / ln b at every point; terms finer than a sample are left out."""
    return sum(a**n * np.cos(b**n * np.pi * u + n) for n in range(40) if b**n < 4 / abs(u[1] - u[0]))


@pytest.mark.parametrize(("a", "b", "scale"), [(0.5, 4.0, 1.0), (0.5, 3.0, 1e-6), (0.7, 3.0, 1.0), (0.8, 2.0, 1e-6)])
def test_the_exponent_of_weierstrass_function_is_its_own(a: float, b: float, scale: float) -> None:
    u = np.linspace(0, 1, 1025)
    wanted = -math.log(a) / math.log(b)
    loss = scale * weierstrass(u, a, b)
    assert ruggedness.holder_exponent(loss, 0, 0.0) == pytest.approx(wanted, abs=0.07)
    plane = loss[::2, None] + loss[None, ::2] ** 2 / scale
    assert ruggedness.holder_exponent(plane, 0, 0.0) == pytest.approx(wanted, abs=0.1)


def test_the_exponent_of_what_is_smooth_is_one_and_none_comes_from_too_few_distances_or_noise() -> None:
    u, exponent = np.linspace(-1, 1, 513), ruggedness.holder_exponent
    assert exponent(3 * u, 0, 0.0) == pytest.approx(1.0)
    assert exponent(u**2, 0, 0.0) == pytest.approx(1.0, abs=0.1)
    assert exponent((u > 0.1).astype(float), 0, 0.0) == pytest.approx(0.5, abs=0.03)
    for nothing in (u[:12], np.zeros(99), np.full(99, np.nan)):  # of the first, 1 and 2 steps
        assert math.isnan(exponent(nothing, 0, 0.0))
    torn = u.copy()
    torn[::7] = np.nan
    assert exponent(torn, 0, 0.0) == pytest.approx(1.0)
    quiet = 1e-3 * u + 1e-5 * np.random.default_rng(0).standard_normal(513)
    assert exponent(quiet, 0, 0.0) < 0.9 < exponent(quiet, 0, 6e-5)


@pytest.mark.parametrize("exponent", [0.3, 0.5, 0.8])
def test_the_exponent_of_an_exact_fractional_surface_is_its_own(exponent: float) -> None:
    """Isotropic fractional Brownian motion, by its covariance (|x|^2H + |y|^2H - |x - y|^2H) / 2."""
    points = np.stack(np.meshgrid(*[np.arange(1, 41)] * 2, indexing="ij"), axis=-1).reshape(-1, 2) / 40
    apart = np.linalg.norm(points[:, None] - points, axis=-1) ** (2 * exponent)
    size = np.linalg.norm(points, axis=1) ** (2 * exponent)
    root = np.linalg.cholesky((size[:, None] + size - apart) / 2 + 1e-12 * np.eye(1600))
    rng = np.random.default_rng(0)
    found = [
        ruggedness.holder_exponent((root @ rng.standard_normal(1600)).reshape(40, 40), axis, 0.0)
        for axis in (0, 1) * 10
    ]
    assert np.nanmean(found) == pytest.approx(exponent, abs=0.06)
    assert np.nanstd(found) < 0.1
    assert np.isfinite(found).mean() > 0.6  # the roughest have correlations that end within three samples


def test_beyond_the_correlation_length_differences_grow_no_more_and_say_nothing() -> None:
    """Rastrigin's function and a sine are smooth: it is 1 where samples resolve them, and unknown where they do not."""
    for points, known in ((24, False), (48, False), (192, True), (384, True)):
        u = rastrigin(np.linspace(-5.12, 5.12, points))
        waves = np.sin(50 * np.linspace(0, 1, points))
        for loss in (u[:, None] + u, waves):
            found = ruggedness.holder_exponent(loss, 0, 0.0)
            assert found == pytest.approx(1.0, abs=0.06) if known else math.isnan(found)
    noise = np.random.default_rng(0).standard_normal((64, 64))
    assert math.isnan(ruggedness.holder_exponent(noise, 0, 0.0))


def test_basins_drain_to_their_minima_and_noise_makes_none_above_its_floor() -> None:
    u = np.linspace(0, 1, 101)
    loss = np.minimum((u - 0.2) ** 2, 0.01 + (u - 0.7) ** 2)  # they meet at 0.46
    np.testing.assert_allclose(ruggedness.basins(loss, ruggedness.minima(loss).sample), [0.46, 0.54], atol=0.01)
    u, v = grid(48)
    found = ruggedness.minima(0.02 * (u**2 + v**2) + 1e-3 * np.random.default_rng(0).normal(size=u.shape))
    assert found.count(0.0) > 50
    assert found.count(2 * 1e-3 * math.sqrt(2 * math.log(48**2))) == 1


def test_measures_of_lines_are_in_closed_form() -> None:
    u, v = grid(401, 0, 1)
    for periods in (10, 20):
        loss = np.sin(2 * np.pi * periods * u) + 100 * v
        wanted = math.acos(1 / math.e) / (2 * math.pi * periods)  # the autocorrelation is a cosine
        assert ruggedness.correlation_length(loss, axis=1) == pytest.approx(wanted, rel=0.03)
    u, v = grid(41)
    assert ruggedness.total_variation(np.exp(u) + 0 * v, axis=1) == pytest.approx(1)
    assert ruggedness.total_variation(u**2 + v, axis=1) == pytest.approx(2)
    assert math.isnan(ruggedness.total_variation(u, axis=0))
    assert ruggedness.turns(np.linspace(0, 1, 50) ** 3) == 0
    assert ruggedness.turns(np.array([0.0, 1.0] * 25)) == pytest.approx(48 / 49)
    for points in (100, 1000):
        waves = np.sin(np.linspace(0, 6 * np.pi, points))
        assert ruggedness.turns(waves) == pytest.approx(6 / (points - 1))
        assert ruggedness.turns(waves, floor=2.1) == 0


def test_measures_of_places_tell_one_valley_from_two() -> None:
    u, v = grid(41)
    assert ruggedness.dispersion(u**2 + v**2) < 0.3
    assert ruggedness.dispersion(-((u + v) ** 2)) > 1
    assert ruggedness.dispersion(np.random.default_rng(0).random((41, 41))) == pytest.approx(1, abs=0.15)
    assert ruggedness.fitness_distance(np.hypot(u, v)) == pytest.approx(1)
    assert math.isnan(ruggedness.fitness_distance(0 * u))
    loss = np.array([0.0, 0.0, 0.0, 0.5, 0.5, np.nan])
    np.testing.assert_array_equal(ruggedness.level_samples(loss, 0.0), [1, 1, 0, 0, 1, np.nan])
    assert np.nansum(ruggedness.level_samples(loss, 0.5)) == 5


def published_information(points: np.ndarray, losses: np.ndarray) -> float:
    """Return h_max as Munoz et al. 2015 write it, by loops over a walk from the first point to the nearest left."""
    left, at, walk = set(range(1, len(points))), 0, [0]
    while left:
        at = min(left, key=lambda one: (float(((points[one] - points[at]) ** 2).sum()), one))
        left.remove(at)
        walk.append(at)
    pairs = list(itertools.pairwise(walk))
    slopes = [(losses[b] - losses[a]) / float(np.linalg.norm(points[b] - points[a])) for a, b in pairs]
    most = 0.0
    for size in [0.0, *np.logspace(-5, 15, 1000)]:
        symbols = [0 if abs(slope) <= size else math.copysign(1, slope) for slope in slopes]
        counts = Counter(itertools.pairwise(symbols))
        shares = [count / (len(symbols) - 1) for (a, b), count in counts.items() if a != b]
        most = max(most, -sum(share * math.log(share, 6) for share in shares))
    return most


def branin(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    x, y = 15 * u - 5, 15 * v
    bent = y - 5.1 * x**2 / (4 * np.pi**2) + 5 * x / np.pi - 6
    return bent**2 + 10 * (1 - 1 / (8 * np.pi)) * np.cos(x) + 10


def test_information_content_is_the_published_one_however_fine_the_slice_is() -> None:
    u, v = grid(17, 0, 1)  # so that distances are exact, and equal where they are
    loss = branin(u, v)
    sample = np.random.default_rng(0).permutation(289)
    points = np.argwhere(np.isfinite(loss))[sample] / 16
    wanted = published_information(points, loss.ravel()[sample])
    assert ruggedness.information_content(loss)[0] == pytest.approx(wanted, rel=1e-12)
    free = np.random.default_rng(1).uniform(size=(8, 400, 2))
    drawn = [published_information(points, branin(*points.T)) for points in free]
    assert np.mean(drawn) == pytest.approx(0.68, abs=0.03)  # not of a slice at all
    for size in (12, 24, 48, 96, 192):
        assert ruggedness.information_content(branin(*grid(size, 0, 1)))[0] == pytest.approx(np.mean(drawn), abs=0.1)


def test_information_content_of_a_line_of_noise_of_a_ramp_and_of_what_is_level() -> None:
    """Of independent values two of three slopes turn, and a ramp turns where the walk has reached its first end."""
    line = np.random.default_rng(0).standard_normal(400)
    assert ruggedness.information_content(line)[0] > 0.75
    assert ruggedness.information_content(np.linspace(0, 1, 400))[0] < 0.03
    assert np.isnan(ruggedness.information_content(np.ones(60))).all()
    assert np.isnan(ruggedness.information_content(np.full(60, np.nan))).all()
    assert ruggedness.information_content(line)[1] > ruggedness.information_content(np.linspace(0, 1, 400))[1]


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
