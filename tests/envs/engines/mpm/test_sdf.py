"""Distances of tools against the nearest of densely sampled points of their surfaces, or of the ladle's skeletons."""

import math

import pytest
import torch
import warp as wp

from gradscape.envs.engines.mpm.boundaries import shapes
from gradscape.envs.engines.runtime import precision

from ..bench import draw

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


SHAPES = {"bowl": ("bowl", hemisphere, RADIUS, THICKNESS), "rod": ("rod", axis, HEIGHT, THICKNESS)}


def measured(shape, points, name="float64"):
    """Return (normals, distances) of points."""
    function, _, size, thickness = SHAPES[shape]
    return hits(function, (size, thickness), points, name)


def hits(function, sizes, points, name="float64"):
    types = precision(name)
    sizes = [types.vec3(*size) if isinstance(size, tuple) else types.real(size) for size in sizes]
    array = wp.array(points.to(types.torch).contiguous().numpy(), dtype=types.vec3)
    result = torch.from_numpy(wp.map(getattr(shapes(name), function), array, *sizes).numpy()).double()
    return result[:, :3], result[:, 3]


@pytest.fixture(scope="module")
def points():
    return draw(400, 3, seed=0) * torch.tensor([0.3, 0.5, 0.3], dtype=torch.float64) + torch.tensor([0.0, 0.05, 0.0])


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
def test_single_precision_is_close(shape, points):
    normal, distance = measured(shape, points)
    normal32, distance32 = measured(shape, points, "float32")
    away = distance + THICKNESS > 2e-3
    torch.testing.assert_close(distance32, distance, rtol=0, atol=2e-6)
    torch.testing.assert_close(normal32[away], normal[away], rtol=0, atol=2e-4)


AXIS = (0.48, 0.6, -0.64)  # a unit vector
BALL, REACH, RING, TUBE, HALF = 0.07, 0.08, 0.09, 0.04, 0.06
TOOLS = {
    "sphere": ("sphere", (BALL,)),
    "capsule": ("capsule", (AXIS, REACH, TUBE)),
    "torus": ("torus", (RING, TUBE)),
    "cylinder": ("cylinder", (BALL, HALF)),
}


def turned(curve, count):
    """Return the surface that a curve of (distance from the y axis, y) sweeps about that axis."""
    around = torch.linspace(0, 2 * math.pi, count, dtype=torch.float64)[None]
    r, y = curve[:, :1], curve[:, 1:]
    parts = torch.broadcast_tensors(r * around.cos(), y, r * around.sin())
    return torch.stack(parts, dim=-1).reshape(-1, 3)


def line(start, end, count=80):
    return torch.lerp(
        *torch.tensor([start, end], dtype=torch.float64)[:, None], torch.linspace(0, 1, count).double()[:, None]
    )


def arc(centre, radius, start, end, count=160):
    """Return points of a circle; angles from the direction away from the axis, up."""
    a = torch.linspace(start, end, count, dtype=torch.float64)
    return torch.tensor(centre, dtype=torch.float64) + radius * torch.stack([a.cos(), a.sin()], dim=1)


def capsule_surface():
    """Turn the surface of an upright capsule so that its axis is AXIS."""
    ends = [arc((0, side * REACH), TUBE, 0, side * math.pi / 2) for side in (-1, 1)]
    upright = turned(torch.cat([*ends, line((TUBE, -REACH), (TUBE, REACH))]), 160)
    axis = torch.tensor(AXIS, dtype=torch.float64)
    basis = torch.linalg.qr(torch.stack([axis, *torch.eye(3, dtype=torch.float64)[:2]], dim=1)).Q
    return upright[:, 1:2] * axis + upright[:, [0, 2]] @ basis[:, 1:].T


def inside(tool, p):
    """Say which points a tool contains, by the definition of its shape."""
    axial = p[:, [0, 2]].norm(dim=1)
    if tool == "sphere":
        return (p**2).sum(dim=1) < BALL**2
    if tool == "torus":
        return (axial - RING) ** 2 + p[:, 1] ** 2 < TUBE**2
    if tool == "cylinder":
        return (axial < BALL) & (p[:, 1].abs() < HALF)
    axis = torch.tensor(AXIS, dtype=torch.float64)
    return torch.cdist(p, torch.linspace(-REACH, REACH, 2001).double()[:, None] * axis).amin(dim=1) < TUBE


SURFACES = {
    "sphere": lambda: turned(arc((0, 0), BALL, -math.pi / 2, math.pi / 2), 300),
    "capsule": capsule_surface,
    "torus": lambda: turned(arc((RING, 0), TUBE, 0, 2 * math.pi), 500),
    "cylinder": lambda: turned(
        torch.cat([line((BALL, -HALF), (BALL, HALF)), *(line((0, y), (BALL, y)) for y in (-HALF, HALF))]), 300
    ),
}


@pytest.fixture(scope="module")
def around_tools():
    return 0.28 * draw(400, 3, seed=1)


@pytest.mark.parametrize("tool", TOOLS)
def test_a_tools_distance_is_that_of_its_nearest_surface_point(tool, around_tools):
    _, distance = hits(*TOOLS[tool], around_tools)
    gap = torch.cdist(around_tools, SURFACES[tool]()).amin(dim=1)
    within = inside(tool, around_tools)
    assert within.sum() > 8
    assert torch.equal(distance < 0, within)
    assert (distance.abs() <= gap + 1e-6).all()
    beside = 1.5e-3  # half the diagonal between samples
    assert (gap <= torch.hypot(distance.abs(), torch.tensor(beside)) + beside**2 / TUBE).all()


@pytest.mark.parametrize("tool", TOOLS)
def test_a_tools_normal_leads_to_its_surface(tool, around_tools):
    normal, distance = hits(*TOOLS[tool], around_tools)
    _, left = hits(*TOOLS[tool], around_tools - distance[:, None] * normal)
    assert left.abs().max() < 2e-6  # sqrt(TINY) where it leads to an edge


ALL = TOOLS | {shape: (function, (size, thickness)) for shape, (function, _, size, thickness) in SHAPES.items()}


@pytest.mark.parametrize("shape", ALL)
def test_normals_are_unit_vectors_and_the_slope_of_the_distance(shape, points, around_tools):
    at = around_tools if shape in TOOLS else points
    normal, middle = hits(*ALL[shape], at)
    if shape in SHAPES:  # on its skeleton a normal has no direction
        at, normal, middle = (each[middle + THICKNESS > 2e-3] for each in (at, normal, middle))
    torch.testing.assert_close(normal.norm(dim=1), torch.ones_like(middle), rtol=0, atol=1e-6)
    step, slopes = 1e-6, []
    for sign in (1, -1):
        shifts = sign * step * torch.eye(3, dtype=torch.float64)
        ends = [hits(*ALL[shape], at + shift)[1] for shift in shifts]
        slopes.append(torch.stack([sign * (end - middle) / step for end in ends], dim=1))
    smooth = (slopes[0] - slopes[1]).abs().amax(dim=1) < 1e-3  # no kink between the ends
    assert smooth.sum() > (390 if shape in TOOLS else 350)
    torch.testing.assert_close((sum(slopes) / 2)[smooth], normal[smooth], rtol=0, atol=1e-6)


@pytest.mark.parametrize("shape", ALL)
def test_a_middle_and_an_axis_have_a_finite_normal(shape):
    middles = torch.tensor([[0.0, y, 0.0] for y in (0.0, 0.02, -0.03, 0.1, HEIGHT)] + [[RING, 0.0, 0.0]])
    normal, distance = hits(*ALL[shape], middles)
    assert normal.isfinite().all()
    assert distance.isfinite().all()
