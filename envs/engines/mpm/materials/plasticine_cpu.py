"""The kernels of `plasticine` for a CPU in float32, in C++: eight particles at a time, and the same bits."""

from functools import cache
from typing import Any

from ...rows import kernel_in_rows
from .decomposition import ROUND_OFF, SWEEPS, TINY
from .plasticine import ROUNDED, SMALLEST, kernels


@cache
def kernels_in_rows(name: str = "float32") -> tuple[Any, Any]:
    """Return (update, adjoint), each of whose threads has the row of an environment."""
    (update, adjoint, *_), module = kernels(name), f"gradscape.plasticine.{name}.rows"
    constants = [SMALLEST, ROUNDED, ROUND_OFF[name], TINY, SWEEPS]
    return (
        kernel_in_rows(update, "plasticine_update", "F", module, constants=constants),
        kernel_in_rows(adjoint, "plasticine_adjoint", "F", module, constants=constants),
    )
