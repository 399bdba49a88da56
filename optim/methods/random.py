"""Random search: the baseline for every other method."""

from __future__ import annotations

from typing import ClassVar

import torch

from ...landscapes.options import NoOptions
from ..base import Kind, Optimizer, Points, Proposal

BATCH_SIZE = 16  # points of a proposal: a simulator is quicker at several at once


class RandomSearch(Optimizer):
    """Draw points uniformly from the box."""

    name = "random"
    Options: ClassVar[type[NoOptions]] = NoOptions

    def _ask(self) -> Proposal:
        return Proposal(torch.from_numpy(self.random.uniform(-1.0, 1.0, (BATCH_SIZE, self.space.dim))), Kind.RANDOM)

    def _tell(self, z: Points, loss: Points, grad: Points | None) -> None:
        pass
