"""Gradient quality on functions whose slopes, and whose smoothed slopes, are known."""

import math

import numpy as np
import pytest
import torch

from gradscape import ParameterSpace, Plane, from_numpy, from_torch, sample
from gradscape.landscapes.measures import gradient_quality as gradients
from gradscape.landscapes.objective import Objective

SPACE = ParameterSpace.box(("x", "y"), -1.0, 3.0)
PLANE = Plane.through(SPACE, SPACE.center, (0, 1), resolution=12)


def rows_of(objective: Objective, points: int) -> dict[float, gradients.ScaleRow]:
    found = gradients.compare_differences(objective, PLANE, gradients.subgrid(PLANE, points))
    return {row.scale: row for row in gradients.scale_table(found)}


def test_a_quadratic_agrees_at_every_scale_and_at_the_samples_that_have_neighbours() -> None:
    assert gradients.subgrid(PLANE, 2).tolist() == [[0, 0], [2, 0], [0, 2], [2, 2]]  # u fastest
    objective = from_torch(lambda x: (x[:, 0] - 0.3) ** 2 + 5 * x[:, 1] ** 2, SPACE)
    for row in rows_of(objective, 3).values():
        assert row.cosine.value == pytest.approx(1)
        assert row.error < 1e-7
    free = gradients.compare_samples(sample(objective, PLANE))["cosine"].sel(scale=2 / 11)
    np.testing.assert_allclose(free[1:-1, 1:-1], 1)
    assert bool(free[0].isnull().all())


def test_wrong_signs_point_uphill_and_fine_ripples_mislead_at_the_scale_of_a_picture() -> None:
    for row in rows_of(from_numpy(lambda x: ((x**2).sum(axis=1), -2 * x), SPACE), 4).values():
        assert (row.cosine.value, row.error) == pytest.approx((-1, 2))
        assert (row.uphill.value, row.sign.value) == (1, 0)
    rippled = rows_of(from_torch(lambda x: (x**2 + 1e-2 * torch.sin(1e4 * x)).sum(1), SPACE), 5)
    assert rippled[1e-6].cosine.value == pytest.approx(1, abs=1e-3)
    assert abs(rippled[1e-2].cosine.value) < 0.5


def test_slopes_below_the_noise_are_not_judged() -> None:
    slope, difference = (
        np.array([[1.0, 0.0], [1e-3, 0.0], [0.0, 0.0]]),
        np.array([[0.9, 0.0], [-1e-3, 0.0], [0.0, 0.0]]),
    )
    found = gradients.agreement(slope, difference, noise=0.01)
    np.testing.assert_array_equal(np.isfinite(found["cosine"]), [True, False, False])
    assert found["sign"][0] == 1  # the second axis shows nothing
    unseen = gradients.agreement(np.zeros((1, 2)), np.ones((1, 2)), noise=0.01)
    assert (unseen["cosine"][0], unseen["error"][0]) == (0, 1)


def test_both_orders_are_exact_on_a_linear_function_and_zeroth_order_has_its_known_variance() -> None:
    linear = from_torch(lambda x: 2 * x[:, 0] - x[:, 1], SPACE)
    found = gradients.smoothed_slopes(linear, PLANE, gradients.subgrid(PLANE, 2))
    for name in ("first", "zeroth"):
        np.testing.assert_allclose(found[name], np.broadcast_to([8, -4], found[name].shape))  # per side of the box
    np.testing.assert_allclose(found["first_variance"], 0, atol=1e-20)
    assert not bool(gradients.find_bias(found).any())
    line = ParameterSpace.box(("x",), 0.0, 1.0)
    plane = Plane.through(line, line.center, (0,), resolution=3)
    slope = from_torch(lambda x: 3 * x[:, 0], line)
    found = gradients.smoothed_slopes(slope, plane, torch.tensor([[0.5]]).double(), pairs=20000)
    np.testing.assert_allclose(found["zeroth_variance"], 2 * 3**2, rtol=0.06)  # of 3 w^2


@pytest.mark.parametrize("offset", [0.0, 0.01, 0.02])
def test_first_order_misses_a_step_by_the_slope_of_the_smoothed_one(offset: float) -> None:
    line = ParameterSpace.box(("x",), 0.0, 2.0)
    plane = Plane.through(line, line.center, (0,), resolution=3)
    step = from_torch(lambda x: 5.0 * (x[:, 0] > 1.0) + 0 * x[:, 0], line)
    u = torch.tensor([[1.0 + 2 * offset]]).double()
    found = gradients.smoothed_slopes(step, plane, u, widths=(0.02,), pairs=4000)
    wanted = 5 * math.exp(-((offset / 0.02) ** 2) / 2) / (0.02 * math.sqrt(2 * math.pi))
    bias, error = (found[name].item() for name in ("bias", "bias_error"))
    assert found["first"].item() == 0
    assert bias == pytest.approx(-wanted, abs=4 * error)
    assert error < 0.05 * wanted
    assert bool(gradients.find_bias(found).all())
    assert gradients.disagreement(found).item() == 1


def test_a_smooth_function_is_hardly_ever_called_biased() -> None:
    waves = from_torch(lambda x: (x**2 - torch.cos(4 * x)).sum(1), SPACE)
    found = gradients.smoothed_slopes(waves, PLANE, gradients.subgrid(PLANE, 10), pairs=12)
    assert int(gradients.find_bias(found).sum()) <= 2  # of 200
    first = found["first"].sel(width=0.01).to_numpy()
    x = found["place"].to_numpy()
    exact = 4 * (2 * x + 4 * np.exp(-(0.16**2) / 2) * np.sin(4 * x))  # E sin(4 (x + s w)) has a factor exp(-(4 s)^2/2)
    np.testing.assert_allclose(first, exact, atol=1.0)
    np.testing.assert_allclose(found["zeroth"].sel(width=0.01), exact, atol=1.0)


def test_failed_samples_are_left_out_and_too_few_say_nothing() -> None:
    half = from_torch(lambda x: torch.where(x[:, 0] < 1, torch.nan, x.sum(1)), SPACE)
    u = torch.tensor([[1.02, 1.0], [-0.5, 1.0]]).double()
    found = gradients.smoothed_slopes(half, PLANE, u, widths=(0.01,))
    assert 3 < int(found["count"][0, 0]) < 16
    np.testing.assert_allclose(found["zeroth"][0, 0], [4, 4])
    assert bool(found["zeroth"][0, 1].isnull().all())
    assert gradients.width_table(found)[0].points == 1
