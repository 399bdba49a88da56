"""Mass at nodes: none is lost, its moments are the particles', and it has true gradients."""

import numpy as np
import pytest
import torch

from gradscape.envs.engines.mpm.boundaries import Open
from gradscape.envs.engines.mpm.materials import Elastic
from gradscape.envs.engines.mpm.model import Body, Model
from gradscape.envs.engines.mpm.raster import Raster

from ..bench import draw

COUNT, DX, ORIGIN, NODES = 12, 0.05, (-0.3, 0.2, 1.1), (9, 8, 10)
MASS = 1.5 + draw(COUNT, seed=0)
MIDDLE = torch.tensor(ORIGIN, dtype=torch.float64) + DX * (torch.tensor(NODES) - 1) / 2


def places(batch, seed):
    return MIDDLE + DX * (torch.tensor(NODES) - 4) * draw(batch, COUNT, 3, seed=seed)


def node_positions():
    axes = [start + DX * torch.arange(n, dtype=torch.float64) for start, n in zip(ORIGIN, NODES, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


def make_raster(*, counting=None, name="float64", mass=MASS):
    x = places(1, seed=1)[0].numpy()
    body = Body(Elastic(1.0, 1.0, 0.3), x, np.ones(COUNT), np.ones(COUNT))
    model = Model(name, (body,), Open(), ORIGIN, DX, NODES, dt=1e-3, substeps=1, steps=1)
    return Raster(model, mass.numpy(), capacity=3, device="cpu", counting=counting)


@pytest.fixture(scope="module", params=[False, True], ids=["adding", "counting"])
def raster(request):
    return make_raster(counting=request.param)


def test_masses_that_are_counted_do_not_depend_on_the_order_of_particles():
    x, turned = places(3, seed=7), torch.randperm(COUNT, generator=torch.Generator().manual_seed(8))
    one, other = (make_raster(counting=True, name="float32", mass=MASS[order]) for order in (range(COUNT), turned))
    assert torch.equal(one(x), other(x[:, turned]))


def test_nodes_hold_the_particles_mass_and_its_first_moment(raster):
    x = places(3, seed=2)
    mass = raster(x)
    assert (mass >= 0).all()
    torch.testing.assert_close(mass.sum(dim=1), MASS.sum().expand(3))
    torch.testing.assert_close(mass @ node_positions(), (MASS[:, None] * x).sum(dim=1))


def test_its_second_moment_is_wider_by_the_splines(raster):
    """A quadratic B-spline has the variance dx^2/4 along each axis, wherever its particle is."""
    x = places(3, seed=3)
    wanted = (MASS[:, None] * (x**2 + DX**2 / 4)).sum(dim=1)
    torch.testing.assert_close(raster(x) @ node_positions() ** 2, wanted)


def test_gradients_are_slopes(raster):
    x, weights = places(2, seed=4).requires_grad_(), draw(2, len(node_positions()), seed=5)
    (adjoint,) = torch.autograd.grad((raster(x) * weights).sum(), x)
    direction, step = draw(2, COUNT, 3, seed=6), 1e-6
    with torch.no_grad():
        for p in range(COUNT):
            moved = torch.zeros_like(x)
            moved[:, p] = step * direction[:, p]
            slope = ((raster(x + moved) - raster(x - moved)) * weights).sum(dim=1) / (2 * step)
            torch.testing.assert_close((adjoint * moved).sum(dim=(1, 2)) / step, slope, rtol=1e-6, atol=1e-6)


def test_rows_do_not_meddle(raster):
    """Neither the rows beside one nor the calls before change its bits; a gradient waits for its own positions."""
    x, weights = places(3, seed=7), draw(1, len(node_positions()), seed=8)
    alone = x[1:2].clone().requires_grad_()
    mass = raster(alone)
    together = raster(x)
    assert torch.equal(together[1:2], mass)
    (adjoint,) = torch.autograd.grad((mass * weights).sum(), alone)  # after another call
    again = x.clone().requires_grad_()
    (adjoints,) = torch.autograd.grad((raster(again) * weights).sum(), again)
    assert torch.equal(adjoints[1:2], adjoint)
