"""Where a gradient of Warp first is not finite: a tape is played backwards launch by launch."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp


def warp_origin(tape: Any, losses: Any) -> str:
    """Return the kernel whose adjoint is the first, backwards from the losses, that is not finite, and by what.

    Empty where all are finite.
    """
    grads = {losses: wp.ones_like(losses, requires_grad=False)}
    launches = tape.launches
    try:
        for launch in reversed(launches):
            tape.launches = [launch]
            tape.backward(grads=grads)
            grads = None
            if said := _broken(tape, launch):
                return said
    finally:
        tape.launches = launches
    return ""


def _broken(tape: Any, launch: Any) -> str:
    """Return the launch where a derivative by one of its arguments is not finite, and which; else nothing."""
    if callable(launch):  # such as a copy
        broken = any(not _finite(array) for array in list(tape.gradients) if isinstance(array, wp.array))
        return "a function that the tape has recorded, or a copy" if broken else ""
    kernel, values = launch[0], (*launch[3], *launch[4])
    for value, argument in zip(values, kernel.adj.args, strict=True):
        for part, array in _arrays(value, argument.label):
            if not _finite(array):
                return f"{_describe_kernel(kernel)}, by its argument {part}"
    return ""


def _describe_kernel(kernel: Any) -> str:
    """Return a kernel's name and where it is defined."""
    adjoint = kernel.adj
    return f"kernel {adjoint.fun_name} in line {adjoint.fun_lineno} of {Path(adjoint.filename).name}"


def _arrays(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield the arrays that have gradients in an argument: itself, or those of a struct, with their names."""
    if isinstance(value, wp.array):
        if value.grad is not None:
            yield name, value
    elif (kind := getattr(value, "_cls", None)) is not None:
        for part in kind.vars:
            yield from _arrays(getattr(value, part), f"{name}.{part}")


def _finite(array: Any) -> bool:
    return array.grad is None or bool(np.isfinite(_numbers(array.grad)).all())


def _numbers(array: Any) -> Any:
    """Return the numbers of an array of floating-point numbers, vectors or matrices."""
    return np.asarray(array.numpy(), dtype=np.float64)
