"""MLS-MPM against conservation laws and closed forms: free fall, a resting tank, sound in a column, true gradients."""

from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
import torch
import warp as wp

from gradscape.envs.engines import mpm
from gradscape.envs.engines.boundaries import LadleInTank, Open
from gradscape.envs.engines.manipulators import Kind, Manipulators, Tool
from gradscape.envs.engines.materials import Elastic, Fluid, Plasticine
from gradscape.envs.engines.model import Body, Box, Model, around
from gradscape.envs.engines.mpm import Solver
from gradscape.envs.engines.runtime import to_torch

DENSITY, SPEED, GRAVITY = 1330.0, 6.0, 9.81  # [kg/m^3], of sound [m/s], [m/s^2]
SYRUP = Fluid(DENSITY, DENSITY * SPEED**2, viscosity=4.0)
SPONGE = Elastic.with_wave_speed(DENSITY, SPEED, poisson=0.3)
CLAY = Plasticine(DENSITY, SPONGE.young, SPONGE.poisson, yield_stress=150.0)
FIRM = replace(CLAY, yield_stress=1e5)  # never yields
MATERIALS = {"fluid": SYRUP, "elastic": SPONGE, "plasticine": FIRM}
WIDTH, DEPTH = 0.2, 0.15  # of the tank and of what fills it [m]
SPAN = 0.01  # length of a control step [s]


def lattice(counts, sides):
    """Return the centres of equal cells of a box that stands on the middle of the plane y = 0."""
    axes = [(np.arange(n) + 0.5) / n * side for n, side in zip(counts, sides, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return x - np.array([sides[0] / 2, 0, sides[2] / 2])


def block(material, corner, side=0.1, count=4):
    x = lattice((count,) * 3, (side,) * 3) + np.array(corner)
    return Body(material, x, np.full(count**3, (side / count) ** 3), np.ones(count**3))


def free_model(**changes):
    """Return a block of fluid, of clay and of sponge in empty space."""
    model = Model(
        precision="float64",
        bodies=(block(SYRUP, (-0.1, 0.4, 0.0)), block(CLAY, (0, 0.27, 0.0)), block(SPONGE, (0.07, 0.45, 0.0))),
        boundary=Open(),
        origin=(-0.3, 0.0, -0.3),
        dx=0.05,
        nodes=(13, 16, 13),
        dt=SPAN / 5,
        substeps=5,
        steps=12,
        gravity=0.0,
    )
    return replace(model, **changes)


def tank(material, dx, *, at_rest, steps):
    """Return a tank full of one material, compressed as its own weight does, or not at all."""
    counts = [round(2 * side / dx) for side in (WIDTH, DEPTH, WIDTH)]
    x = lattice(counts, (WIDTH, DEPTH, WIDTH))
    pressure = DENSITY * GRAVITY * (DEPTH - x[:, 1]) * at_rest
    margin = 2
    across = round(WIDTH / dx) + 1 + 2 * margin
    ladle = {"radius": 0.07, "half_thickness": 0.01, "height": 0.25, "friction": 0.1}
    return Model(
        precision="float64",
        bodies=(Body(material, x, np.full(len(x), WIDTH * DEPTH * WIDTH / len(x)), material.volume_ratio(pressure)),),
        boundary=LadleInTank(half_width=WIDTH / 2, lid=0.25, band=0.75 * dx, **ladle),
        origin=(-WIDTH / 2 - margin * dx, -margin * dx, -WIDTH / 2 - margin * dx),
        dx=dx,
        nodes=(across, round(0.25 / dx) + 1 + 2 * margin, across),
        dt=SPAN / 10,
        substeps=10,
        steps=steps,
        gravity=GRAVITY,
    )


def parked(model, batch=1):
    """Return tools that stay 10 m above everything."""
    return torch.tensor([0.0, 10.0, 0.0], dtype=torch.float64).expand(batch, model.steps + 1, 1, 3)


def solved(model, batch=1, velocity=None):
    """Run a model; `velocity` [m/s], shape (batch, particle, 3), is that of the first frame."""
    solver = Solver(model, capacity=batch, device="cpu")
    if velocity is not None:
        to_torch(solver.checkpoints[0].v)[:] = velocity
    solver.run(parked(model, batch))
    return solver


def over_time(solver, name):
    """Return x or v at the ends of control steps, shape (step + 1, batch, particle, 3)."""
    pairs = zip(solver.orders, solver.checkpoints, strict=True)
    return torch.stack([order.to_model(to_torch(getattr(frame, name))) for order, frame in pairs])


def masses(model):
    return torch.cat([torch.from_numpy(body.mass) for body in model.bodies])


def random_velocities(model, batch, size):
    generator = torch.Generator().manual_seed(0)
    return size * (torch.rand((batch, model.particles, 3), generator=generator, dtype=torch.float64) - 0.5)


def test_mass_and_momentum_are_conserved_away_from_walls():
    model = free_model()
    velocity = random_velocities(model, 2, size=1.0) + torch.tensor([0.3, -0.2, 0.1])
    solver = solved(model, 2, velocity)
    m = masses(model)
    momentum = (m[:, None] * over_time(solver, "v")).sum(dim=2)
    torch.testing.assert_close(momentum, momentum[:1].expand_as(momentum), rtol=0, atol=1e-7 * float(m.sum()))
    on_grid = to_torch(solver.windows[-1].grids[-1].m)[:, :, 3].sum(dim=1)
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
    assert lone.left_grid(3).tolist() == [False, False, False]
    assert together.left_grid(3).tolist() == [False, True, False]
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
        ends.append((solver.run(parked(model, 2)).clone(), solver.left_grid(2).tolist()))
    assert torch.equal(ends[0][0], ends[2][0])
    assert [left for _, left in ends] == [[False, False], [True, True], [False, False]]


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
        assert drift < 1e-3
        assert fastest < 0.06
        assert last < 0.01
    assert resting[material, 0.025][0] < resting[material, 0.05][0]


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
        assert float(height[0] - height.min()) == pytest.approx(depth, rel=0.08)
    assert late[1] < 0.05
    assert late[1] < 0.6 * late[0]


def kneading(**changes):
    """Return a model of two lumps of clay on a floor, with a ball and a roller, and paths that press and drag them."""
    room = Manipulators(
        (Tool(Kind.SPHERE, (0.06,), 0.3), Tool(Kind.ROLLER, (0.05, 0.04), 0.9)),
        lower=(-0.6, 0.0, -0.3),
        upper=(0.6, 0.7, 0.3),
        floor=0.1,
        friction=0.5,
        softness=60.0,
    )
    lumps = tuple(block(replace(CLAY, yield_stress=50.0), (x, 0.1, 0.0), count=3) for x in (-0.12, 0.09))
    model = free_model(
        bodies=lumps, boundary=room, origin=(-0.7, 0.0, -0.4), nodes=(29, 16, 17), gravity=GRAVITY, steps=4
    )
    model = replace(model, **changes)
    generator = torch.Generator().manual_seed(5)
    start = torch.tensor([[-0.117, 0.251, 0.003], [0.083, 0.232, 0.007], [0.0, 0.3, 0.0]], dtype=torch.float64)
    travel = torch.tensor([[0.004, -0.01, 0.003], [-0.006, -0.008, 0.002], [0.1, 0.05, 0.0]], dtype=torch.float64)
    time = torch.arange(model.steps + 1, dtype=torch.float64)[:, None, None]
    paces = 0.5 + torch.rand((3, 1, 3, 3), generator=generator, dtype=torch.float64)
    return model, start + time * travel * paces


def weights(model, batch, seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand((batch, model.particles, 3), generator=generator, dtype=torch.float64) - 0.5


def kneaded(model, paths, adj_x):
    """Return (solver, last x, gradient)."""
    solver = Solver(model, capacity=len(paths), device="cpu")
    return solver, solver.run(paths).clone(), solver.gradient(adj_x)


def test_the_gradient_by_tools_on_plasticine_is_the_slope():
    model, paths = kneading()
    adj_x = {model.steps: weights(model, 3, 1)}
    solver, _, gradient = kneaded(model, paths, adj_x)
    direction = torch.rand(paths.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 0.5
    slope, errors = (gradient * direction).sum(dim=(1, 2, 3)), []
    for step in (1e-4, 1e-5, 1e-6, 1e-7):
        ends = [(solver.run(paths + s * step * direction) * adj_x[model.steps]).sum(dim=(1, 2)) for s in (1, -1)]
        errors.append(float((((ends[0] - ends[1]) / (2 * step) - slope) / slope).abs().max()))
    assert min(errors) < 1e-6


def test_results_do_not_depend_on_what_else_is_in_the_batch():
    """The others lie elsewhere and stray farther, so that another part of the grid is worked on."""
    model, paths = kneading()
    adj_x = weights(model, 3, 3)
    lone = kneaded(model, paths[:1], {model.steps: adj_x[:1]})
    solver = Solver(model, capacity=3, device="cpu")
    to_torch(solver.checkpoints[0].x)[1:] += torch.tensor([[[0.25, 0.1, 0.05]], [[-0.2, 0.2, -0.1]]])
    end, gradient = solver.run(paths), solver.gradient({model.steps: adj_x})
    assert all(box.cells < more.cells for box, more in zip(lone[0].boxes, solver.boxes, strict=True))
    assert torch.equal(end[:1], lone[1])
    assert torch.equal(gradient[:1], lone[2])
    assert gradient[0].abs().max() > 0


def test_the_whole_grid_and_its_parts_give_the_same_bits(monkeypatch):
    model, paths = kneading()
    adj_x = {model.steps: weights(model, 3, 4)}
    cropped = kneaded(model, paths, adj_x)
    assert all(box.cells < model.cells / 2 for box in cropped[0].boxes)
    monkeypatch.setattr(mpm, "MARGIN", 1000)
    whole = kneaded(model, paths, adj_x)
    assert whole[0].boxes == [Box((0, 0, 0), model.nodes)] * model.steps
    assert torch.equal(whole[1], cropped[1])
    assert torch.equal(whole[2], cropped[2])


def test_an_episode_kept_whole_and_one_repeated_step_by_step_give_the_same_bits(monkeypatch):
    model, paths = kneading()
    adj_x = {2: weights(model, 3, 5), model.steps: weights(model, 3, 6)}
    kept = kneaded(model, paths, adj_x)
    monkeypatch.setattr(mpm, "KEPT", 0)
    repeated = kneaded(model, paths, adj_x)
    assert len(kept[0].windows) == model.steps > len(repeated[0].windows) == 1
    assert torch.equal(kept[1], repeated[1])
    assert torch.equal(kept[2], repeated[2])


@pytest.mark.parametrize("speed", [4.0, 18.0])  # [m/s], so 0.8 or 3.6 cells in a control step
def test_the_grid_grows_where_a_particle_leaves_its_part(monkeypatch, speed):
    """One cell of margin is enough for the slow; the quick make it repeat the step on more, with the same bits."""
    model, velocity = free_model(steps=1), torch.zeros(1, 192, 3, dtype=torch.float64)
    velocity[:, :64, 1], velocity[:, 64:128, 1] = speed, -speed
    cropped = solved(model, 1, velocity)
    assert (cropped.boxes[0] == around(model, *model.corners, mpm.MARGIN)) == (speed < 10)
    monkeypatch.setattr(mpm, "MARGIN", 1000)
    whole = solved(model, 1, velocity)
    for solver in (cropped, whole):
        assert not solver.left_grid(1).any()
    for name in "xvC":
        assert torch.equal(over_time(cropped, name), over_time(whole, name))


def test_adjoints_at_several_control_steps_add_up():
    model, paths = kneading()
    at = {step: weights(model, 3, step) for step in (1, 2, model.steps)}
    solver, _, together = kneaded(model, paths, at)
    separate = [solver.gradient({step: adj_x}) for step, adj_x in at.items()]
    torch.testing.assert_close(together, sum(separate), rtol=0, atol=1e-12 * float(together.abs().max()))
    assert not separate[0][:, 2:].any()  # what comes later has no say
    assert separate[0].abs().max() > 0


@pytest.fixture(scope="module")
def stirred():
    """Return a solver of a coarse tank, and the path of a ladle that stirs it.

    Nodes lie nowhere on the bowl's mid-surface nor in the plane of its rim: there the normal jumps, or bends.
    """
    model = tank(SYRUP, 0.05, at_rest=True, steps=6)
    time = torch.linspace(0, 1, model.steps + 1, dtype=torch.float64)
    path = torch.stack([0.003 + 0.02 * time, 0.1141 - 0.05 * time, 0.007 + 0.01 * time], dim=-1)[None, :, None]
    return Solver(model, capacity=2, device="cpu"), path.expand(2, -1, -1, -1).contiguous()


def test_the_gradient_by_the_tools_is_the_slope_on_a_ladder_of_steps(stirred):
    solver, path = stirred
    generator = torch.Generator().manual_seed(1)
    adj_x = torch.rand((2, solver.model.particles, 3), generator=generator, dtype=torch.float64) - 0.5
    direction = torch.rand(path.shape, generator=generator, dtype=torch.float64) - 0.5
    solver.run(path)
    slope = (solver.gradient({solver.model.steps: adj_x}) * direction).sum(dim=(1, 2, 3))
    errors = []
    for step in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7):
        ends = [(solver.run(path + sign * step * direction) * adj_x).sum(dim=(1, 2)) for sign in (1, -1)]
        errors.append(float((((ends[0] - ends[1]) / (2 * step) - slope) / slope).abs().max()))
    assert min(errors) < 1e-7
    assert errors[0] > 100 * min(errors)  # the slope over a millimetre is another one


def test_gradients_have_the_same_bits_every_time(stirred):
    solver, path = stirred
    adj_x = torch.ones((2, solver.model.particles, 3), dtype=torch.float64)
    gradients = []
    for _ in range(2):
        solver.run(path)
        gradients.append(solver.gradient({solver.model.steps: adj_x}))
    assert torch.equal(*gradients)
    assert gradients[0].abs().max() > 0


def test_a_second_gradient_of_one_run_has_the_same_bits(stirred):
    solver, path = stirred
    adj_x = torch.ones((2, solver.model.particles, 3), dtype=torch.float64)
    solver.run(path)
    assert torch.equal(solver.gradient({solver.model.steps: adj_x}), solver.gradient({solver.model.steps: adj_x}))


def arrays(thing, seen):
    """Yield every array a solver holds that grows with its capacity."""
    if isinstance(thing, wp.array):
        if thing.ndim > 1 and thing.ptr not in seen:
            seen.add(thing.ptr)
            yield thing
    elif is_dataclass(thing):
        for field in fields(thing):
            yield from arrays(getattr(thing, field.name), seen)
    elif isinstance(thing, list | tuple):
        for item in thing:
            yield from arrays(item, seen)


def test_the_memory_estimate_is_what_a_solver_takes(stirred):
    solver, path = stirred
    solver.run(path)
    solver.gradient({solver.model.steps: torch.ones((2, solver.model.particles, 3), dtype=torch.float64)})
    seen = set()
    held = [*vars(solver).values(), *vars(solver.adjoint).values()]
    held += [part for window in solver.windows for part in vars(window).values()]
    taken = sum(array.capacity for thing in held for array in arrays(thing, seen))
    assert taken / solver.capacity == pytest.approx(mpm.memory(solver.model, "cpu"), rel=0.25)  # grids as they come
