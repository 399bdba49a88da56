"""When results of a GPU whose last digits differ every time count as the same."""

import numpy as np
import pytest
from benchmarks.gpu_numbers import POINTS, REPEATS, compare, distance, is_same


def keep(folder, rng, *, noise, shift=0.0):
    """Write results of two checkouts, which differ by noise from one time to the next, and by a shift."""
    for which in ("old", "new"):
        (folder / which).mkdir()
        for fidelity, count in POINTS.items():
            loss, grad = np.linspace(1, 2, count), np.ones((count, 4))
            arrays = {}
            for i in range(REPEATS):
                moved = 1 + (shift if which == "new" else 0.0)
                arrays[f"loss{i}"] = loss * (moved + noise * rng.standard_normal(count))
                arrays[f"grad{i}"] = grad * moved + noise * rng.standard_normal((count, 4))
            np.savez(folder / which / f"fluid-{fidelity}.npz", **arrays)


@pytest.mark.parametrize(("shift", "same"), [(0.0, True), (1e-4, False)])
def test_results_are_the_same_as_far_as_they_are_the_same_themselves(tmp_path, shift, same):
    keep(tmp_path, np.random.default_rng(1), noise=1e-6, shift=shift)
    distances = compare("fluid", tmp_path)
    assert len(distances) == 2 * 2 * len(POINTS)
    assert is_same(distances) is same


def test_results_without_noise_may_differ_by_rounding_only(tmp_path):
    keep(tmp_path, np.random.default_rng(2), noise=0.0, shift=1e-6)
    assert not is_same(compare("fluid", tmp_path))


def test_a_distance_is_relative_and_none_where_both_failed():
    ones = np.array([[3.0, 4.0], [np.nan, 1.0]])
    assert distance(np.array([[3.0, 4.5], [np.nan, 1.0]]), ones).tolist() == [0.1, 0.0]
    assert distance(np.array([1.0, 2.1]), np.array([1.0, 2.0])) == pytest.approx([0.0, 0.05])
