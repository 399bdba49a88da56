"""Sorting particles between control steps: neighbours on the grid become neighbours, and nothing gets lost."""

from dataclasses import replace

import pytest
import torch
import warp as wp

from gradscape.envs.engines.launches import Launches
from gradscape.envs.engines.mpm.order import Order, Sorter
from gradscape.envs.engines.mpm.solver import Solver
from gradscape.envs.engines.runtime import to_torch

from .bodies import free_model

BATCH = 2


@pytest.fixture(scope="module")
def sorted_once():
    """Return a model, a frame of scattered particles, and that frame sorted, with its order, and what sorted it."""
    return sort_scattered(free_model())


def sort_scattered(model, **changes):
    solver = Solver(model, capacity=BATCH, device="cpu")
    old, new = solver.allocator.frame(), solver.allocator.frame()
    generator = torch.Generator().manual_seed(0)
    for array in old.arrays():
        view = to_torch(array)
        view[:] = torch.rand(view.shape, generator=generator, dtype=view.dtype)
    room = model.dx * (torch.tensor(model.nodes) - 1)
    to_torch(old.x)[:] = torch.tensor(model.origin, dtype=torch.float64) + to_torch(old.x) * room
    before, order, launches = Order(model, BATCH, "cpu"), Order(model, BATCH, "cpu"), Launches("cpu")
    sorter = Sorter(replace(model, **changes), BATCH, "cpu", launches)
    launches.run("sort", BATCH, lambda: sorter.sort(old, new, before, order, BATCH), small=False)
    return model, old, new, order, sorter


def cells(model, x):
    node = ((x - torch.tensor(model.origin, dtype=torch.float64)) / model.dx - 0.5).clamp_min(0).long()
    node = node.minimum(torch.tensor(model.nodes) - 1)
    return (node[..., 0] * model.nodes[1] + node[..., 1]) * model.nodes[2] + node[..., 2]


def test_particles_of_each_body_come_in_the_order_of_their_cells(sorted_once):
    model, _, new, _, _ = sorted_once
    key = cells(model, to_torch(new.x))
    for body in torch.split(key, [len(body.x) for body in model.bodies], dim=1):
        assert (body.diff(dim=1) >= 0).all()
    assert len(key[0].unique()) > 50


def test_everything_a_particle_has_goes_with_it_and_comes_back(sorted_once):
    _, old, new, order, sorter = sorted_once
    for name in ("x", "v", "C"):
        assert torch.equal(order.to_model(to_torch(getattr(new, name))), to_torch(getattr(old, name)))
        assert torch.equal(order.from_model(to_torch(getattr(old, name))), to_torch(getattr(new, name)))
    again = type(old)(*(wp.zeros_like(array) for array in (old.x, old.v, old.C)), tuple(map(wp.zeros_like, old.S)))
    sorter.launches.run("unsort", BATCH, lambda: sorter.unsort(new, again, order, BATCH), small=False)
    for back, array in zip(again.arrays(), old.arrays(), strict=True):
        assert torch.equal(to_torch(back), to_torch(array))


def test_masses_and_volumes_lie_in_the_same_order(sorted_once):
    model, _, _, order, _ = sorted_once
    for array, values in ((order.mass, model.mass), (order.volume, model.volume)):
        assert torch.equal(order.to_model(to_torch(array)), torch.from_numpy(values).expand(BATCH, -1))


def test_a_grid_of_more_cells_than_an_integer_counts_is_sorted_alike(sorted_once):
    model, _, new, order, sorter = sorted_once
    _, _, again, other, large = sort_scattered(model, nodes=(1200, 1200, 1200))
    assert (sorter.keys.dtype, large.keys.dtype) == (wp.int32, wp.int64)
    assert torch.equal(to_torch(other.name), to_torch(order.name))
    assert torch.equal(to_torch(again.x), to_torch(new.x))
