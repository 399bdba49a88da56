"""C++ in kernels: the headers in `native/`, and their functions as Warp knows them.

Every module of kernels that call such a function takes the headers' text, which is part of what Warp's cache knows a
module by: one that changes is compiled again.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Any

import warp as wp

HEADERS = Path(__file__).parent / "native"
INCLUDE = re.compile(r'^#include "(\w+\.h)"\n|^#pragma once\n', re.MULTILINE)


@cache
def options() -> dict[str, Any]:
    """Return the options of a module whose kernels call functions of the headers."""
    build = wp.ModuleBuildOptions(extra_cpu_preamble=whole_text("cpu.h"), extra_cuda_preamble=whole_text("gpu.h"))
    return {"extra_build_options": build}


def whole_text(header: str) -> str:
    """Return a header with those of ours that it includes, each once, and without those of Warp."""
    taken: set[str] = set()

    def text(name: str) -> str:
        if name in taken or not (HEADERS / name).is_file():
            return ""
        taken.add(name)
        return INCLUDE.sub(lambda found: text(found[1]) if found[1] else "", (HEADERS / name).read_text())

    return text(header)


def module(name: str) -> str:
    """Return the name of a module whose kernels may call functions of the headers."""
    wp.get_module(name).options.update(options())
    return name


def call(function: str, arguments: Iterable[str], *, template: Iterable[object] = ()) -> str:
    """Return the C++ that calls a function of the headers."""
    given = ", ".join(map(str, template))
    return f"gradscape::{function}{f'<{given}>' if given else ''}({', '.join(arguments)});"


def func_native(
    *, template: Iterable[object] = (), called: str | None = None, adjoint: str | None = None, replay: bool = True
) -> Callable[[Any], Any]:
    """Declare a function of the headers to Warp by one of Python with its arguments, which has no body.

    To be written `@cpp.func_native(...)`: by this name in a decorator Warp knows a function whose type is declared.
    It is `called` as that one is, unless another name is given, and may have constants for its `template`. An `adjoint`
    takes its arguments, their adjoints, and that of what it returns; an empty name is of one that does nothing. Without
    `replay` an adjoint kernel does not call it again.
    """

    def declare(function: Any) -> Any:
        taken, returns = list(signature(function).parameters), "return" in function.__annotations__
        name = called or function.__name__
        function.__qualname__ = "_".join([function.__qualname__, *map(str, template)])  # which tells functions apart
        code = ("return " if returns else "") + call(name, taken, template=template)
        adjoints = [*taken, *(f"adj_{one}" for one in taken), *(["adj_ret"] if returns else [])]
        back = adjoint and call(adjoint, adjoints, template=template)
        return wp.func_native(code, adj_snippet=back, replay_snippet=None if replay else "")(function)

    return declare


def kernel_in_rows(name: str, function: str, *constants: object, **kinds: Any) -> Any:
    """Return a kernel of a module for a CPU, each of whose threads has the row of an environment.

    Its arguments are of these `kinds`, by their names. It calls a function of the headers, which takes the
    environment's number, the arguments, and `constants`.
    """
    known = {"e": int} | {_adjoint_last(one): kind for one, kind in kinds.items()}

    def row() -> None: ...

    def kernel() -> Any:
        return row  # which Warp finds here by its name

    row = wp.func_native(call(function, [*known, *map(str, constants)]))(with_arguments(row, known))
    given = ", ".join(kinds)
    made = wp.Kernel(
        with_arguments(kernel, kinds),
        key=f"rows__locals__{function}",
        module=wp.get_module(module(name)),
        options={"enable_backward": False},
        source=f"def kernel({given}):\n    e, _ = wp.tid()\n    row(e, {given})\n",
    )
    return take_rows(made)


def _adjoint_last(name: str) -> str:
    """Return what Warp lets an argument be called: `adj_x` is the name of another one's adjoint."""
    return f"{name.removeprefix('adj_')}_adjoint" if name.startswith("adj_") else name


def with_arguments(function: Any, kinds: Mapping[str, Any]) -> Any:
    """Return a function that says of itself that it takes arguments of these names and kinds, as Warp asks it."""
    parameters = [Parameter(name, Parameter.POSITIONAL_OR_KEYWORD, annotation=kind) for name, kind in kinds.items()]
    function.__signature__, function.__annotations__ = Signature(parameters), dict(kinds)
    return function


def take_rows(kernel: Any) -> Any:
    """Note that a thread of a kernel has the row of an environment."""
    kernel.has_rows = True
    return kernel


def threads(kernel: Any, elements: int) -> int:
    """Return how many threads of a kernel an environment takes that has so many elements: one where it has rows."""
    return 1 if getattr(kernel, "has_rows", False) else elements
