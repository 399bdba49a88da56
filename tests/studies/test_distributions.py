"""Distances of distributions of losses, against closed forms and the noise of two samples."""

import numpy as np
import pytest
from scipy.stats import ks_2samp, wasserstein_distance

from gradscape.studies.divergence import compare_distributions, distances


def test_distances_of_uniform_samples_are_the_closed_forms() -> None:
    """Of U(0, 1) and U(s, 1 + s): Kolmogorov's is s, Wasserstein's is s."""
    grid = (np.arange(1000) + 0.5) / 1000
    for shift in (0.1, 0.5):
        kolmogorov, wasserstein = distances(grid, grid + shift, scale=2.0)
        assert kolmogorov == pytest.approx(shift, abs=2e-3)
        assert wasserstein == pytest.approx(shift / 2, rel=1e-9)


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
