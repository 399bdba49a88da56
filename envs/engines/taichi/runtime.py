"""Start Taichi: once per process, on one device, quietly."""

import os
import warnings
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from typing import Any

import torch

from ..runtime import cores, precision

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # it asks locale for what Python 3.15 will not have
    import taichi as ti  # type: ignore[import-untyped]

__all__ = ["real", "start", "ti"]

_started: list[str] = []  # the device


def start(device: str) -> Any:
    """Start Taichi on cpu or cuda, unless it runs there already, and return its module.

    Raises ValueError where Taichi cannot run on that device, or runs on the other one already in this process.
    Fields must name their types and kernels cast their literals: a float that does neither is a float64.
    """
    if device not in ("cpu", "cuda"):
        raise ValueError(f"Taichi runs on cpu and cuda; got device {device!r}")
    if _started and _started != [device]:
        raise ValueError(f"Taichi runs only on {_started[0]} in this process; start another process for {device}")
    if not _started:
        _init(device)
        torch.set_flush_denormal(False)  # Taichi sets it for the whole thread, and so for what others compute there
        _started.append(device)
    return ti


@cache
def real(name: str) -> Any:
    """Return Taichi's type of `float32` or `float64`. Raises ValueError for any other name."""
    return ti.f32 if precision(name).name == "float32" else ti.f64


def _init(device: str) -> None:
    wanted = ti.cuda if device == "cuda" else ti.cpu
    if device == "cuda" and not ti._lib.core.with_cuda():
        raise ValueError("Taichi found no CUDA device here; use device cpu")
    with redirect_stdout(StringIO()):  # it says on which arch it starts, whatever its log level
        ti.init(arch=wanted, default_fp=ti.f64, cpu_max_num_threads=cores(), log_level=ti.ERROR)
