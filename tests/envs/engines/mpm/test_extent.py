"""The corners between which particles are, as a control step reads them back."""

import pytest
import torch
import warp as wp

from gradscape.envs.engines.launches import Launches
from gradscape.envs.engines.mpm.checkpoints import Allocator
from gradscape.envs.engines.mpm.solver import Extent
from gradscape.envs.engines.runtime import to_torch

from .bodies import free_model

BATCH = 3


parts = pytest.mark.parametrize(
    "parts", [(1, 1), (7, 5), (1000, 64)], ids=["a CPU's", "that divide nothing", "more than particles"]
)


def found(parts, change=lambda x, left: None, batch=BATCH):
    allocator = Allocator(free_model(), BATCH, "cpu")
    frame, left = allocator.frame(), wp.zeros(BATCH, dtype=wp.int32, device="cpu")
    x = to_torch(frame.x)
    x[:] = torch.randn(x.shape, generator=torch.Generator().manual_seed(1), dtype=x.dtype)
    change(x, to_torch(left))
    one = Extent(allocator, Launches("cpu"), shares=parts[0], lanes=parts[1])
    needed = wp.array([5, 7, 6], dtype=wp.int32, device="cpu")
    one.find(frame.x, left, needed, batch, small=False)
    return x, *one.read()


@parts
@pytest.mark.parametrize("batch", [1, BATCH])
def test_corners_are_those_of_all_particles_of_the_batch(parts, batch):
    x, low, high, left, needed = found(parts, batch=batch)
    assert (low == x[:batch].amin(dim=(0, 1)).numpy()).all()
    assert (high == x[:batch].amax(dim=(0, 1)).numpy()).all()
    assert not left
    assert needed == (7 if batch == BATCH else 5)


@parts
def test_one_row_that_left_is_told(parts):
    def leave(x, left):
        left[1] = 2

    assert found(parts, leave)[3]
    assert not found(parts, leave, batch=1)[3]


@parts
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_corners_are_not_finite_where_a_particle_is_not(parts, value):
    def explode(x, left):
        x[2, -1, 1] = value

    _, low, high, left, _ = found(parts, explode)
    assert not torch.tensor([*low, *high]).isfinite().all()
    assert left
    assert not found(parts, explode, batch=2)[3]
