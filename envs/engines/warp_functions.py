"""Functions that launch Warp kernels, differentiated by Warp's tape."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ...landscapes.objective import SimulatorError
from ..base import check_shape
from ..user_functions import Compute, Function
from .runtime import cuda_available as cuda_available
from .runtime import precision as types_of
from .warp_origins import warp_origin, wrong_kernel

CORRUPTS = "This may corrupt gradient computation"  # how Warp ends what it says of an array that is overwritten


class WarpCompute(Compute):
    """Call a function that launches Warp kernels; it is `unchecked` until a search for overwritten arrays."""

    def __init__(
        self, unchecked: bool, call: Function, settings: Mapping[str, Any], precision: str, device: str
    ) -> None:
        self.unchecked, self.fn, self.name = unchecked, partial(call.fn, **settings), call.name
        self.precision, self.real, self.device = precision, types_of(precision).real, device

    def __call__(self, x: Float[Tensor, "batch dim"], grad: bool) -> tuple[Tensor, Tensor | None, str]:
        """Return losses, gradients if asked for, and the type of numbers that losses come in."""
        with wp.ScopedDevice(self.device):
            if grad and self.unchecked:
                self._refuse_overwrites(x[:1])
                self.unchecked = False
            points: Any = wp.array(x.numpy(), dtype=self.real, requires_grad=grad)
            if not grad:
                return _tensor(self._losses(points)), None, self.precision
            tape = wp.Tape()
            with tape:
                losses = self._losses(points)
            try:
                slope = self._gradient(tape, losses, points)
            finally:
                tape.zero()  # of arrays that the function keeps
            return _tensor(losses), slope, self.precision

    def nan_origin(self, x: Float[Tensor, "one dim"]) -> str:
        """Return which kernel makes the gradient at a point not finite, and by which argument."""
        with self._recorded(x) as (tape, losses):
            return warp_origin(tape, losses)

    def wrong_origin(self, x: Float[Tensor, "one dim"]) -> str:
        """Return which kernel's adjoint differs from its differences at a point, or what is overwritten."""
        try:
            with wp.ScopedDevice(self.device):
                self._refuse_overwrites(x)
        except SimulatorError as error:
            return _line(error)
        with self._recorded(x) as (tape, _):
            return wrong_kernel(tape)

    @contextmanager
    def _recorded(self, x: Float[Tensor, "one dim"]) -> Iterator[tuple[Any, Any]]:
        """Give the tape of a point and its loss."""
        with wp.ScopedDevice(self.device):
            points: Any = wp.array(x.numpy(), dtype=self.real, requires_grad=True)
            with wp.Tape() as tape:
                losses = self._losses(points)
            try:
                yield tape, losses
            finally:
                tape.zero()  # of arrays that the function keeps

    def _losses(self, points: Any) -> Any:
        """Return what the function makes of points, held against what it must be."""
        try:
            losses = self.fn(points)
        except Exception as error:  # Warp's own types of errors differ from release to release
            if wanted := _wanted_type(error, self.real):
                raise SimulatorError(
                    f"{self.name} launches kernels that take {wanted}, but its points are {self.precision}; pass "
                    f"precision={wanted!r} to from_warp, or write kernels for {self.precision} ({_line(error)})"
                ) from error
            raise
        if not isinstance(losses, wp.array):
            raise SimulatorError(f"{self.name} must return a Warp array; got {type(losses).__name__}")
        check_shape(tuple(losses.shape), (len(points),), "losses", self.name)
        if losses.dtype != self.real:
            raise SimulatorError(
                f"{self.name} must return losses of {self.real.__name__}, like its points; got "
                f"{losses.dtype.__name__} (from_warp's precision sets the type)"
            )
        return losses

    def _gradient(self, tape: Any, losses: Any, points: Any) -> Float[Tensor, "batch dim"]:
        if not tape.launches:
            raise SimulatorError(
                f"{self.name} launched no kernel, so its tape is empty; launch kernels that read its points and write "
                "its losses, or sample with gradients=0 (--no-gradients)"
            )
        if not losses.requires_grad:
            raise SimulatorError(f"{self.name} returned losses without a gradient; make them with requires_grad=True")
        tape.backward(grads={losses: wp.ones_like(losses, requires_grad=False)})
        if points not in tape.gradients:
            raise SimulatorError(
                f"{self.name} launched no kernel that reads its points, so its losses have no gradient"
            )
        return _tensor(tape.gradients[points])

    def _refuse_overwrites(self, x: Float[Tensor, "batch dim"]) -> None:
        """Raise SimulatorError where a kernel writes to what an earlier one has read."""
        points: Any = wp.array(x.numpy(), dtype=self.real, requires_grad=True)
        with wp.Tape() as tape:  # which kernels there are: they are built again to be looked at
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
            raise SimulatorError(
                f"{self.name} overwrites an array that it has read, so its gradients would be wrong: {found[0]} Write "
                "each step to its own array, or pass check_overwrites=False to from_warp"
            )


@contextmanager
def _overwrites() -> Iterator[list[str]]:
    """Let Warp look for arrays that are written to after they were read, and gather what it says of them alone."""
    said, logger = list[str](), wp.get_logger()

    def warning(message: str, category: Any = None, stacklevel: int = 1) -> None:
        if CORRUPTS in message:  # from where the array's own text ends
            said.append(" ".join(message.split(" passed to ", 1)[-1].split(CORRUPTS)[0].split()))

    def drop(message: str) -> None: ...

    level, verify = wp.config.log_level, wp.config.verify_autograd_array_access
    wp.set_logger(SimpleNamespace(warning=warning, debug=drop, info=drop, error=drop))
    wp.config.log_level, wp.config.verify_autograd_array_access = wp.LOG_WARNING, True
    try:
        yield said
    finally:
        wp.config.log_level, wp.config.verify_autograd_array_access = level, verify
        wp.set_logger(logger)


def _wanted_type(error: Exception, real: Any) -> str:
    """Return the precision that a kernel's argument has where Warp refused ours for it, empty for another error."""
    said, other = str(error), {"float32": "float64", "float64": "float32"}[real.__name__]
    return other if real.__name__ in said and other in said else ""


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def _tensor(values: Any) -> Tensor:
    return torch.from_numpy(np.array(values.numpy(), dtype=np.float64))  # a copy: on a CPU Warp gives its own memory
