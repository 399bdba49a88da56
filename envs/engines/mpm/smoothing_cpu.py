"""The kernels of `smoothing` for a CPU in float32, in C++: eight particles or three nodes at a time, the same bits."""

from functools import cache
from types import SimpleNamespace

from ..rows import kernel_in_rows
from .smoothing_kernels import smoothing_kernels


@cache
def smoothing_in_rows(name: str = "float32") -> SimpleNamespace:
    """Return the kernels `clear, spread, collect, adjoint_collect, adjoint_spread`, all but the first in rows."""
    kernels, module = dict(vars(smoothing_kernels(name))), f"gradscape.smoothing.{name}.rows"
    counted = {"spread": "J", "collect": "J", "adjoint_collect": "J_new", "adjoint_spread": "J"}
    for key, elements in counted.items():
        kernels[key] = kernel_in_rows(kernels[key], f"smoothing_{key}", elements, module)
    return SimpleNamespace(**kernels)


def smoothing_on_cpu(name: str) -> SimpleNamespace:
    """Return the smoothing kernels of one precision that are quickest on a CPU."""
    kernels: SimpleNamespace = smoothing_in_rows() if name == "float32" else smoothing_kernels(name)
    return kernels
