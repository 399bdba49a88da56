"""A fluid's volume ratios smoothed before control steps: what stays, what goes, the torch reference, the adjoint."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from gradscape.envs.engines.mpm.boundaries import Open
from gradscape.envs.engines.mpm.model import Body, Model
from gradscape.envs.engines.mpm.smoothing import hydrostatic_slope, smooth_volume_ratios
from gradscape.envs.engines.mpm.solver import Solver
from gradscape.envs.engines.runtime import to_torch

from .bodies import DENSITY, GRAVITY, SPONGE, SYRUP, block, lattice

EVEN = replace(SYRUP, smoothing=1.0)
DX, SIDE, COUNT = 0.05, 0.35, 14  # [m], [m], particles along a side


def model(share=1.0, seed=None, **changes):
    """Return a cube of fluid beside a piece of sponge; a seed moves and resizes the particles by up to a fifth."""
    random = np.random.default_rng(seed)
    x = lattice((COUNT,) * 3, (SIDE,) * 3)
    volume = np.full(len(x), (SIDE / COUNT) ** 3)
    if seed is not None:
        x = x + 0.2 * SIDE / COUNT * random.uniform(-1, 1, x.shape)
        volume = volume * random.uniform(0.8, 1.2, len(x))
    fluid = Body(replace(SYRUP, smoothing=share), x, volume, np.ones(len(x)))
    found = Model(
        precision="float64",
        bodies=(block(SPONGE, (0.2, 0.1, 0.0)), fluid),
        boundary=Open(),
        origin=(-0.3, -0.1, -0.3),
        dx=DX,
        nodes=(15, 12, 13),
        dt=1e-3,
        substeps=2,
        steps=2,
        gravity=GRAVITY,
    )
    return replace(found, **changes)


def positions(model, batch=1):
    """Return where the fluid's particles are in each row, moved by up to a quarter of a cell from row to row."""
    x = torch.from_numpy(model.bodies[1].x)
    return torch.stack([x + 0.25 * DX * row / batch for row in range(batch)])


def beyond(model, x, J):
    """Return log J beyond hydrostatics."""
    return J.log() - hydrostatic_slope(model, 1) * x[..., 1]


def smoothed(model, J, x=None):
    x = positions(model, len(J)) if x is None else x
    return smooth_volume_ratios(model, 1, x, J)


def rough(model, seed=0, batch=1):
    generator = torch.Generator().manual_seed(seed)
    return 1 + 0.02 * (2 * torch.rand((batch, COUNT**3), generator=generator, dtype=torch.float64) - 1)


class Kernels:
    """The Warp kernels on volume ratios J and places x of a model's fluid, shape (batch, particle, *)."""

    def __init__(self, model, batch):
        self.model, self.batch = model, batch
        self.solver = Solver(model, capacity=batch, device="cpu")
        self.smoother, self.first = self.solver.smoothers[0], len(model.bodies[0].x)
        self.adjoint = self.solver.allocator.frame()

    def run(self, x, J):
        solver = self.solver
        to_torch(solver.checkpoints[0].x)[:, self.first :] = x
        to_torch(solver.checkpoints[0].S[1])[:] = J
        solver.tape(0).make_room(0, solver.boxes[0], solver.room(0))
        solver.launch_again(("smooth",), 0, self.batch, lambda: self.smoother.run(solver, 0, self.batch))
        return to_torch(solver.tape(0).smoothed[1]).clone()

    def run_back(self, adj_J):
        """Return the adjoints of x and J at which `run` was last called."""
        for array in self.adjoint.arrays():
            array.zero_()
        to_torch(self.adjoint.S[1])[:] = adj_J
        work = partial(self.smoother.run_back, self.solver, 0, self.batch, self.adjoint)
        self.solver.launch_again(("smooth back",), 0, self.batch, work)
        return to_torch(self.adjoint.x)[:, self.first :].clone(), to_torch(self.adjoint.S[1]).clone()


@pytest.fixture(scope="module")
def kernels():
    return Kernels(model(0.7, seed=1), 3)


@pytest.mark.parametrize("gravity", [0.0, GRAVITY])
def test_fluid_at_rest_keeps_its_volume_ratios(gravity):
    tank = model(seed=2, gravity=gravity)
    x = positions(tank)
    J = torch.from_numpy(EVEN.volume_ratio(1e4 + DENSITY * gravity * (SIDE - x.numpy()[..., 1])))
    assert (J.max() - J.min() > 0.05) == (gravity > 0)
    for found in (smoothed(tank, J), Kernels(tank, 1).run(x, J)):
        torch.testing.assert_close(found, J, rtol=1e-14, atol=0)


def test_unevenness_goes_and_a_slope_across_the_fluid_stays_inside():
    even = model()
    x = positions(even)
    J = rough(even) * (hydrostatic_slope(even, 1) * x[:, :, 1]).exp()
    left = beyond(even, x, smoothed(even, J)).std() / beyond(even, x, J).std()
    assert left < 0.35
    sloped = (0.3 * x[:, :, 0] + hydrostatic_slope(even, 1) * x[:, :, 1]).exp()
    change = (beyond(even, x, smoothed(even, sloped)) - beyond(even, x, sloped)).abs()
    inner = (x[0] - x[0].mean(dim=0)).abs().amax(dim=1) < SIDE / 2 - 2 * DX
    assert inner.sum() > 100
    assert change[0, inner].max() < 0.1 * 0.3 * DX
    assert change.max() > 3 * change[0, inner].max()  # the surface has neighbours on one side only


def test_a_share_goes_so_far():
    x, J = positions(model(seed=4)), rough(model(seed=4))
    whole, half = (beyond(model(), x, smoothed(model(share, seed=4), J)) for share in (1.0, 0.5))
    torch.testing.assert_close(half, (beyond(model(), x, J) + whole) / 2, rtol=0, atol=1e-14)


@pytest.mark.parametrize("seed", [None, 5])
def test_the_fluids_volume_stays(seed):
    # sum_p V_p sum_i w_ip s_i = sum_i s_i sum_p V_p w_ip = sum_p V_p s_p, at the surface too.
    tank = model(seed=seed)
    x, J = positions(tank), rough(tank)
    volume = torch.from_numpy(tank.bodies[1].volume)
    before, after = ((volume * beyond(tank, x, values)).sum() for values in (J, smoothed(tank, J)))
    scale = (volume * beyond(tank, x, J).abs()).sum()
    assert abs(float(after - before)) < 1e-13 * float(scale)
    assert (smoothed(tank, J) - J).abs().max() > 0.01


def test_what_others_do_not_know_of_does_not_change_them():
    tank = model(seed=6)
    x, J = positions(tank, 3), rough(tank, batch=3)
    together = smoothed(tank, J)
    far = x[0, :, 0] < -SIDE / 2 + DX / 2
    J[1, far] = 0.9
    alone = smoothed(tank, J)
    assert torch.equal(alone[[0, 2]], together[[0, 2]])
    beyond_reach = x[1, :, 0] > -SIDE / 2 + 5 * DX
    assert torch.equal(alone[1, beyond_reach], together[1, beyond_reach])
    assert not torch.equal(alone[1], together[1])


def test_the_kernels_do_what_the_reference_does(kernels):
    x, J = positions(kernels.model, 3), rough(kernels.model, batch=3)
    torch.testing.assert_close(kernels.run(x, J), smoothed(kernels.model, J), rtol=1e-14, atol=0)
    x, J = x.requires_grad_(), J.requires_grad_()
    weight = rough(kernels.model, seed=7, batch=3) - 1
    wanted = torch.autograd.grad((smoothed(kernels.model, J, x) * weight).sum(), (x, J))
    for ours, theirs in zip(kernels.run_back(weight), wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-12 * float(theirs.abs().max()))


def test_particles_in_the_middle_of_cells_are_neighbours_of_nobody_else():
    # Their farthest nodes get nothing of them, so that these have no mean to give.
    cell, origin = 1 / 16, (-0.25, -0.125, -0.25)
    x = np.array(origin) + cell * (
        np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 3.5
    )
    space = model(gravity=0.0, origin=origin, dx=cell)
    body = Body(EVEN, x, np.full(27, cell**3), np.ones(27))
    space = replace(space, bodies=(space.bodies[0], body))
    J = 1 + 0.01 * torch.arange(27, dtype=torch.float64)[None]
    exact = Kernels(space, 1)
    torch.testing.assert_close(exact.run(positions(space), J), smoothed(space, J), rtol=1e-14, atol=0)
    assert all(adjoint.isfinite().all() for adjoint in exact.run_back(J))


@pytest.mark.parametrize(("name", "tolerance"), [("float32", 2e-5), ("float64", 1e-12)])
def test_a_particle_without_a_logarithm_concerns_its_neighbours_only(name, tolerance):
    """Of eight particles at a time, and five that are left."""
    tank = model(0.7, seed=5, precision=name)
    solid, fluid = tank.bodies
    fewer = Body(fluid.material, *(values[:-3] for values in (fluid.x, fluid.volume, fluid.ratio)))
    tank = replace(tank, bodies=(solid, fewer))
    x, J, adj_J = positions(tank, 2), rough(tank, batch=2)[:, 3:], rough(tank, seed=6, batch=2)[:, 3:] - 1.0
    ours = Kernels(tank, 2)
    whole = [ours.run(x, J), *ours.run_back(adj_J)]
    torch.testing.assert_close(whole[0].double(), smoothed(tank, J, x), rtol=tolerance, atol=0)
    J[1, 7] = -1.0
    for kept, one in zip(whole, [ours.run(x, J), *ours.run_back(adj_J)], strict=True):
        assert torch.equal(one[0], kept[0])
        assert one[0].abs().max() > 0
        lost = one[1].isnan().reshape(len(one[1]), -1).any(dim=1)
        assert 0 < lost.sum() < len(lost)
