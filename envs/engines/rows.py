"""Kernels for a CPU in C++, each of whose threads has the row of an environment, beside plain ones in Warp's Python."""

from collections.abc import Iterable, Mapping
from inspect import Parameter, Signature
from typing import Any

import warp as wp

from . import cpp
from .runtime import take_rows


def kernel_in_rows(plain: Any, function: str, elements: str, module: str, *, constants: Iterable[object] = ()) -> Any:
    """Return a kernel with the arguments of a plain one that calls a function of the headers for each environment.

    The function takes the environment's number, the plain kernel's arguments, and `constants`. `elements` names an
    argument that has as many elements as the plain kernel has threads in an environment.
    """
    kinds = dict(plain.adj.arg_types)
    known = {"e": int} | {_adjoint_last(name): kind for name, kind in kinds.items()}

    def row() -> None: ...

    def kernel() -> Any:
        return row  # which Warp finds here by its name

    row = wp.func_native(cpp.call(function, [*known, *map(str, constants)]))(with_arguments(row, known))
    given = ", ".join(kinds)
    made = wp.Kernel(
        with_arguments(kernel, kinds),
        key=plain.key.replace("__locals__", "_in_rows__locals__"),
        module=wp.get_module(cpp.module(module)),
        options={"enable_backward": False},
        source=f"def kernel({given}):\n    e, _ = wp.tid()\n    row(e, {given})\n",
    )
    take_rows(made, plain, elements)
    return made


def _adjoint_last(name: str) -> str:
    """Return what Warp lets an argument be called: `adj_x` is the name of another one's adjoint."""
    return f"{name.removeprefix('adj_')}_adjoint" if name.startswith("adj_") else name


def with_arguments(function: Any, kinds: Mapping[str, Any]) -> Any:
    """Return a function that says of itself that it takes arguments of these names and kinds, as Warp asks it."""
    parameters = [Parameter(name, Parameter.POSITIONAL_OR_KEYWORD, annotation=kind) for name, kind in kinds.items()]
    function.__signature__, function.__annotations__ = Signature(parameters), dict(kinds)
    return function
