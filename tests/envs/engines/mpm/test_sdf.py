"""Distances of tools against samples of what lies in the middle of their shells, and a cylinder against its corners."""

import math

import pytest
import torch
import warp as wp

from gradscape.envs.engines.mpm.boundaries import shapes
from gradscape.envs.engines.runtime import precision

from ..bench import draw

RADIUS, THICKNESS, HEIGHT = 0.07, 0.01, 0.25
AXIS = (0.48, 0.6, -0.64)  # a unit vector
BALL, REACH, RING, TUBE, HALF = 0.07, 0.08, 0.09, 0.04, 0.06
SPACING = 6e-4  # of sampled points [m]


def turned(radius, height, reach):
    """Return the surface that a curve sweeps about the y axis, of points no farther apart than `reach` has room for."""
    around = torch.linspace(0, 2 * math.pi, round(2 * math.pi * reach / SPACING), dtype=torch.float64)
    parts = torch.broadcast_tensors(radius[:, None] * around.cos(), height[:, None], radius[:, None] * around.sin())
    return torch.stack(parts, dim=-1).reshape(-1, 3)


def segment(start, end):
    start, end = (torch.tensor(point, dtype=torch.float64) for point in (start, end))
    return torch.lerp(start, end, torch.linspace(0, 1, round(float((end - start).norm()) / SPACING)).double()[:, None])


def hemisphere():
    """Sample the bowl's mid-surface: the lower half of a sphere, its rim included."""
    polar = torch.linspace(math.pi / 2, math.pi, round(RADIUS * math.pi / 2 / SPACING), dtype=torch.float64)
    return turned(RADIUS * polar.sin(), RADIUS * polar.cos(), RADIUS)


def circle():
    return turned(torch.tensor([RING], dtype=torch.float64), torch.zeros(1, dtype=torch.float64), RING)


# Of each shape its sizes, samples of its middle, how far its surface is from that, and the middle's radius of bend.
SHELLS = {
    "sphere": ((BALL,), lambda: torch.zeros(1, 3, dtype=torch.float64), BALL, math.inf),
    "capsule": (
        (AXIS, REACH, TUBE),
        lambda: segment([-REACH * a for a in AXIS], [REACH * a for a in AXIS]),
        TUBE,
        math.inf,
    ),
    "torus": ((RING, TUBE), circle, TUBE, RING),
    "bowl": ((RADIUS, THICKNESS), hemisphere, THICKNESS, RADIUS),
    "rod": ((HEIGHT, THICKNESS), lambda: segment((0.0, 0.0, 0.0), (0.0, HEIGHT, 0.0)), THICKNESS, math.inf),
}
SIZES = {shape: sizes for shape, (sizes, *_) in SHELLS.items()} | {"cylinder": (BALL, HALF)}


def hits(shape, points, name="float64"):
    """Return (normals, distances) of points."""
    types = precision(name)
    sizes = [types.vec3(*size) if isinstance(size, tuple) else types.real(size) for size in SIZES[shape]]
    array = wp.array(points.to(types.torch).contiguous().numpy(), dtype=types.vec3)
    result = torch.from_numpy(wp.map(getattr(shapes(name), shape), array, *sizes).numpy()).double()
    return result[:, :3], result[:, 3]


@pytest.fixture(scope="module")
def points():
    return draw(400, 3, seed=0) * torch.tensor([0.3, 0.5, 0.3], dtype=torch.float64) + torch.tensor([0.0, 0.05, 0.0])


@pytest.mark.parametrize("shape", SHELLS)
def test_distance_and_normal_lead_to_the_nearest_surface_point(shape, points):
    normal, distance = hits(shape, points)
    _, sample, thickness, bend = SHELLS[shape]
    middle = sample()
    gap, nearest = torch.cdist(points, middle).min(dim=1)
    # The nearest sample is at most half a spacing's diagonal beside the nearest point, on a surface that curves away.
    exact = distance + thickness
    slack = (SPACING / math.sqrt(2)) ** 2 / (2 * exact) * (1 + exact / bend)
    assert (exact <= gap + 1e-9).all()
    assert (gap - exact <= slack + 1e-9).all()
    clear = gap > 0.02
    outward = (points - middle[nearest]) / gap[:, None]
    assert clear.sum() > 100
    assert ((normal - outward)[clear].norm(dim=1) < SPACING / 0.02).all()


def test_a_cylinders_distance_is_that_of_a_rectangle_that_turns(points):
    """In the plane of its axis: outside, to what of the rectangle is nearest; inside, to the nearest of its sides."""
    normal, distance = hits("cylinder", points)
    beyond = torch.stack([points[:, [0, 2]].norm(dim=1) - BALL, points[:, 1].abs() - HALF], dim=1)
    wanted = beyond.clamp_min(0).norm(dim=1) + beyond.amax(dim=1).clamp_max(0)
    torch.testing.assert_close(distance, wanted, rtol=0, atol=1e-6)
    assert (distance < 0).sum() > 8
    _, left = hits("cylinder", points - distance[:, None] * normal)
    assert left.abs().max() < 2e-6  # sqrt(TINY) where it leads to an edge


@pytest.mark.parametrize("shape", SIZES)
def test_single_precision_is_close(shape, points):
    normal, distance = hits(shape, points)
    normal32, distance32 = hits(shape, points, "float32")
    clear = (normal32 - normal).abs().amax(dim=1) < 2e-4
    torch.testing.assert_close(distance32, distance, rtol=0, atol=2e-6)
    assert clear.sum() > 390  # the others are where it turns


@pytest.mark.parametrize("shape", SIZES)
def test_normals_are_unit_vectors_and_the_slope_of_the_distance(shape, points):
    normal, middle = hits(shape, points)
    torch.testing.assert_close(normal.norm(dim=1), torch.ones_like(middle), rtol=0, atol=1e-5)
    step, slopes = 1e-6, []
    for sign in (1, -1):
        shifts = sign * step * torch.eye(3, dtype=torch.float64)
        ends = [hits(shape, points + shift)[1] for shift in shifts]
        slopes.append(torch.stack([sign * (end - middle) / step for end in ends], dim=1))
    smooth = (slopes[0] - slopes[1]).abs().amax(dim=1) < 1e-3  # no kink between the ends
    assert smooth.sum() > 350
    torch.testing.assert_close((sum(slopes) / 2)[smooth], normal[smooth], rtol=0, atol=1e-6)


@pytest.mark.parametrize("shape", SIZES)
def test_a_middle_and_an_axis_have_a_finite_normal(shape):
    middles = torch.tensor([[0.0, y, 0.0] for y in (0.0, 0.02, -0.03, 0.1, HEIGHT)] + [[RING, 0.0, 0.0]])
    assert all(part.isfinite().all() for part in hits(shape, middles))
