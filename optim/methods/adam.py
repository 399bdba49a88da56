"""Adam from random starts, by torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ..base import Points
from ..options import MANY, MethodOptions, number
from .descent import Descending, Descents, lacks


@dataclass(frozen=True)
class AdamOptions(MethodOptions):
    """How a descent moves in the box scaled to [-1, 1], and when it ends.

    `rate` is the learning rate, about what a parameter moves by in a step at first; `beta1` and `beta2` say how slowly
    the means of gradients and of their squares forget (torch's defaults). A descent ends after `steps` iterates, or
    when the loss has failed more than `patience` times in a row to fall below the best so far by `tolerance`, a
    fraction of it. `batch_size` descents are evaluated as one batch.
    """

    method = "adam"

    rate: float = number(0.05, 1e-12, 1000)
    beta1: float = number(0.9, 0, 0.999999)
    beta2: float = number(0.999, 0, 0.999999)
    steps: int = number(100, 1, MANY)
    patience: int = number(20, 0, MANY)
    tolerance: float = number(1e-4, 0, 1)
    batch_size: int = number(4, 1, 10_000)


class AdamDescent(Descending):
    """Follow gradients by torch's Adam from `start`, inside the box, until an episode fails or has no gradient."""

    def __init__(self, start: Points, options: AdamOptions) -> None:
        super().__init__(start, options)
        self._z = torch.from_numpy(self.at.copy())
        self._adam = torch.optim.Adam([self._z], lr=options.rate, betas=(options.beta1, options.beta2), foreach=False)

    def tell(self, loss: float, grad: Points) -> None:
        """Take in the iterate's loss, +inf where the episode failed, and gradient, shape (dim,); move on or end."""
        if not math.isfinite(loss):
            self.done = True
            return
        self.done = self._ends_with(loss) or lacks(grad)
        if lacks(grad):
            return
        self._z.grad = torch.from_numpy(np.nan_to_num(grad))
        self._adam.step()
        self.at = self._z.clamp_(-1.0, 1.0).numpy().copy()

    def state(self) -> dict[str, Any]:
        """Return where the descent stands, as data."""
        moments = {name: value.numpy() for name, value in self._adam.state[self._z].items()}
        kept = {name: value for name, value in super().state().items() if name not in ("_z", "_adam")}
        return kept | {"moments": moments}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take back what `state` returned."""
        super().restore({name: value for name, value in state.items() if name != "moments"})
        self._z.copy_(torch.from_numpy(self.at))
        if state["moments"]:
            self._adam.state[self._z] = {
                name: torch.from_numpy(np.array(value)) for name, value in state["moments"].items()
            }


class Adam(Descents):
    """Descend by torch's Adam from uniformly random starts; where one descent ends the next begins."""

    name = "adam"
    Options = AdamOptions
    Descent = AdamDescent
    held = 10_000
