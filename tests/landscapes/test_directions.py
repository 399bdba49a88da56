"""Directions to cut along, held against quadratics and a double well."""

import numpy as np
import pytest
import torch

from gradscape.envs.adapters import from_torch
from gradscape.jobs.cut import PlaneSpec, points_in
from gradscape.landscapes.directions import (
    barrier,
    gradient_directions,
    hessian_directions,
    joining,
    random_directions,
)
from gradscape.landscapes.space import ParameterSpace

DIM = 6
SPECTRUM = torch.tensor([9.0, -5.0, 2.0, 1.0, 0.5, 0.1], dtype=torch.float64)
SPACE = ParameterSpace(tuple("abcdef"), torch.zeros(DIM), torch.tensor([1.0, 2.0, 3.0, 0.5, 10.0, 0.1]), ("",) * DIM)
FRAME = torch.linalg.qr(torch.randn(DIM, DIM, generator=torch.Generator().manual_seed(0), dtype=torch.float64))[0]
HESSIAN = FRAME @ torch.diag(SPECTRUM) @ FRAME.T
POINT = SPACE.from_unit(torch.linspace(0.2, 0.7, DIM, dtype=torch.float64))


def quadratic():
    return from_torch(lambda x: 0.5 * ((z := SPACE.to_unit(x)) @ HESSIAN * z).sum(dim=-1), SPACE)


def test_hessian_directions_are_a_quadratics_eigenvectors():
    found, labels = hessian_directions(quadratic(), POINT)
    overlap = np.abs(found @ FRAME[:, :2].numpy())
    np.testing.assert_allclose(overlap, np.eye(2), atol=1e-3)
    assert "curvature 9 " in labels[0]
    assert "curvature -5 " in labels[1]
    assert np.array_equal(found, hessian_directions(quadratic(), POINT)[0])


def test_gradient_directions_of_a_quadratic():
    found, _ = gradient_directions(quadratic(), POINT)
    g = HESSIAN @ SPACE.to_unit(POINT)
    first = g / g.norm()
    second = HESSIAN @ first - (first @ HESSIAN @ first) * first
    np.testing.assert_allclose(found, torch.stack([first, second / second.norm()]), atol=1e-6)


def test_random_directions_are_orthonormal_and_seeded():
    first, again, other = (random_directions(SPACE, seed)[0] for seed in (3, 3, 4))
    np.testing.assert_allclose(first @ first.T, np.eye(2), atol=1e-12)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_barrier_of_a_double_well():
    space = ParameterSpace.box(("x", "y"), -2.0, 2.0)
    ends = [torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 0.0])]
    line = joining(space, ends, ["A", "B"], 21)
    u = line.axes()[0]
    x = line.lift(u[:, None])[:, 0]
    loss = (x**2 - 1) ** 2 + 0.25 * x  # tilted by what the straight line takes away
    assert barrier(u.numpy(), loss.numpy()) == pytest.approx(1.0)
    assert np.isnan(barrier(u.numpy(), np.where(u.numpy() > 0.5, np.nan, loss.numpy())))


def test_points_take_their_own_colons():
    assert points_in("a.npy:b.npy") == ["a.npy", "b.npy"]
    assert points_in("center:example:aim:random:2") == ["center", "example:aim", "random:2"]


def test_refusals():
    flat = from_torch(lambda x: 0 * x.sum(dim=-1), SPACE)
    for make in (gradient_directions, hessian_directions):
        with pytest.raises(ValueError, match="at this point"):
            make(flat, POINT)
    for dims, along in ((None, None), ((0, 1), "hessian"), (None, "nowhere")):
        with pytest.raises(ValueError, match="--along"):
            PlaneSpec(dims, along, "center", None, 5).make(flat)
