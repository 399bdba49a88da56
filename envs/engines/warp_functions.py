"""An objective of a function that launches Warp kernels, differentiated by Warp's tape."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ...landscapes.adapters import check_shape, function_name
from ...landscapes.objective import Evaluation, Objective
from ...landscapes.space import ParameterSpace, as_whole
from .functions import ROWS, FunctionObjective
from .runtime import cuda_available, precision

CORRUPTS = "This may corrupt gradient computation"  # how Warp ends what it says of an array that is overwritten


def from_warp(
    fn: Callable[[Any], Any],
    space: ParameterSpace,
    *,
    name: str | None = None,
    loss_unit: str = "",
    precision: str = "float32",
    device: str = "auto",
    rows: int = ROWS,
    check_overwrites: bool = True,
) -> Objective:
    """Make an objective of a function that launches Warp kernels, from points to losses.

    The function takes a Warp array of points, shape (batch, dim), and returns one of losses, shape (batch,), both of
    `precision`; each loss may depend on its own row only. At most `rows` points are in one call. What it launches is
    recorded on a tape, and the tape is played backwards for the gradients; the gradients of arrays that the function
    keeps are set to zero after each evaluation. The losses are made with requires_grad=True.

    A kernel that writes to an array which an earlier one has read makes gradients wrong without a word.
    `check_overwrites` looks for that once, before the first gradient, and builds the function's kernels anew for it,
    which may take long; leave it out for a simulator that is known to be right.

    Raises ValueError for other precisions and devices; evaluating raises it where the function returns no such array,
    launches nothing, does not read its points, or writes to what was read.
    """
    at = ("cuda" if cuda_available() else "cpu") if device == "auto" else device
    if at not in ("cpu", "cuda") or (at == "cuda" and not cuda_available()):
        raise ValueError(f"from_warp runs on auto, cpu, or cuda where there is a CUDA device; got device {device!r}")
    most = as_whole(rows, "from_warp's rows", least=1)
    return WarpObjective(fn, space, name or function_name(fn), loss_unit, precision, most, at, check_overwrites)


@dataclass(eq=False)
class WarpObjective(FunctionObjective):
    """What `from_warp` makes; `unchecked` until it has looked for what is overwritten."""

    device: str
    unchecked: bool

    def __post_init__(self) -> None:
        self.real = precision(self.precision).real

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        with wp.ScopedDevice(self.device):
            if grad and self.unchecked:
                self._refuse_overwrites(x[:1])
                self.unchecked = False
            points: Any = wp.array(x.numpy(), dtype=self.real, requires_grad=grad)
            if not grad:
                return Evaluation.from_results(_tensor(self._losses(points)), None)
            tape = wp.Tape()
            with tape:
                losses = self._losses(points)
            try:
                slope = self._gradient(tape, losses, points)
            finally:
                tape.zero()  # of arrays that the function keeps
            return Evaluation.from_results(_tensor(losses), slope)

    def _losses(self, points: Any) -> Any:
        """Return what the function makes of points, held against what it must be."""
        losses = self.fn(points)
        if not isinstance(losses, wp.array):
            raise ValueError(f"{self.name} must return a Warp array; got {type(losses).__name__}")
        check_shape(tuple(losses.shape), (len(points),), "losses", self.name)
        if losses.dtype != self.real:
            raise ValueError(
                f"{self.name} must return losses of {self.real.__name__}, as its points are; got "
                f"{losses.dtype.__name__} (from_warp's precision says which)"
            )
        return losses

    def _gradient(self, tape: Any, losses: Any, points: Any) -> Float[Tensor, "batch dim"]:
        if not tape.launches:
            raise ValueError(
                f"{self.name} launched no kernel, so its tape is empty; launch kernels that read its points and write "
                "its losses, or sample with gradients=0 (--no-gradients)"
            )
        if not losses.requires_grad:
            raise ValueError(f"{self.name} returned losses that carry no gradient; make them with requires_grad=True")
        tape.backward(grads={losses: wp.ones_like(losses, requires_grad=False)})
        if points not in tape.gradients:
            raise ValueError(f"{self.name} launched no kernel that reads its points, so its losses have no gradient")
        return _tensor(tape.gradients[points])

    def _refuse_overwrites(self, x: Float[Tensor, "batch dim"]) -> None:
        """Raise ValueError where a kernel writes to what an earlier one has read."""
        points: Any = wp.array(x.numpy(), dtype=self.real, requires_grad=True)
        with wp.Tape() as tape:  # which kernels there are: they are built anew to be looked at
            self._losses(points)
        kernels = [launch[0] for launch in tape.launches if isinstance(launch, list)]
        with _overwrites() as said:
            for module in {kernel.module for kernel in kernels}:
                module.mark_modified()
                module.unload()
            with wp.Tape() as tape:
                self._losses(points)
            tape.reset()
        launched = [f"in kernel {kernel.adj.fun_name} at" for kernel in kernels]  # a module may hold others
        found = [one for one in said if any(name in one for name in launched)]
        if found:
            raise ValueError(
                f"{self.name} writes to what it has read, so its gradients would be wrong: {found[0]} "
                "Write to an array of its own for each step, or pass check_overwrites=False to from_warp"
            )


@contextmanager
def _overwrites() -> Iterator[list[str]]:
    """Let Warp look for arrays that are written to after they were read, and gather what it says of them."""
    listener, logger = _Listener(), wp.get_logger()
    level, verify = wp.config.log_level, wp.config.verify_autograd_array_access
    wp.set_logger(listener)
    wp.config.log_level, wp.config.verify_autograd_array_access = wp.LOG_WARNING, True
    try:
        yield listener.said
    finally:
        wp.config.log_level, wp.config.verify_autograd_array_access = level, verify
        wp.set_logger(logger)


class _Listener:
    """Keep what Warp says of arrays that are overwritten, and nothing else."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def warning(self, message: str, category: Any = None, stacklevel: int = 1) -> None:
        """Keep a warning of an overwritten array, from where the array's own text ends."""
        if CORRUPTS in message:
            self.said.append(" ".join(message.split(" passed to ", 1)[-1].split(CORRUPTS)[0].split()))

    def debug(self, message: str) -> None:
        """Drop it."""

    def info(self, message: str) -> None:
        """Drop it."""

    def error(self, message: str) -> None:
        """Drop it: what fails raises."""


def _tensor(values: Any) -> Tensor:
    return torch.from_numpy(np.array(values.numpy(), dtype=np.float64))  # a copy: on a CPU Warp gives its own memory
