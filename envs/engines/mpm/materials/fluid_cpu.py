"""The kernels of `fluid` for a CPU in float32, in C++: eight particles at a time, and the same bits."""

from functools import cache
from typing import Any

from ...rows import kernel_in_rows
from .fluid import TORN, kernels


@cache
def kernels_in_rows(name: str = "float32") -> tuple[Any, Any]:
    """Return (update, adjoint), each of whose threads has the row of an environment."""
    (update, adjoint, *_), module = kernels(name), f"gradscape.fluid.{name}.rows"
    return (
        kernel_in_rows(update, "fluid_update", "J", module, constants=[TORN]),
        kernel_in_rows(adjoint, "fluid_adjoint", "J", module, constants=[TORN]),
    )
