"""MLS-MPM against conservation laws and closed forms: free fall, a resting tank, sound in a column."""

import numpy as np
import pytest
import torch

from gradscape.envs.engines.mpm.solver import Solver

from .bodies import (
    CLAY,
    DENSITY,
    DEPTH,
    GRAVITY,
    MATERIALS,
    SPAN,
    SPEED,
    block,
    free_model,
    masses,
    over_time,
    parked,
    solved,
    tank,
    to_torch,
    weights,
)


def random_velocities(model, batch, size):
    return size * weights(model, batch, 0)


def test_mass_and_momentum_are_conserved_away_from_walls():
    model = free_model()
    velocity = random_velocities(model, 2, size=1.0) + torch.tensor([0.3, -0.2, 0.1])
    solver = solved(model, 2, velocity)
    m = masses(model)
    momentum = (m[:, None] * over_time(solver, "v")).sum(dim=2)
    torch.testing.assert_close(momentum, momentum[:1].expand_as(momentum), rtol=0, atol=1e-7 * float(m.sum()))
    on_grid = to_torch(solver.tapes[-1].grids[-1].m)[:, :, 3].sum(dim=1)
    torch.testing.assert_close(on_grid, m.sum().expand(2), rtol=1e-12, atol=0)
    J, F = (to_torch(state) for state in solver.checkpoints[-1].S[:2])
    assert (J - 1).abs().max() > 1e-3  # and this was no rigid motion
    e = torch.linalg.svdvals(F).log()
    assert (e - e.mean(dim=2, keepdim=True)).norm(dim=2).max() == pytest.approx(
        CLAY.yield_stress / (2 * CLAY.mu), rel=1e-3
    )


def test_angular_momentum_is_conserved_away_from_walls():
    """That of the particles, m cross(x, v), and that of their affine fields, m dx^2/4 times the axial vector of C."""
    model = free_model()
    solver = solved(model, 1, random_velocities(model, 1, size=1.0))
    x, v, C = (over_time(solver, name)[:, 0] for name in ("x", "v", "C"))
    axial = torch.stack([C[..., k, j] - C[..., j, k] for j, k in ((1, 2), (2, 0), (0, 1))], dim=-1)
    turning = torch.linalg.cross(x, v) + model.dx**2 / 4 * axial
    total = (masses(model)[:, None] * turning).sum(dim=1)
    assert total.diff(dim=0).abs().max() < 1e-7 * float(masses(model).sum())


@pytest.mark.parametrize("material", ["elastic", "plasticine"])
def test_a_spinning_block_turns_as_a_rigid_body(material):
    """It keeps its angular momentum and its shape, but for what the centrifugal force stretches."""
    model = free_model(bodies=(block(MATERIALS[material], (0, 0.4, 0)),))
    x = torch.from_numpy(model.bodies[0].x)
    middle, omega = x.mean(dim=0), torch.tensor([1.0, 2.0, -2.0], dtype=torch.float64)
    spin = torch.linalg.cross(omega.expand(3, 3), torch.eye(3, dtype=torch.float64)).T
    solver = Solver(model, capacity=1, device="cpu")
    to_torch(solver.checkpoints[0].v)[:] = (x - middle) @ spin.T
    to_torch(solver.checkpoints[0].C)[:] = spin
    end = solver.run(parked(model))[0]
    turned = middle + (x - middle) @ torch.linalg.matrix_exp(model.steps * SPAN * spin).T
    assert (turned - x).norm(dim=1).max() > 0.02
    stretch = DENSITY * omega.norm() ** 2 * 0.07**2 / MATERIALS[material].young
    assert (end - turned).norm(dim=1).max() < 0.07 * (stretch + model.dt * omega.norm())


def test_blocks_fall_as_far_as_the_integrator_says_exactly():
    model = free_model(gravity=GRAVITY)
    fall = over_time(solved(model), "x")[-1, 0] - torch.from_numpy(np.concatenate([b.x for b in model.bodies]))
    t = model.steps * SPAN
    exact = -GRAVITY * t**2 / 2 - GRAVITY * t * model.dt / 2
    wanted = torch.tensor([0.0, exact, 0.0], dtype=torch.float64)
    torch.testing.assert_close(fall, wanted.expand_as(fall), rtol=0, atol=1e-8)


def test_a_particle_out_of_the_grid_is_reported_and_harms_no_neighbour():
    model = free_model()
    calm = random_velocities(model, 3, size=0.2)
    wild = calm.clone()
    wild[1, -1, 1] += 200.0
    wild[1, : len(model.bodies[0].x), 1] += 8.0
    lone, together = solved(model, 3, calm), solved(model, 3, wild)
    assert lone.read_escaped(3).tolist() == [False, False, False]
    assert together.read_escaped(3).tolist() == [False, True, False]
    ends = [over_time(solver, "x")[-1] for solver in (lone, together)]
    assert torch.equal(ends[0][[0, 2]], ends[1][[0, 2]])
    assert not torch.equal(ends[0][1], ends[1][1])


def test_a_run_forgets_the_one_before():
    model = free_model()
    solver = Solver(model, capacity=2, device="cpu")
    start = to_torch(solver.checkpoints[0].v)
    ends = []
    for velocity in (
        random_velocities(model, 2, size=0.5),
        30 * torch.ones_like(start),
        random_velocities(model, 2, 0.5),
    ):
        start[:] = velocity
        ends.append((solver.run(parked(model, 2)).clone(), solver.read_escaped(2).tolist()))
    assert torch.equal(ends[0][0], ends[2][0])
    assert [left for _, left in ends] == [[False, False], [True, True], [False, False]]


class Untouched(np.ndarray):
    """Fail where NumPy calculates with it, as it does with all particles then; how many there are may be asked."""

    __array_ufunc__ = None

    def __array_function__(self, function, *_):
        raise AssertionError(f"{function.__name__} goes through all particles")


def test_a_second_run_does_not_go_through_particles_at_rest_on_the_processor():
    model = free_model()
    solver = Solver(model, capacity=1, device="cpu")
    first = solver.run(parked(model, 1)).clone()
    for body in model.bodies:
        object.__setattr__(body, "x", body.x.view(Untouched))
    assert torch.equal(solver.run(parked(model, 1)), first)


@pytest.fixture(scope="module")
def resting():
    """Return what half a second does to a tank at rest: (centre's drift [m], fastest and last mean speed [m/s])."""
    found = {}
    for name, material in MATERIALS.items():
        for dx in (0.05, 0.025):
            solver = solved(tank(material, dx, at_rest=True, steps=50))
            height = over_time(solver, "x")[:, 0, :, 1].mean(dim=1)
            speed = over_time(solver, "v")[:, 0].norm(dim=2)
            found[name, dx] = float((height - height[0]).abs().max()), float(speed.max()), float(speed[-1].mean())
    return found


@pytest.mark.parametrize("material", MATERIALS)
def test_a_resting_tank_stays_at_rest(resting, material):
    for dx in (0.05, 0.025):
        drift, fastest, last = resting[material, dx]
        assert drift < 3e-4  # 7e-4 where walls do not reflect
        assert fastest < 0.015
        assert last < 0.006


@pytest.mark.parametrize("material", MATERIALS)
def test_a_column_that_starts_to_bear_its_weight_swings_at_the_speed_of_sound(material):
    """Without weight so far, all of it sinks until 2 H / c, its centre 2 g H^2 / (3 c^2) deep, and turns back."""
    turn, depth = 2 * DEPTH / SPEED, 2 * GRAVITY * DEPTH**2 / (3 * SPEED**2)
    late = []
    for dx in (0.05, 0.025):
        solver = solved(tank(MATERIALS[material], dx, at_rest=False, steps=8))
        height, v = (over_time(solver, name)[:, 0, :, 1].mean(dim=1) for name in "xv")
        step = int((v[1:] > 0).nonzero()[0])
        crossing = SPAN * (step - float(v[step] / (v[step + 1] - v[step])))
        late.append(abs(crossing / turn - 1))
        assert float(height[0] - height.min()) == pytest.approx(depth, rel=0.1)
    assert max(late) < 0.05
