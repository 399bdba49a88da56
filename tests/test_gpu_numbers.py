"""When results of a GPU whose last digits differ count as the same."""

from pathlib import Path

import numpy as np
import pytest
from benchmarks import same_numbers
from benchmarks.gpu_numbers import POINTS, compare, distance, is_same


def keep(folder, rng, *, noise, shift=0.0):
    """Write exact results, and those of two checkouts, which differ by noise, and of the new one by a shift."""
    for which in ("old", "new"):
        (folder / which).mkdir()
    for fidelity, count in POINTS.items():
        exact = {"loss": np.linspace(1, 2, count), "grad": np.ones((count, 4))}
        np.savez(folder / "old" / f"fluid-{fidelity}-float64.npz", **exact)
        for which, factor in (("old", 1.0), ("new", 1.0 + shift)):
            found = {what: factor * one + noise * rng.standard_normal(one.shape) for what, one in exact.items()}
            np.savez(folder / which / f"fluid-{fidelity}-float32.npz", **found)


@pytest.mark.parametrize(("shift", "same"), [(0.0, True), (1e-4, False)])
def test_new_results_are_the_same_as_far_as_the_old_ones_are_exact(tmp_path, shift, same):
    keep(tmp_path, np.random.default_rng(1), noise=1e-6, shift=shift)
    distances = compare("fluid", tmp_path)
    assert len(distances) == 2 * 2 * len(POINTS)
    assert is_same(distances) is same


def test_where_the_old_results_are_exact_new_ones_may_differ_by_rounding_only(tmp_path):
    keep(tmp_path, np.random.default_rng(2), noise=0.0, shift=1e-6)
    assert not is_same(compare("fluid", tmp_path))


def test_a_distance_is_relative_and_none_where_both_failed():
    ones = np.array([[3.0, 4.0], [np.nan, 1.0]])
    assert distance(np.array([[3.0, 4.5], [np.nan, 1.0]]), ones).tolist() == [0.1, 0.0]
    assert distance(np.array([1.0, 2.1]), np.array([1.0, 2.0])) == pytest.approx([0.0, 0.05])


def test_a_kernel_may_change_as_in_a_scene_that_a_gpu_has_held_and_not_otherwise(monkeypatch):
    codes = {
        "old": {"held": {"walk": "a", "tank": "a"}, "likewise": {"walk": "a"}, "other": {"walk": "a", "pin": "a"}},
        "new": {"held": {"walk": "b", "tank": "b"}, "likewise": {"walk": "b"}, "other": {"walk": "b", "pin": "b"}},
    }

    def ask(root, scenes):
        which = "old" if root == Path("old") else "new"
        return {scene: {"draft": "1", "code": which, "known": which} | codes[which][scene] for scene in scenes}

    monkeypatch.setattr(same_numbers, "ask", ask)
    gpu, held = {"old": "old", "new": "new", "distances": {"draft loss median": (1e-6, 1e-6)}}, set()
    assert not same_numbers.is_same("likewise", Path("old"), {}, held)
    assert same_numbers.is_same("held", Path("old"), gpu, held)
    assert same_numbers.is_same("likewise", Path("old"), {}, held)
    assert not same_numbers.is_same("other", Path("old"), {}, held)
    assert not same_numbers.is_same("likewise", Path("old"), gpu | {"new": "other"}, set())
