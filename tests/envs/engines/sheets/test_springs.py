"""Sheets against closed forms and conservation laws; their adjoint against autograd through the same steps as loops."""

import math
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch

from gradscape.envs.engines.runtime import to_torch
from gradscape.envs.engines.sheets.contact import Floor
from gradscape.envs.engines.sheets.springs import Sheet, Solver
from gradscape.envs.sheets import lattice

from .cloths import DT, PAN, ROWS, crumpled, drive

NOWHERE = Floor(height=-1e6)
K, MASS = 30.0, 0.2  # [N/m], [kg]


def simulate(sheet, dt, steps, *, velocity=(0.0, 0.0, 0.0), stiffness=K, surface=NOWHERE):
    """Return positions and velocities of one sheet at all steps, shape (step + 1, vertex, 3), in float64."""
    solver = Solver(sheet, surface, dt=dt, steps=steps, name="float64", capacity=1, device="cpu")
    stiffness = torch.full((1, len(sheet.x)), stiffness, dtype=torch.float64)
    x = solver.run(torch.tensor([velocity], dtype=torch.float64), stiffness)[:, 0]
    v = torch.stack([to_torch(v)[0] for v in solver.v])
    return x.clone(), v


def pair(length, *, held=(), damping=0.0):
    """Return two vertices joined by a spring of 1 m, `length` [m] apart in a direction along no axis."""
    x = np.array([[0.3, -0.2, 0.1], [0.3, -0.2, 0.1] + length * np.array([2.0, -1.0, 2.0]) / 3])
    spring = {"pairs": np.array([[0, 1]]), "rest": np.ones(1), "weight": np.ones(1)}
    return Sheet(x, **spring, mass=MASS, damping=damping, gravity=0.0, held=held)


def elongation(x):
    return (x[:, 1] - x[:, 0]).norm(dim=1) - 1.0


def patch(*, damping=0.0, gravity=0.0, height=0.0, seed=0):
    """Return a crumpled sheet of 4 x 4 cells of 0.1 m."""
    points = lattice.square(4)
    pairs, rest, weight = lattice.springs(points, reach=2, bend=0.4)
    x = np.stack([points[:, 0], np.zeros(len(points)), points[:, 1]], axis=1) * 0.1
    x += 0.02 * np.random.default_rng(seed).uniform(-1, 1, x.shape) + (0.0, height, 0.0)
    return Sheet(x, pairs, 0.1 * rest, weight, mass=0.01, damping=damping, gravity=gravity)


def stretch(sheet, x):
    """Return springs' elongations [m] at all steps."""
    return (x[:, sheet.pairs[:, 1]] - x[:, sheet.pairs[:, 0]]).norm(dim=2) - torch.from_numpy(sheet.rest)


def energy(sheet, x, v, stiffness=K):
    """Return the energy of springs, motion and height at all steps [J]."""
    springs = stiffness / 2 * (torch.from_numpy(sheet.weight) * stretch(sheet, x).square()).sum(dim=1)
    return springs + sheet.mass * (v.square().sum(dim=2) / 2 + sheet.gravity * x[:, :, 1]).sum(dim=1)


def orders(errors):
    """Return the orders of convergence between halved time steps."""
    return np.log2(np.array(errors[:-1]) / errors[1:])


@pytest.mark.parametrize("dt", [4e-3, 2e-3])
@pytest.mark.parametrize(("held", "moving"), [((0,), MASS), ((1,), MASS), ((), MASS / 2)])
def test_a_pair_oscillates_with_the_period_of_its_reduced_mass_but_for_the_second_order_of_the_step(held, moving, dt):
    period = 2 * math.pi * math.sqrt(moving / K)
    u = elongation(simulate(pair(1.3, held=held), dt, round(12 * period / dt))[0])
    n = (u[1:] * u[:-1] < 0).nonzero()[:, 0]
    zeros = dt * (n + u[n] / (u[n] - u[n + 1]))
    measured = float(zeros[20] - zeros[0]) / 10
    # The scheme's frequency w' solves sin(w' dt / 2) = w dt / 2: the period is short by (w dt)^2 / 24.
    expected = (2 * math.pi * dt / period) ** 2 / 24
    assert 1 - measured / period == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(("held", "moving"), [((0,), MASS), ((), MASS / 2)])
def test_damping_makes_the_amplitude_decay_at_half_its_rate_by_the_mass(held, moving):
    dt, steps, damping = 2e-3, 400, 0.3
    u = elongation(simulate(pair(1.3, held=held, damping=damping), dt, steps)[0])
    # Of u_n = A r^n cos(n theta + phi) this is (A r^n sin(theta))^2; a step shrinks phase space by r^2.
    amplitude = (u[1:-1].square() - u[2:] * u[:-2]).sqrt()
    n = torch.arange(len(amplitude), dtype=torch.float64)
    torch.testing.assert_close(amplitude / amplitude[0], (1 - dt * damping / moving) ** (n / 2), rtol=1e-8, atol=0)
    rate = -float(amplitude[-1].log() - amplitude[0].log()) / (dt * float(n[-1]))
    assert rate == pytest.approx(damping / (2 * moving), rel=dt * damping / moving)


def test_damping_leaves_motion_across_the_spring_alone():
    along, across = torch.tensor([2.0, -1.0, 2.0]) / 3, torch.tensor([1.0, 0.0, -1.0])
    sheet, dt = pair(1.2, held=(0,), damping=5.0), 1e-3
    for direction, left in ((along, 1 - dt * sheet.damping / MASS), (across, 1.0)):
        _, v = simulate(sheet, dt, 1, velocity=direction.tolist(), stiffness=0.0)
        torch.testing.assert_close(v[1, 1], left * direction.double(), rtol=0, atol=1e-7)


def test_air_takes_its_share_of_the_velocity_in_every_step():
    dt, steps, drag = 0.01, 200, 1.7
    velocity = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    _, v = simulate(replace(pair(1.0), drag=drag), dt, steps, velocity=velocity.tolist(), stiffness=0.0)
    left = (1 - drag * dt) ** torch.arange(steps + 1, dtype=torch.float64)
    torch.testing.assert_close(v, left[:, None, None] * velocity.expand(2, 3), rtol=1e-12, atol=0)


def test_a_free_sheet_falls_along_the_parabola_of_the_scheme():
    dt, steps, g = 0.01, 150, 9.81
    sheet = replace(pair(1.0), gravity=g)
    velocity = torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64)
    x, _ = simulate(sheet, dt, steps, velocity=velocity.tolist())
    n = torch.arange(steps + 1, dtype=torch.float64)[:, None, None]
    fall = torch.tensor([0.0, g, 0.0], dtype=torch.float64) * dt**2 * n * (n + 1) / 2
    torch.testing.assert_close(x, torch.from_numpy(sheet.x) + n * dt * velocity - fall, rtol=0, atol=1e-12)


def test_springs_change_neither_momentum_nor_angular_momentum():
    sheet = patch(damping=0.05)
    x, v = simulate(sheet, 2e-3, 500, velocity=(1.0, -0.5, 2.0))
    assert stretch(sheet, x).abs().max() > 0.01
    for total in (v.sum(dim=1), torch.linalg.cross(x, v).sum(dim=1)):
        torch.testing.assert_close(total, total[:1].expand_as(total), rtol=0, atol=1e-11)


def test_without_damping_energy_swings_within_the_first_order_of_the_step_and_does_not_drift():
    sheet, errors = patch(), []
    for dt in (1e-3, 5e-4, 2.5e-4):
        e = energy(sheet, *simulate(sheet, dt, round(1.0 / dt)))
        error = (e / e[0] - 1).abs()
        late, early = error[len(e) // 2 :].max(), error[: len(e) // 2].max()
        assert late < 1.2 * early
        errors.append(float(error.max()))
    assert errors[-1] < 0.02
    np.testing.assert_allclose(orders(errors), 1, atol=0.1)


def test_damping_takes_the_energy_that_its_forces_dissipate():
    sheet, gaps = patch(damping=0.03), []
    i, j = sheet.pairs.T
    for dt in (1e-3, 5e-4, 2.5e-4):
        x, v = simulate(sheet, dt, round(0.2 / dt))
        n = torch.nn.functional.normalize(x[:, j] - x[:, i], dim=2)
        rate = ((v[:, j] - v[:, i]) * n).sum(dim=2)
        power = sheet.damping * (torch.from_numpy(sheet.weight) * rate.square()).sum(dim=1)
        e = energy(sheet, x, v)
        assert e[-1] < 0.5 * e[0]
        gaps.append(float((e - e[0] + dt * power.cumsum(dim=0)).abs().max() / e[0]))
    assert gaps[-1] < 0.02
    assert (orders(gaps) > 0.8).all()


def test_the_floor_adds_no_energy_beyond_the_first_order_of_the_step():
    sheet, gains = patch(gravity=9.81, height=0.05), []
    for dt in (1e-3, 5e-4, 2.5e-4):
        x, v = simulate(sheet, dt, round(0.6 / dt), velocity=(0.5, -1.0, 0.0), surface=Floor())
        e = energy(sheet, x, v)
        assert x[:, :, 1].min() < 0
        assert e[-1] < 0.8 * e[0]
        gains.append(float((e - e.cummin(dim=0).values).max() / e[0]))
    assert gains[-1] < 0.02
    assert (orders(gains) > 0.8).all()


def hang(sheet, stiffness):
    """Return where a sheet that hangs from its held vertices comes to rest: drag damps its slowest swing critically."""
    rows = round(math.sqrt(len(sheet.x))) if len(sheet.held) > 1 else len(sheet.x)
    fastest = math.sqrt(stiffness * sheet.weight.max() / sheet.mass)
    slowest = 2 * fastest * math.sin(math.pi / (4 * rows - 2))
    dt = 0.5 / fastest
    x, v = simulate(replace(sheet, drag=2 * slowest), dt, round(60 / (slowest * dt)), stiffness=stiffness)
    assert v[-1].abs().max() < 1e-11
    return x[-1]


def chain(springs, length=1.0, total=0.3):
    """Return a chain that starts straight down from its held top, its weight [kg] in equal parts below each spring."""
    n = np.arange(springs + 1)
    x = np.stack([np.full(len(n), 0.4), -length / springs * n, np.full(len(n), -0.1)], axis=1)
    spring = {"pairs": np.stack([n[:-1], n[1:]], axis=1), "rest": np.full(springs, length / springs)}
    return Sheet(x, **spring, weight=np.full(springs, float(springs)), mass=total / springs, damping=0.0, held=(0,))


@pytest.mark.parametrize("n", [1, 3, 8])
def test_every_spring_of_a_hanging_chain_carries_the_weight_below_it(n):
    sheet = chain(n)
    x = hang(sheet, K)
    below = sheet.mass * sheet.gravity * torch.arange(n, 0, -1, dtype=torch.float64)
    torch.testing.assert_close(-x[:, 1].diff() - torch.from_numpy(sheet.rest), below / (n * K), rtol=1e-8, atol=0)
    torch.testing.assert_close(x[:, ::2], torch.from_numpy(sheet.x[:, ::2]), rtol=0, atol=0)


def test_a_finer_chain_sags_as_a_continuous_one_does():
    """That is by rho g L^2 / (2 E A); of n weights in a row the lowest hang deepest, by 1 / n more."""
    for n in (2, 4, 8, 16):
        sag = -1.0 - float(hang(chain(n), K)[-1, 1])
        assert sag / (0.3 * 9.81 / (2 * K)) == pytest.approx(1 + 1 / n, rel=1e-8)


def test_columns_of_a_cloth_hung_from_its_upper_edge_sag_like_chains():
    cells = 4
    points = lattice.square(cells)
    pairs, rest, _ = lattice.springs(points, reach=2, bend=0.4)
    along = rest == 1  # alone, so that columns do not pull each other
    x = np.stack([points[:, 1], -points[:, 0], np.zeros(len(points))], axis=1) * 0.25
    top = tuple(range(cells + 1))
    sheet = Sheet(x, pairs[along], 0.25 * rest[along], np.full(along.sum(), 0.6), mass=0.02, damping=0.0, held=top)
    y = hang(sheet, K)[:, 1].reshape(cells + 1, cells + 1)
    below = sheet.mass * sheet.gravity * torch.arange(cells, 0, -1, dtype=torch.float64)
    expected = (below / (0.6 * K))[:, None].expand(cells, cells + 1)
    torch.testing.assert_close(-y.diff(dim=0) - 0.25, expected, rtol=1e-8, atol=0)


def test_twice_the_stiffness_of_twice_the_mass_moves_the_same():
    once = patch(damping=0.03, gravity=9.81, height=0.05)
    twice = replace(once, mass=2 * once.mass, damping=2 * once.damping)
    x, _ = simulate(once, 2e-3, 200, surface=Floor())
    assert torch.equal(simulate(twice, 2e-3, 200, surface=Floor(), stiffness=2 * K)[0], x)
    assert not torch.equal(simulate(twice, 2e-3, 200, surface=Floor())[0], x)


def test_held_vertices_stay_where_they_are():
    sheet = replace(patch(damping=0.03, gravity=9.81), held=(3, 7))
    x, v = simulate(sheet, 2e-3, 100, velocity=(1.0, 2.0, 3.0))
    assert torch.equal(x[:, [3, 7]], x[:1, [3, 7]].expand(101, 2, 3))
    assert (v[:, [3, 7]] == 0).all()
    free = np.setdiff1d(np.arange(len(sheet.x)), sheet.held)
    assert ((x[-1] - x[0])[free].norm(dim=1) > 1e-3).all()


STEPS = 30
STILL = torch.zeros(STEPS + 1, 3, dtype=torch.float64)


def small(surface):
    """Return a sheet of 3 x 3 cells just over a surface, over the bent edge of a pan; two corners are held."""
    plate = 2.0 * np.random.default_rng(1).uniform(
        -0.3, 1, len(lattice.springs(lattice.square(3), reach=2, bend=0.4)[0])
    )
    return crumpled(3, 0.04, (0.05, 0.012, 0.02) if surface is PAN else 0.0, held=(12, 15), plate=plate)


def floor_hit(p, pose):
    return p.new_tensor([0.0, 1.0, 0.0]), p[1]


def pan_hit(p, pose):
    """Return the pan's normal and distance: its bottom is a disc, its edge part of a torus."""
    c, s = pose[2].cos(), pose[2].sin()
    right, up, front = torch.stack([c, s, 0 * c]), torch.stack([-s, c, 0 * c]), p.new_tensor([0.0, 0.0, 1.0])
    offset = p - torch.cat([pose[:2], pose.new_zeros(1)])
    x, y, z = offset @ right, offset @ up, offset @ front
    if x.square() + z.square() <= PAN.flat**2:
        return (up, y) if y > -PAN.thickness else (up, y.abs())
    out = (x * right + z * front) / (x.square() + z.square()).sqrt()
    inward = PAN.flat * out + PAN.bend * up - offset  # towards the middle of the arc
    reach = inward.norm()
    if inward @ up < reach * math.cos(PAN.sweep) or reach > PAN.bend + PAN.thickness:
        return up, reach.new_tensor(1.0)
    return inward / reach, PAN.bend - reach


def stopped(hit, x, v, pose, following, rule):
    """Return the velocity that a surface leaves of one vertex, and whether it takes any, as `contact` says."""
    at, when = (x + DT * v, following) if rule == "end" else (x, pose)
    n, distance = hit(at, when)
    dx, dy, turn = (following - pose) / DT
    arm = at[:2] - when[:2]
    into = (v - torch.stack([dx - turn * arm[1], dy + turn * arm[0], 0 * turn])) @ n
    if distance >= 0 or into >= 0:
        return v, False
    return v - (torch.maximum(into, distance / DT) if rule == "end" else into) * n, True


def replay(sheet, hit, velocity, stiffness, poses=STILL, rule="end"):
    """Return last positions of one row, and how often a vertex was stopped, by loops over springs and vertices."""
    x, held = list(torch.from_numpy(sheet.x)), set(sheet.held)
    v = [velocity * (i not in held) for i in range(len(x))]
    hits = 0
    for pose, following in pairwise(poses):
        force = [torch.zeros(3, dtype=torch.float64) for _ in x]
        springs = zip(sheet.pairs.tolist(), sheet.rest, sheet.weight, sheet.plates, strict=True)
        for (i, j), rest, weight, plate in springs:
            length = (x[j] - x[i]).norm()
            n = (x[j] - x[i]) / length
            k, c = weight * (stiffness[i] + stiffness[j]) / 2, weight * sheet.damping
            pull = (k * (length - rest) + c * (v[j] - v[i]) @ n + plate * length) * n
            force[i], force[j] = force[i] + pull, force[j] - pull
        g = torch.tensor([0.0, sheet.gravity, 0.0], dtype=torch.float64)
        for i, f in enumerate(force):
            v[i] = v[i] + DT * (f / sheet.masses[i] - sheet.drag * v[i] - g)
            v[i], hit_now = stopped(hit, x[i], v[i], pose, following, rule)
            hits += hit_now
            v[i] = (following - pose) / DT if i in held else v[i]
        x = [p + DT * w for p, w in zip(x, v, strict=True)]
    return torch.stack(x), hits


@pytest.fixture(scope="module", params=[("floor", "end"), ("floor", "start"), ("pan", "end"), ("pan", "start")])
def differentiated(request):
    """Return a small sheet, its solver, its surface in torch, what drives both, and the gradient of a random loss."""
    place, rule = request.param
    surface, hit = {"floor": (Floor(), floor_hit), "pan": (PAN, pan_hit)}[place]
    sheet = small(surface)
    solver = Solver(sheet, surface, dt=DT, steps=STEPS, name="float64", capacity=ROWS + 1, device="cpu", rule=rule)
    inputs, adj_end = drive(sheet, STEPS)
    inputs = inputs if surface is PAN else inputs[:2]  # the floor does not move
    end = solver.run(*inputs)[-1].clone()
    gradient = [part.clone() for part in solver.gradient(adj_end)[: len(inputs)]]
    return sheet, solver, partial(replay, sheet, hit, rule=rule), inputs, adj_end, end, gradient


def test_the_adjoint_is_autograds_of_the_same_steps_written_as_loops(differentiated):
    _, _, again, inputs, adj_end, end, gradient = differentiated
    for row in range(ROWS):
        leaves = [part[row].clone().requires_grad_() for part in inputs]
        last, hits = again(*leaves)
        assert hits > 20
        torch.testing.assert_close(end[row], last.detach(), rtol=0, atol=1e-12)
        for ours, theirs in zip(gradient, torch.autograd.grad((last * adj_end[row]).sum(), leaves), strict=True):
            scale = float(theirs.abs().max())
            assert scale > 1e-5
            torch.testing.assert_close(ours[row], theirs, rtol=0, atol=1e-10 * scale)


def test_a_second_gradient_is_not_added_to_the_first(differentiated):
    _, solver, _, inputs, adj_end, _, gradient = differentiated
    solver.run(*inputs)
    for _ in range(2):
        again = solver.gradient(adj_end)[: len(inputs)]
        for later, first in zip(again, gradient, strict=True):
            assert torch.equal(later, first)


def test_a_stopped_solver_raises_within_a_step():
    solver = Solver(pair(1.0), NOWHERE, dt=DT, steps=5, name="float64", capacity=1, device="cpu")
    solver.stop.set()
    with pytest.raises(InterruptedError, match="the simulation was stopped"):
        solver.run(torch.zeros(1, 3), torch.zeros(1, 2))
