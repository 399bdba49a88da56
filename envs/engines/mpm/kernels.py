"""All kernels of a model at once: compiled beside each other, where a solver's parts ask for theirs one by one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import warp as wp

from ..runtime import load
from .cells import cell_kernels
from .columns import GPU_TEAM, column_kernels
from .exact import settle_kernel
from .extent import extent_kernels
from .grid import velocity_on
from .model import Model
from .order import sorting_kernels
from .smoothing import smoothing_columns, smoothing_kernels
from .transfers import transfers, transfers_of_columns


def compile_all(model: Model, device: str) -> None:
    """Compile what a solver of the model launches, forward and backward, or fetch it from the cache."""
    load(kernels(model, device), device)


def kernels(model: Model, device: str) -> Iterator[Any]:
    """Yield a kernel or more of each module, those first that take longest to compile."""
    name = model.precision
    yield from (_of_cpu if device == "cpu" else _of_gpu)(name, any(body.material.smoothing for body in model.groups))
    yield velocity_on(name, model.boundary, columns=device != "cpu")
    for body in model.groups:
        yield from body.material.kernels(name, columns=device != "cpu")
    yield extent_kernels(name).look
    sorting = sorting_kernels(name, wp.int32)  # with which all but huge batches are sorted
    yield sorting.label
    for body in model.groups:
        yield from sorting.states[body.material.state(name)]


def _of_cpu(name: str, smooth: bool) -> Iterator[Any]:
    yield transfers(name).p2g
    if smooth:
        yield smoothing_kernels(name).spread


def _of_gpu(name: str, smooth: bool) -> Iterator[Any]:
    yield from (transfers_of_columns(name).g2p, column_kernels(name, GPU_TEAM).p2g, cell_kernels(name).count)
    yield settle_kernel(name)
    if smooth:
        yield smoothing_columns(name, GPU_TEAM).spread
