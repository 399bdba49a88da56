"""Distances of the ladle's parts against the nearest of densely sampled surface points."""

import math

import pytest
import torch
import warp as wp

from gradscape.envs.engines.runtime import precision
from gradscape.envs.engines.sdf import bowl, rod

RADIUS, THICKNESS, HEIGHT = 0.07, 0.01, 0.25
SPACING = 6e-4  # of sampled points [m]


def hemisphere():
    """Sample the bowl's mid-surface: the lower half of a sphere, its rim included."""
    polar = torch.linspace(math.pi / 2, math.pi, round(RADIUS * math.pi / 2 / SPACING), dtype=torch.float64)
    around = torch.linspace(0, 2 * math.pi, round(RADIUS * 2 * math.pi / SPACING), dtype=torch.float64)
    p, a = torch.meshgrid(polar, around, indexing="ij")
    return RADIUS * torch.stack([p.sin() * a.cos(), p.cos(), p.sin() * a.sin()], dim=-1).reshape(-1, 3)


def axis():
    """Sample the middle of the rod."""
    y = torch.linspace(0, HEIGHT, round(HEIGHT / SPACING), dtype=torch.float64)
    return torch.stack([torch.zeros_like(y), y, torch.zeros_like(y)], dim=-1)


SHAPES = {"bowl": (bowl, hemisphere, RADIUS, THICKNESS), "rod": (rod, axis, HEIGHT, THICKNESS)}


def measured(shape, points, name="float64"):
    """Return (normals, distances) of points."""
    function, _, size, thickness = SHAPES[shape]
    types = precision(name)
    distance, real, vec3, vec4 = function(name), types.real, types.vec3, types.vec4

    @wp.kernel(module="unique")
    def measure(points: wp.array[vec3], size: real, thickness: real, hits: wp.array[vec4]):
        i = wp.tid()
        hits[i] = distance(points[i], size, thickness)

    hits = wp.zeros(len(points), dtype=vec4)
    inputs = [wp.array(points.to(types.torch).numpy(), dtype=vec3), size, thickness, hits]
    wp.launch(measure, len(points), inputs, record_tape=False)
    result = torch.from_numpy(hits.numpy()).double()
    return result[:, :3], result[:, 3]


@pytest.fixture(scope="module")
def points():
    unit = torch.rand((400, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    return unit * torch.tensor([0.3, 0.5, 0.3], dtype=torch.float64) + torch.tensor([0.0, 0.05, 0.0])


@pytest.mark.parametrize("shape", SHAPES)
def test_distance_and_normal_lead_to_the_nearest_surface_point(shape, points):
    normal, distance = measured(shape, points)
    skeleton = SHAPES[shape][1]()
    gap, nearest = torch.cdist(points, skeleton).min(dim=1)
    # The nearest sample is at most half a spacing's diagonal beside the nearest point, on a surface that curves away.
    exact = distance + THICKNESS
    slack = (SPACING / math.sqrt(2)) ** 2 / (2 * exact) * (1 + exact / SHAPES[shape][2])
    assert (distance <= gap - THICKNESS + 1e-9).all()
    assert (gap - THICKNESS - distance <= slack + 1e-9).all()
    clear = gap > 0.02
    outward = (points - skeleton[nearest]) / gap[:, None]
    assert clear.sum() > 100
    assert ((normal - outward)[clear].norm(dim=1) < SPACING / 0.02).all()


@pytest.mark.parametrize("shape", SHAPES)
def test_normals_are_unit_vectors_and_the_slope_of_the_distance(shape, points):
    normal, distance = measured(shape, points)
    away = distance + THICKNESS > 2e-3  # the distance has a kink on the skeleton
    assert away.sum() > 350
    step = 1e-6
    shifts = step * torch.eye(3, dtype=torch.float64)
    ends = [[measured(shape, points + sign * shift)[1] for shift in shifts] for sign in (1, -1)]
    slope = torch.stack([(up - down) / (2 * step) for up, down in zip(*ends, strict=True)], dim=1)
    torch.testing.assert_close(normal[away].norm(dim=1), torch.ones(int(away.sum())).double(), rtol=0, atol=1e-6)
    torch.testing.assert_close(slope[away], normal[away], rtol=0, atol=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_single_precision_is_close(shape, points):
    normal, distance = measured(shape, points)
    normal32, distance32 = measured(shape, points, "float32")
    away = distance + THICKNESS > 2e-3
    torch.testing.assert_close(distance32, distance, rtol=0, atol=2e-6)
    torch.testing.assert_close(normal32[away], normal[away], rtol=0, atol=2e-4)


@pytest.mark.parametrize("shape", SHAPES)
def test_centre_and_axis_have_finite_distances(shape):
    centres = torch.tensor([[0.0, 0.0, 0.0], [0.0, -0.03, 0.0], [0.0, 0.1, 0.0], [0.0, HEIGHT, 0.0]])
    normal, distance = measured(shape, centres)
    assert normal.isfinite().all()
    assert distance.isfinite().all()
