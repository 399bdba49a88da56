"""Directions against closed forms: a quadratic in a box of unequal sides."""

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.landscapes.directions import gradient_directions, hessian_directions, random_directions

WIDTHS = torch.tensor([1.0, 2.0, 0.5, 4.0, 10.0, 1e-3], dtype=torch.float64)
SPACE = gs.ParameterSpace([f"p{k}" for k in range(6)], -WIDTHS / 2, WIDTHS / 2, [""] * 6)
VALUES = np.array([-7.0, 5.0, 2.0, 1.0, -0.5, 0.1])
VECTORS = np.linalg.qr(np.random.default_rng(3).standard_normal((6, 6)))[0].T
HESSIAN = torch.from_numpy(VECTORS.T @ np.diag(VALUES) @ VECTORS)
SLOPE = torch.linspace(1, 2, 6, dtype=torch.float64)


def bowl(x: torch.Tensor) -> torch.Tensor:
    u = x / WIDTHS
    return (u @ HESSIAN * u).sum(dim=1) / 2 + u @ SLOPE


QUADRATIC = gs.from_torch(bowl, SPACE)


def cube(directions: torch.Tensor) -> np.ndarray:
    return (directions / WIDTHS).numpy()


@pytest.mark.parametrize("point", [SPACE.center, SPACE.uniform(1, seed=4)[0], SPACE.upper])
def test_the_hessian_s_directions_are_a_quadratic_s_eigenvectors(point):
    directions, values = hessian_directions(QUADRATIC, point)
    np.testing.assert_allclose(values, VALUES[:2], rtol=1e-3)
    for found, wanted in zip(cube(directions), VECTORS[:2], strict=True):
        assert abs(abs(found @ wanted) - 1) < 1e-3
        assert found[np.abs(found).argmax()] > 0


@pytest.mark.parametrize("dim", [2, 3])
def test_of_few_parameters_too(dim):
    space = gs.ParameterSpace.box([f"p{k}" for k in range(dim)], -1.0, 1.0)
    scale = torch.arange(dim, 0, -1).double()
    directions, values = hessian_directions(gs.from_torch(lambda x: (scale * x**2).sum(dim=1) / 2, space), space.center)
    np.testing.assert_allclose(values, 4 * scale[:2])  # sides are two
    np.testing.assert_allclose(directions / 2, np.eye(dim)[:2], atol=1e-6)


def test_the_gradient_comes_first_and_what_changes_it_most_second():
    point = SPACE.uniform(1, seed=5)[0]
    first, second = cube(gradient_directions(QUADRATIC, point))
    here = (HESSIAN @ (point / WIDTHS) + SLOPE).numpy()
    np.testing.assert_allclose(first, here / np.linalg.norm(here), atol=1e-6)
    assert abs(first @ second) < 1e-9
    assert np.linalg.norm(second) == pytest.approx(1)
    beside = np.eye(6) - np.outer(first, first)
    squared = HESSIAN.numpy() @ HESSIAN.numpy()
    wanted = np.linalg.eigvalsh(beside @ squared @ beside).max()
    assert second @ squared @ second == pytest.approx(wanted, rel=1e-5)


def test_random_directions_are_orthonormal_in_the_cube_and_the_seed_s():
    directions = cube(random_directions(SPACE, 7))
    np.testing.assert_allclose(directions @ directions.T, np.eye(2), atol=1e-12)
    assert torch.equal(random_directions(SPACE, 7), random_directions(SPACE, 7))
    assert not torch.equal(random_directions(SPACE, 7), random_directions(SPACE, 8))


def test_where_there_is_nothing_to_follow_it_is_said():
    flat = gs.from_torch(lambda x: 0 * x.sum(dim=1), SPACE)
    with pytest.raises(ValueError, match="has a gradient of zero there"):
        gradient_directions(flat, SPACE.center)
    ramp = gs.from_torch(lambda x: x.sum(dim=1), SPACE)
    with pytest.raises(ValueError, match="no curvature beside its gradient"):
        gradient_directions(ramp, SPACE.center)
    torn = gs.from_torch(lambda x: x.sum(dim=1) * torch.nan, SPACE)
    with pytest.raises(ValueError, match="no finite gradient there"):
        hessian_directions(torn, SPACE.center)
    line = gs.ParameterSpace.box(["x"], 0.0, 1.0)
    with pytest.raises(ValueError, match="two parameters"):
        random_directions(line, 0)
