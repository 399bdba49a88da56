"""Projection onto floor and pan: what velocities lose, and the pan's distance at points beside its surface."""

import math
from functools import cache

import numpy as np
import pytest
import torch
import warp as wp

from gradscape.envs.engines.runtime import precision, to_torch
from gradscape.envs.engines.sheets.contact import Floor, PanOverFloor
from gradscape.envs.engines.sheets.springs import Sheet, Solver

from ..bench import vectors
from .cloths import PAN

DT = 1e-3
ARC = PAN.bend * PAN.sweep  # the length of the edge from bottom to rim [m]
POSES = [(0.0, 0.0, 0.0), (0.04, -0.03, 0.5), (-0.07, 0.1, -0.6)]
UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def uniform(low, high, *shape, seed=0):
    rng = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(shape, generator=rng, dtype=torch.float64)


def loose(surface, x, *, dt=DT, steps=1, rows=1, rule="end", gravity=9.81):
    """Return a solver of vertices of 1 kg at x [m], shape (vertex, 3), that no spring joins."""
    none = np.zeros(0)
    sheet = Sheet(np.asarray(x), np.zeros((0, 2), dtype=int), none, none, mass=1.0, damping=0.0, gravity=gravity)
    return Solver(sheet, surface, dt=dt, steps=steps, name="float64", capacity=rows, device="cpu", rule=rule)


def touched(surface, x, velocity, poses=None, rule="start"):
    """Return velocities after one step of such vertices without weight, and how far they moved: (batch, vertex, 3).

    All start at `velocity`, shape (batch, 3).
    """
    solver = loose(surface, x, rows=len(velocity), rule=rule, gravity=0.0)
    path = solver.run(velocity, torch.zeros(len(velocity), len(x)), poses)
    return to_torch(solver.v[1]).clone(), path[1] - path[0]


def hits(points, pose, name="float64"):
    """Return the pan's (normals, distances) at points of shape (point, 3)."""
    types = precision(name)
    array = wp.array(points.to(types.torch).contiguous().numpy(), dtype=types.vec3)
    out = wp.zeros(len(points), dtype=types.vec4)
    wp.launch(probe(name), len(points), [PAN.data(name), array, types.vec3(*pose), out])
    result = to_torch(out).double()
    return result[:, :3], result[:, 3]


@cache
def probe(name):
    function, Data = PAN.function(name)
    vec3, vec4 = precision(name).vec3, precision(name).vec4

    @wp.kernel(enable_backward=False, module=f"gradscape.tests.contact.{name}")
    def measure(data: Data, p: wp.array[vec3], pose: vec3, out: wp.array[vec4]):
        i = wp.tid()
        out[i] = function(data, p[i], pose)

    return measure


def placed(local, pose):
    """Return where points of the pan's own frame are when it has a pose."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y, z = local.unbind(dim=-1)
    return torch.stack([pose[0] + c * x - s * y, pose[1] + s * x + c * y, z], dim=-1)


def beside(along, around, above):
    """Return points `above` the pan's surface, `along` it from its centre and `around` its axis, in its own frame."""
    angle = (along - PAN.flat).clamp_min(0) / PAN.bend
    r = along.clamp_max(PAN.flat) + (PAN.bend - above) * angle.sin()
    y = PAN.bend - (PAN.bend - above) * angle.cos()
    return torch.stack([r * around.cos(), y, r * around.sin()], dim=-1)


def near_the_pan(count, low, high, seed=0):
    """Return random points between two heights above the surface, in the pan's own frame."""
    along = uniform(0.0, PAN.flat + ARC, count, seed=seed)
    return beside(along, uniform(0.0, 2 * math.pi, count, seed=seed + 1), uniform(low, high, count, seed=seed + 2))


def test_the_floor_takes_the_velocity_into_it_and_nothing_else():
    x, v = uniform(-0.1, 0.1, 60, 3), uniform(-3.0, 3.0, 40, 3, seed=1)
    after, moved = touched(Floor(height=0.02), x, v)
    inside = (x[:, 1] < 0.02).expand(40, 60)
    stopped = inside & (v[:, 1, None] < 0)
    before = v[:, None].expand(40, 60, 3)
    assert stopped.sum() > 400
    assert torch.equal(after[~stopped], before[~stopped])
    assert torch.equal(after[stopped], before[stopped] * torch.tensor([1.0, 0.0, 1.0]))
    torch.testing.assert_close(moved, DT * after, rtol=0, atol=1e-15)


def test_what_would_be_in_the_floor_ends_on_it_and_what_is_in_it_goes_no_deeper():
    x, v = uniform(-5e-3, 5e-3, 60, 3), uniform(-3.0, 3.0, 40, 3, seed=1)
    after, moved = touched(Floor(height=0.002), x, v, rule="end")
    start, end = x[:, 1].expand(40, 60), (x + moved)[..., 1]
    free = start + DT * v[:, 1, None]
    lands, inside = (free < 0.002) & (start >= 0.002), (start < 0.002) & (v[:, 1, None] < 0)
    assert min(lands.sum(), inside.sum()) > 100
    assert (end[lands] - 0.002).abs().max() < 1e-15
    assert torch.equal(end[inside], start[inside])
    assert torch.equal(end[~lands & ~inside], free[~lands & ~inside])
    assert torch.equal(after[..., ::2], v[:, None, ::2].expand(40, 60, 2))


def fall(rule, height, dt):
    """Return the heights of a vertex that falls from a height [m] onto the floor, over 0.4 s."""
    solver = loose(Floor(), [[0.0, height, 0.0]], dt=dt, steps=round(0.4 / dt), rule=rule)
    return solver.run(torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1, 1))[:, 0, 0, 1]


def test_a_vertex_dropped_on_the_floor_stays_on_it_at_every_step():
    for dt in (4e-3, 1e-3):
        y = fall("end", 0.2, dt)
        landed = round((2 * 0.2 / 9.81) ** 0.5 / dt) + 2
        assert y[landed:].abs().max() < 1e-15
        assert fall("start", 0.2, dt)[-1] < -1e-5  # once it is inside: as deep as it happened to come


def test_friction_stops_what_slides_after_the_way_that_coulomb_says():
    """A vertex of 1.2 m/s slides v^2 / (2 mu g) far, and by half a step's way more or less."""
    mu, velocity = 0.6, torch.tensor([[0.72, 0.0, 0.96]], dtype=torch.float64)
    solver = loose(Floor(friction=mu), np.zeros((1, 3)), steps=400)
    path = solver.run(velocity, torch.zeros(1, 1))[:, 0, 0]
    way = 1.2**2 / (2 * mu * solver.sheet.gravity)
    assert float(path[-1].norm()) == pytest.approx(way, abs=1.2 * DT)
    torch.testing.assert_close(path[-1] / path[-1].norm(), velocity[0] / 1.2, rtol=0, atol=1e-12)
    assert torch.equal(path[-1], path[-2])


def test_what_misses_the_pan_lands_on_the_floor_beneath_and_a_floor_bears_the_pan_nothing():
    """Its first place decides: one vertex begins over the pan and one beside it; the pan moves, the floor does not."""
    solver = loose(PanOverFloor(PAN, Floor(height=-0.1)), [[0.0, 0.01, 0.0], [0.3, 0.01, 0.0]], steps=300)
    poses = torch.zeros(1, 301, 3, dtype=torch.float64)
    poses[0, :, 1] = torch.linspace(0.0, 0.03, 301, dtype=torch.float64)
    end = solver.run(torch.zeros(1, 3), torch.zeros(1, 2), poses)[-1, 0]
    torch.testing.assert_close(end[:, 1], torch.tensor([0.03, -0.1], dtype=torch.float64), rtol=0, atol=1e-12)


def test_a_pan_that_moves_and_tilts_takes_the_velocity_into_its_material_and_nothing_else():
    x = torch.cat([placed(near_the_pan(200, -0.02, 0.02), POSES[1]), uniform(-0.3, 0.3, 50, 3, seed=7)])
    v = uniform(-2.0, 2.0, 30, 3, seed=8)
    start = torch.tensor(POSES[1], dtype=torch.float64).expand(30, 3)
    rate = uniform(-3.0, 3.0, 30, 3, seed=9)
    after, _ = touched(PAN, x, v, torch.stack([start, start + DT * rate], dim=1))
    n, distance = hits(x, POSES[1])
    # The material's velocity by moving its points a moment before and after.
    c, s = math.cos(-POSES[1][2]), math.sin(-POSES[1][2])
    offset = x - torch.tensor([*POSES[1][:2], 0.0])
    local = torch.stack([c * offset[:, 0] - s * offset[:, 1], s * offset[:, 0] + c * offset[:, 1], x[:, 2]], dim=1)
    ends = [torch.stack([placed(local, pose.tolist()) for pose in start + t * rate]) for t in (1e-5, -1e-5)]
    material = (ends[0] - ends[1]) / 2e-5

    before = v[:, None].expand(30, 250, 3)
    into = ((before - material) * n).sum(dim=2)
    stopped = (distance < 0) & (into < 0)
    assert 1000 < stopped.sum() < 6000
    assert torch.equal(after[~stopped], before[~stopped])
    left = ((after - material) * n).sum(dim=2)
    torch.testing.assert_close(left[stopped], torch.zeros_like(left[stopped]), rtol=0, atol=1e-8)
    lost = before - after
    torch.testing.assert_close(lost, (lost * n).sum(dim=2, keepdim=True) * n, rtol=0, atol=1e-12)


@pytest.mark.parametrize("pose", POSES)
def test_the_pans_distance_and_normal_are_those_of_points_that_were_put_there(pose):
    """Above it and inside; the slope of the distance is the normal, but within a step of the joint."""
    above = uniform(-0.0299, 0.03, 600, seed=3)
    along, around = uniform(0.0, PAN.flat + ARC, 600), uniform(0.0, 2 * math.pi, 600, seed=1)
    foot, points = (placed(beside(along, around, height), pose) for height in (torch.zeros_like(above), above))
    n, distance = hits(points, pose)
    torch.testing.assert_close(distance, above, rtol=0, atol=1e-15)
    torch.testing.assert_close(foot + above[:, None] * n, points, rtol=0, atol=1e-15)
    shifts, step = torch.eye(3, dtype=torch.float64), 1e-6
    ends = [[hits(points + sign * step * shift, pose)[1] for shift in shifts] for sign in (1, -1)]
    slope = torch.stack([(up - down) / (2 * step) for up, down in zip(*ends, strict=True)], dim=1)
    torch.testing.assert_close(n, slope, rtol=0, atol=1e-4)  # within a step of the joint the slope is between two
    assert ((n - slope).abs().amax(dim=1) < 1e-8).sum() > 590


@pytest.mark.parametrize("pose", POSES)
def test_nothing_is_beside_the_rim_or_beneath_the_pan(pose):
    around = uniform(0.0, 2 * math.pi, 300, seed=1)
    depth = uniform(-0.03, 0.03, 300)
    past = beside(PAN.flat + ARC + uniform(1e-6, 0.05, 300, seed=2), around, depth)
    beneath = beside(
        uniform(0.0, PAN.flat + ARC, 300, seed=3), around, -PAN.thickness - uniform(1e-6, 0.5, 300, seed=4)
    )
    for local in (past, beneath):
        assert (hits(placed(local, pose), pose)[1] > 0).all()


def test_the_pans_bottom_passes_smoothly_into_its_edge():
    around = uniform(0.0, 2 * math.pi, 100)
    for above in (-0.02, 0.0, 0.03):
        height = torch.full((100,), above, dtype=torch.float64)
        (n, distance), (n_out, distance_out) = (
            hits(beside(torch.full((100,), PAN.flat + shift, dtype=torch.float64), around, height), POSES[0])
            for shift in (-1e-9, 1e-9)
        )
        torch.testing.assert_close(distance, distance_out, rtol=0, atol=1e-15)
        torch.testing.assert_close(n, n_out, rtol=0, atol=1e-7)
        torch.testing.assert_close(n, UP.expand(100, 3), rtol=0, atol=1e-12)


def test_the_rim_is_where_the_pan_says_it_is():
    end = torch.tensor([PAN.flat + ARC], dtype=torch.float64)
    height = PAN.bend * (1 - math.cos(PAN.sweep))
    torch.testing.assert_close(beside(end, 0 * end, 0 * end), vectors((PAN.radius, height, 0.0)))
    assert PAN.radius == pytest.approx(0.2)


def test_the_pan_is_the_same_in_float32_within_its_precision():
    points = placed(near_the_pan(300, -0.025, 0.03), POSES[1])
    for single, double in zip(hits(points, POSES[1], "float32"), hits(points, POSES[1]), strict=True):
        torch.testing.assert_close(single, double, rtol=0, atol=1e-5)
