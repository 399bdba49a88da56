"""What a plasticine loss is made of: distances of tools, the target's fields, and what is cached."""

import numpy as np
import pytest
import torch

from gradscape.envs.engines.mpm.boundaries import Kind, Tool
from gradscape.envs.mpm import targets
from gradscape.envs.mpm.plasticine import SPAN, Fidelity, model
from gradscape.envs.mpm.plasticine_scenes import Torus
from gradscape.envs.mpm.targets import Target, compare, contact, distance_outside, load_or_make

PEN = Tool(Kind.CAPSULE, (0.03, 0.02), 0.0)
BALL = Tool(Kind.SPHERE, (0.05,), 0.9)
RING = Tool(Kind.TORUS, (0.05, 0.02), 0.9)
PIN = Tool(Kind.ROLLER, (0.1, 0.02), 0.9)
TINY = Fidelity("tiny", dt=SPAN / 5, precision="float64", resolution=16, particles=100)


def rows(*values):
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize(
    ("tool", "angles", "point", "gap"),
    [
        (BALL, None, (0.0, 0.13, 0.0), 0.08),
        (PEN, None, (0.05, 0.02, 0.0), 0.03),
        (PEN, None, (0.0, -0.1, 0.0), 0.05),
        (RING, None, (0.0, 0.0, 0.0), 0.03),
        (RING, None, (0.08, 0.04, 0.0), 0.03),
        (PIN, (0.4, 0.0, 0.0), (0.0, 0.0, 0.17), 0.05),
        (PIN, (0.4, torch.pi / 2, 0.0), (0.17, 0.0, 0.0), 0.05),
        (PIN, (0.4, torch.pi / 2, 0.0), (0.0, 0.0, 0.17), 0.15),
    ],
)
def test_a_tools_distance_is_that_of_its_shape(tool, angles, point, gap):
    place = (0.2, 0.3, -0.1)
    pose = rows(place, angles) if angles else rows(place)
    assert float(distance_outside(tool, rows(point) + rows(place), pose[None])) == pytest.approx(gap, abs=1e-12)
    middle = rows((0.05, 0.0, 0.0)) if tool is RING else rows((0.0, 0.0, 0.0))
    assert float(distance_outside(tool, middle + rows(place), pose[None])) == 0


def test_the_contacts_gradient_is_the_closest_particles_only():
    """The released PlasticineLab gives it to every particle; upstream's atomic minimum is differentiated as a sum."""
    x = 0.5 + 0.4 * torch.rand((2, 40, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x.requires_grad_()
    tools = rows([[0.1, 0.2, 0.3], [0.9, 0.2, 0.4]]).repeat(2, 1, 1).requires_grad_()
    movable = [BALL, PEN]
    contact(x, tools, movable).sum().backward()
    for row in range(2):
        to_sphere, to_pen = (x[row] - tools[row, 0]).norm(dim=1), distance_outside(PEN, x[row], tools[row, 1:])
        near = {int(to_sphere.argmin()), int(to_pen.argmin())}
        assert set(x.grad[row].abs().sum(dim=1).nonzero().flatten().tolist()) == near
    assert torch.autograd.gradcheck(lambda x, tools: contact(x, tools, movable), (x, tools))


def test_shapes_are_compared_row_by_row_with_the_gradient_of_their_sums():
    draw = torch.Generator().manual_seed(0)
    mass, field, distance, weight = (torch.rand(n, generator=draw).double() for n in ((5, 30), 30, 30, (5, 2)))
    mass[0, :4] = field[:4]  # where a mass is the target's the slope is 0
    found = []
    for function in (compare, lambda m, t: torch.stack([(m - t.mass).abs().sum(1), (m * t.distance).sum(1)], dim=1)):
        x = mass.clone().requires_grad_()
        terms = function(x, Target(field, distance))
        found.append((terms.detach(), *torch.autograd.grad((terms * weight).sum(), x)))
    for got, wanted in zip(*found, strict=True):
        torch.testing.assert_close(got, wanted)
    assert torch.equal(compare(mass[2:3], Target(field, distance))[0], found[0][0][2])


def test_what_touches_costs_no_contact():
    x = rows([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    assert float(contact(x, rows([[0.0, 0.04, 0.0]]), [BALL])) == 0


def test_distances_are_to_the_nearest_solid_node_and_nothing_of_the_target_costs():
    scene = model(Torus.scene, TINY)
    target = Target.of(scene, scene.bodies[0].x, "cpu")
    assert float(target.mass.sum()) == pytest.approx(scene.mass.sum())
    assert float((target.mass * target.distance).sum()) == 0
    nodes = np.stack(np.meshgrid(*map(np.arange, scene.nodes), indexing="ij"), axis=-1).reshape(-1, 3) * scene.dx
    solid = nodes[target.mass.numpy() > targets.SOLID * (64 * scene.dx) ** 3]
    empty = np.flatnonzero(target.mass.numpy() == 0)[::37]
    brute = np.linalg.norm(nodes[empty, None] - solid[None], axis=2).min(axis=1)
    assert np.allclose(target.distance.numpy()[empty], brute, atol=1e-12)


def test_a_target_is_made_once_and_again_when_its_content_changes(tmp_path, monkeypatch):
    monkeypatch.setattr(targets, "user_cache_path", lambda name: tmp_path)
    made = []

    def make():
        made.append(len(made))
        return np.full((3, 3), float(len(made)))

    first = load_or_make("clay", "one", make)
    assert np.array_equal(load_or_make("clay", "one", make), first)
    assert made == [0]
    assert not np.array_equal(load_or_make("clay", "two", make), first)
    next(path for path in tmp_path.rglob("*.npy") if np.array_equal(np.load(path), first)).write_bytes(b"torn")
    assert np.array_equal(load_or_make("clay", "one", make), np.full((3, 3), 3.0))  # unreadable: made again
