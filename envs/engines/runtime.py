"""Start Warp: device, precision, threads, kernel cache."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
import warp as wp

from ...landscapes.storage.files import moved_by

wp.config.log_level = wp.LOG_ERROR  # no banner

Ints = wp.array2d[wp.int32]  # [environment, number]

CACHE = ("WARP_CACHE_PATH", "Warp's kernels")
MANY = ".engines.mpm."  # where solvers are whose kernels are of many modules


def _start() -> None:
    """Start Warp without its native complaint, on standard error, where there is no GPU."""
    previous, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        with moved_by(*CACHE):
            wp.init()
    finally:
        os.dup2(previous, 2)
        os.close(previous)
        os.close(nowhere)


_start()


@dataclass(frozen=True)
class Precision:
    """Tie one floating-point precision to its Warp and torch types."""

    name: str
    real: Any
    vec3: Any
    vec4: Any
    mat33: Any
    torch: torch.dtype

    @property
    def rows(self) -> tuple[Any, Any, Any, Any]:
        """Arrays [environment, element] of numbers, of vectors, of four numbers each, and of matrices."""
        return wp.array2d[self.real], wp.array2d[self.vec3], wp.array2d[self.vec4], wp.array2d[self.mat33]


@cache
def precision(name: str) -> Precision:
    """Return the types of `float32` or `float64`. Raises ValueError for any other name."""
    reals = {"float32": (wp.float32, torch.float32), "float64": (wp.float64, torch.float64)}
    if name not in reals:
        raise ValueError(f"precision must be float32 or float64; got {name!r}")
    real, dtype = reals[name]
    vector, matrix = wp.types.vector, wp.types.matrix
    return Precision(name, real, vector(3, real), vector(4, real), matrix((3, 3), real), dtype)


def cuda_available() -> bool:
    """Say whether Warp can drive a CUDA device here."""
    return bool(wp.is_cuda_available())


def device_names() -> list[str]:
    """Return the names of the CUDA devices."""
    return [f"{device.alias}: {device.name}" for device in wp.get_cuda_devices()]


def free_memory() -> int:
    """Return the free bytes of the CUDA device, what was given up until now included."""
    wp.synchronize_device("cuda")
    return int(wp.get_device("cuda").free_memory)


def cores() -> int:
    """Count the cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def to_torch(array: wp.array) -> torch.Tensor:
    """View a Warp array as a tensor of the same memory."""
    tensor: torch.Tensor = wp.to_torch(array, requires_grad=False)
    return tensor


def load(kernels: Iterable[Any], device: str) -> None:
    """Compile kernels in parallel, or fetch them from the cache, before threads launch them.

    To read Warp's headers takes two seconds of any module. The compiler can keep what it has read for the next module
    of the same thread, but that takes a second more: it pays where a solver is of many.
    """
    modules = {kernel.module: kernel.func.__module__ for kernel in kernels}
    before = wp.config.use_precompiled_headers
    wp.config.use_precompiled_headers = any(MANY in where for where in modules.values())
    try:
        with moved_by(*CACHE):
            wp.force_load(device, list(modules), max_workers=cores())
    finally:
        wp.config.use_precompiled_headers = before


def fill_struct(Struct: Any, values: Mapping[str, Any]) -> Any:
    """Return an instance of a Warp struct with values in its fields, by their names."""
    data = Struct()
    for name, value in values.items():
        setattr(data, name, value)
    return data
