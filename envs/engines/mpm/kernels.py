"""All kernels of a model at once: compiled beside each other, where a solver's parts ask for theirs one by one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ..runtime import load
from .grid import velocity_kernel
from .model import Model
from .order import sorting_kernels
from .smoothing_cpu import smoothing_on
from .transfers_cpu import transfers_on

COMPUTES_LOSSES = False  # for `code`: what is compiled here, a solver would compile itself


def compile_all(model: Model, device: str, *, deterministic: bool = False) -> None:
    """Compile what a solver of the model launches, forward and backward, or fetch it from the cache."""
    load(kernels(model, device, deterministic=deterministic), device)


def kernels(model: Model, device: str, *, deterministic: bool = False) -> Iterator[Any]:
    """Yield a kernel or more of each module, those first that take longest to compile."""
    name = model.precision
    yield transfers_on(device, name, deterministic=deterministic).p2g
    if any(body.material.smoothing for body in model.bodies):
        smoothing = smoothing_on(device, name, deterministic=deterministic)
        yield smoothing.spread
        yield smoothing.clear  # of another module where the others take rows
    yield velocity_kernel(name, *model.boundary.function(name), deterministic=deterministic)
    for body in model.bodies:
        yield from body.material.kernels(name, rows=device == "cpu")
    sorting = sorting_kernels(name)
    yield sorting.label
    for body in model.bodies:
        yield from sorting.states[body.material.state(name)]
