"""Kernels for a CPU in C++, each of whose threads has the row of an environment, beside plain ones in Warp's Python."""

from collections.abc import Mapping
from inspect import Parameter, Signature
from typing import Any

import warp as wp

from .runtime import take_rows


def kernel_in_rows(plain: Any, text: str, elements: str, module: str) -> Any:
    """Return a kernel with the arguments of a plain one that runs C++, the `text`, on the row of environment `e`.

    The text knows arguments by their names, but what is `adj_x` there is `x_adjoint` to it: Warp wants the other name.
    `elements` names an argument that has as many elements as the plain kernel has threads in an environment.
    """
    kinds = dict(plain.adj.arg_types)
    known = {_adjoint_last(name): kind for name, kind in kinds.items()}

    def row() -> None: ...

    def kernel() -> Any:
        return row  # which Warp finds here by its name

    row = wp.func_native(text)(with_arguments(row, {"e": int, **known}))
    given = ", ".join(kinds)
    made = wp.Kernel(
        with_arguments(kernel, kinds),
        key=plain.key.replace("__locals__", "_in_rows__locals__"),
        module=wp.get_module(module),
        options={"enable_backward": False},
        source=f"def kernel({given}):\n    e, _ = wp.tid()\n    row(e, {given})\n",
    )
    take_rows(made, plain, elements)
    return made


def _adjoint_last(name: str) -> str:
    return f"{name.removeprefix('adj_')}_adjoint" if name.startswith("adj_") else name


def with_arguments(function: Any, kinds: Mapping[str, Any]) -> Any:
    """Return a function that says of itself that it takes arguments of these names and kinds, as Warp asks it."""
    parameters = [Parameter(name, Parameter.POSITIONAL_OR_KEYWORD, annotation=kind) for name, kind in kinds.items()]
    function.__signature__, function.__annotations__ = Signature(parameters), dict(kinds)
    return function
