"""Exploratory features: those of pflacco on the same samples of BBOB, and closed forms."""

import json
import math
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gradscape.landscapes.measures.exploratory import (
    Exploratory,
    FitnessDistance,
    InformationContent,
    LevelSets,
    LossDistribution,
    MetaModels,
    NearestBetter,
    distances_of,
)
from gradscape.landscapes.space import sobol

CASES: list[dict[str, Any]] = json.loads(Path(__file__).with_name("pflacco.json").read_text())["cases"]
SHORT = ("fd_correlation", "fd_cov")  # pflacco divides by n, and deviations by n - 1
OURS_ALONE = "ela_distr.number_of_peaks"


def points(dim: int, *, seed: int = 0) -> NDArray[np.float64]:
    return sobol(50 * dim, dim, seed=seed).numpy()


def by_name(found: Exploratory) -> dict[str, float]:
    return {f"{group}.{name}": value for group, part in asdict(found).items() for name, value in part.items()}


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"f{case['function']}-{case['dim']}")
def test_features_are_those_of_pflacco(case: dict[str, Any]) -> None:
    """On BBOB (ioh), the sample drawn again; all but the peaks, which the next test explains."""
    x, y = -5 + 10 * points(case["dim"], seed=case["seed"]), np.array(case["y"])
    ours, compared = by_name(Exploratory.of(x, y)), 0
    for name, value in case["features"].items():
        group, field = name.split(".", 1)
        ours_here = ours[f"{group}.{field.replace('.', '_').lower()}"]
        if name == OURS_ALONE:
            continue
        n = round(0.1 * len(y)) if group == "fitness_distance" else len(y)
        theirs = math.nan if value is None else value * (n / (n - 1) if field in SHORT else 1)
        assert ours_here == pytest.approx(theirs, rel=1e-4, abs=1e-6, nan_ok=True), name
        compared += 1
    assert compared == len(ours) - 1 == 66


def test_peaks_differ_from_pflacco_where_it_adds_what_is_to_be_multiplied() -> None:
    """Its mass of a peak is mean density plus width; with that, its number comes out in all cases."""
    from scipy.stats import gaussian_kde

    def theirs(y: NDArray[np.float64]) -> int:
        kernel = gaussian_kde(y)
        beyond = 3 * kernel.covariance_factor() * y.std(ddof=1)
        at = np.linspace(y.min() - beyond, y.max() + beyond, 512)
        density = kernel(at)
        valleys = (density[1:-2] < density[:-3]) & (density[1:-2] < density[2:-1])
        ends = [0, *(np.flatnonzero(valleys) + 1), 512]
        return sum(density[low : high - 1].mean() + at[high - 1] - at[low] > 0.1 for low, high in pairwise(ends))

    assert all(theirs(np.array(case["y"])) == case["features"][OURS_ALONE] for case in CASES)


def test_peaks_are_the_levels_of_a_staircase() -> None:
    levels = np.repeat([0.0, 1.0, 2.0], 100) + np.random.default_rng(0).normal(0, 0.05, 300)
    assert LossDistribution.of(levels).number_of_peaks == 3
    assert LossDistribution.of(1e6 * levels).number_of_peaks == 3  # in any unit
    assert LossDistribution.of(np.append(levels, 9.0)).number_of_peaks == 3  # one loss alone is no peak


def test_models_explain_what_they_can_express_unless_their_coefficients_are_too_many() -> None:
    """With all products 2 d^2 + d coefficients, at 50 d points: too many from 25 parameters on."""
    x = points(3)
    plane = MetaModels.of(x, x @ [1.0, -2.0, 4.0] + 7)
    found = plane.lin_simple_adj_r2, plane.lin_simple_intercept, plane.lin_simple_coef_max_by_min
    assert found == pytest.approx((1, 7, 4))
    product = MetaModels.of(x, (x[:, 0] - 0.5) * (x[:, 1] - 0.5))
    assert product.quad_simple_adj_r2 < 0.1 < 0.9 < product.lin_w_interact_adj_r2
    assert math.isfinite(MetaModels.of(points(24), points(24).sum(axis=1)).quad_w_interact_adj_r2)
    many = MetaModels.of(points(25), np.square(points(25)).sum(axis=1))
    assert math.isnan(many.quad_w_interact_adj_r2)
    assert many.quad_simple_adj_r2 == pytest.approx(1)


def test_a_cone_and_one_funnel_are_told_from_noise() -> None:
    x, noise = points(2), np.random.default_rng(0).normal(size=100)
    assert FitnessDistance.of(x, np.linalg.norm(x - x[17], axis=1), 1.0).fd_correlation == pytest.approx(1)
    assert abs(FitnessDistance.of(x, noise, 1.0).fd_correlation) < 0.3
    bowl, rough = (NearestBetter.of(distances_of(x), y) for y in (np.square(x - 0.5).sum(axis=1), noise))
    assert bowl.nn_nb_mean_ratio > 0.8 > rough.nn_nb_mean_ratio


def test_information_content_of_a_ramp_and_of_alternation() -> None:
    """A tour along a line: up all the way; and up and down in turn, whose two pairs have log_6 2 of entropy."""
    x = np.arange(101.0)[:, None]
    ramp, saw = (InformationContent.of(distances_of(x), y) for y in (x[:, 0], np.arange(101) % 2.0))
    assert (ramp.h_max, ramp.m0) == (0, 0)
    assert saw.h_max == pytest.approx(math.log(2) / math.log(6), abs=1e-3)
    assert saw.m0 == pytest.approx(1)
    assert saw.eps_s == pytest.approx(0, abs=0.03)  # all steps are 1 long and 1 high


def test_level_sets_lie_behind_a_plane_or_within_a_circle() -> None:
    """Of 200 points in 40 parameters a tenth is low: fewer than a quadratic discriminant takes."""
    x = points(2)
    plane, circle = LevelSets.of(x, x @ [1.0, 2.0]), LevelSets.of(x, np.square(x - 0.5).sum(axis=1))
    assert plane.mmce_lda_50 < 0.1
    assert circle.mmce_qda_50 < 0.15 < 0.35 < circle.mmce_lda_50
    many = sobol(200, 40, seed=0).numpy()
    few = LevelSets.of(many, many[:, 0])
    assert math.isnan(few.mmce_qda_10)
    assert math.isfinite(few.mmce_lda_10)
    assert few.mmce_qda_50 > few.mmce_lda_50


def test_intervals_are_as_wide_as_the_scatter_of_samples() -> None:
    """The slope of a plane with noise of 0.5 at 100 points has a deviation of 0.17, 0.39 with Student's factor."""
    missed, reaches = 0, list[float]()
    for seed in range(24):
        x = np.random.default_rng(seed).random((100, 2))
        y = x @ [4.0, 1.0] + np.random.default_rng(seed + 999).normal(0, 0.5, 100)
        found, reach = MetaModels.of(x, y), Exploratory.reach(x, y).ela_meta
        missed += abs(found.lin_simple_coef_max - 4) > reach.lin_simple_coef_max
        reaches.append(reach.lin_simple_coef_max)
    assert missed <= 5  # 1.2 are expected; P(more than 5) = 0.001
    assert np.mean(reaches) == pytest.approx(0.39, rel=0.25)
