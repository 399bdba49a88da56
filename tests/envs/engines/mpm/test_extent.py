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


@pytest.mark.parametrize(
    ("shares", "lanes"), [(1, 1), (7, 5), (1000, 64)], ids=["a CPU's", "that divide nothing", "more than particles"]
)
def test_corners_are_those_of_all_particles_of_the_batch_and_one_that_left_is_told(shares, lanes):
    allocator = Allocator(free_model(), BATCH, "cpu")
    frame, left = allocator.frame(), wp.zeros(BATCH, dtype=wp.int32, device="cpu")
    needed = wp.array([5, 7, 6], dtype=wp.int32, device="cpu")
    one, x = Extent(allocator, Launches("cpu"), shares=shares, lanes=lanes), to_torch(frame.x)
    x[:] = torch.randn(x.shape, generator=torch.Generator().manual_seed(1), dtype=x.dtype)

    def found(batch):
        one.find(frame.x, left, needed, batch, small=False)
        return one.read()

    for batch in (1, BATCH):
        low, high, gone, most = found(batch)
        assert (low == x[:batch].amin(dim=(0, 1)).numpy()).all()
        assert (high == x[:batch].amax(dim=(0, 1)).numpy()).all()
        assert not gone
        assert most == (7 if batch == BATCH else 5)
    to_torch(left)[1] = 2
    assert [found(batch)[2] for batch in (1, BATCH)] == [False, True]
    for value in (torch.nan, torch.inf, -torch.inf):  # so that a loss which does not look at that particle is told
        left.zero_()
        x[2, -1, 1] = value
        low, high, gone, _ = found(BATCH)
        assert not torch.tensor([*low, *high]).isfinite().all()
        assert gone
        left.zero_()
        assert not found(2)[2]
