"""Shapes hold their particles, evenly, and share them by volume."""

import numpy as np
import pytest

from gradscape.envs.mpm.targets import Ball, Box, Ring, fill, shares

BOX, BALL = Box((0.1, 0.2, 0.3), (0.2, 0.4, 0.6)), Ball((0.0, 1.0, 0.0), 0.5)
RING = Ring((1.0, 0.0, 2.0), inner=0.3, outer=0.5, height=0.2)
COUNT = 4096


def inside(shape, x):
    if isinstance(shape, Box):
        return (np.abs(x - shape.center) <= np.divide(shape.widths, 2) + 1e-12).all(axis=1)
    if isinstance(shape, Ball):
        return np.linalg.norm(x - shape.center, axis=1) <= shape.radius + 1e-12
    offset = x - shape.center
    radius = np.hypot(offset[:, 0], offset[:, 2])
    return (radius >= shape.inner) & (radius <= shape.outer) & (offset[:, 1] >= 0) & (offset[:, 1] <= shape.height)


@pytest.mark.parametrize("shape", [BOX, BALL, RING], ids=["box", "ball", "ring"])
def test_particles_fill_a_shape_evenly(shape):
    x, lower, upper = fill(shape, COUNT), *shape.bounds
    assert inside(shape, x).all()
    assert ((x >= lower - 1e-12) & (x <= upper + 1e-12)).all()
    # Against darts thrown at the bounds: the volume, and in any half-space the share of particles.
    darts = lower + np.random.default_rng(0).random((200_000, 3)) * (upper - lower)
    darts = darts[inside(shape, darts)]
    assert shape.volume == pytest.approx(np.prod(upper - lower) * len(darts) / 200_000, rel=0.01)
    for normal in np.random.default_rng(1).standard_normal((20, 3)):
        level = np.quantile(darts @ normal, [0.25, 0.5, 0.75])
        assert np.allclose([(x @ normal < at).mean() for at in level], [0.25, 0.5, 0.75], atol=0.01)


def test_shares_go_by_volume_and_add_up():
    counts = shares([BOX, BALL, RING], 1001)
    assert sum(counts) == 1001
    volumes = np.array([shape.volume for shape in (BOX, BALL, RING)])
    assert np.allclose(counts, 1001 * volumes / volumes.sum(), atol=1)
