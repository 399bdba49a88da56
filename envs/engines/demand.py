"""What a kernel has to move and to calculate, read from the code that Warp makes of it: one side of its roofline.

Williams et al. 2009, Roofline: an insightful visual performance model for multicore architectures. Bytes are those that
no cache can save: each array that a kernel takes is read once, written once, or both, by at most one element for each
thread. Of a scatter or a gather that is less than its instructions ask for, and what a perfect cache would move.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import warp as wp

from .runtime import has_rows

ASSIGNED = re.compile(r"(?:var_(\w+) = )?(wp::)?(\w+)(?:<[^()]*>)?\((.*)\);")
NAME = re.compile(r"\bvar_(\w+)\b")
LOOPS = ("start_for_", "start_while_")
READS = frozenset({"address", "load"})
WRITES = frozenset({"array_store"})
UNTOLD = frozenset({"parts"})  # arrays of which no argument says how much is met: parts of sums by columns of cells
BACKWARD = 3  # times as many operations as forward: these again, and two for each of them
COPYING = "address load extract copy array_store view assign assign_copy select where transpose identity diag neg"
MAKING = "vec_t mat_t quat_t matrix_from_cols float32 float64 int int32 int64 uint32 bool"
FREE = frozenset(f"{COPYING} {MAKING}".split())


class Demand(NamedTuple):
    """The bytes that a launch has to move, and its operations on floating-point numbers [flop], both at least."""

    bytes: int
    flops: float


@dataclass(frozen=True)
class _Code:
    """What a kernel's code does: the arrays it reads and writes, and the operations of a thread.

    Those within a loop whose length the code does not tell count once; `walks` says that such a loop meets arrays.
    """

    reads: frozenset[str]
    writes: frozenset[str]
    flops: float
    walks: bool


def demand(
    kernel: Any, dim: Sequence[int], arguments: Sequence[Any], adjoints: Sequence[Any] = (), *, backward: bool = False
) -> Demand:
    """Return what a launch has to do over `dim` threads, given its arguments, and their adjoints if it is `backward`.

    `dim` begins with the environments, as arrays of two axes and more do. A kernel in C++ whose threads have whole rows
    says which one does the same by Warp's functions, `plain`.
    """
    labels = [argument.label for argument in kernel.adj.args]
    if has_rows(kernel):
        kernel, dim = kernel.plain, (dim[0], _count(arguments[labels.index(kernel.elements)]))
    code = _read(kernel)
    moved = 0
    for label, array in zip(labels, arguments, strict=True):
        if isinstance(array, wp.array) and not (code.walks and label in UNTOLD):
            ways = (label in code.reads) + (label in code.writes and not backward)
            moved += ways * _bytes_met(array, dim, whole=code.walks)
    for label, array in zip(labels, adjoints, strict=False):
        if backward and isinstance(array, wp.array):
            ways = 2 * (label in code.reads) + (label in code.writes)
            moved += ways * _bytes_met(array, dim, whole=code.walks)
    return Demand(moved, code.flops * math.prod(dim) * (BACKWARD if backward else 1))


def _count(elements: Any) -> int:
    """Count the elements of an environment: those of an array's rows, or the nodes of a lattice."""
    return int(elements.shape[1] if isinstance(elements, wp.array) else elements.nx * elements.ny * elements.nz)


def _bytes_met(array: wp.array, dim: Sequence[int], *, whole: bool) -> int:
    """Return the bytes of an array that a launch meets: of its environments all, or an element for each thread."""
    elements = math.prod(array.shape)
    if array.ndim > 1:
        elements = elements // array.shape[0] * min(array.shape[0], dim[0])
    met = elements if whole else min(elements, math.prod(dim))
    return int(met * wp.types.type_size_in_bytes(array.dtype))


@cache
def _read(kernel: Any) -> _Code:
    """Read a kernel's code, which Warp makes again where the compiled one came from its cache."""
    from warp._src.context import ModuleBuilder

    options = kernel.module.resolve_options(wp.config) | {"output_arch": None}
    builder = ModuleBuilder(kernel.module, options)
    functions = {function.native_func: function for function in builder.functions}
    alike = next(one for one in builder.kernels if one.hash == kernel.hash)  # Warp builds one of several
    return _read_adjoint(alike.adj, functions)


def _read_adjoint(adj: Any, functions: Mapping[str, Any]) -> _Code:
    reads, writes, flops, loops, walks = set[str](), set[str](), 0.0, False, False
    parameters = {argument.label for argument in adj.args}
    types = {str(variable.label): variable.type for variable in adj.variables}
    types |= {argument.label: argument.type for argument in adj.args}
    for line in _lines(adj):
        loops |= line.startswith(LOOPS)
        found = ASSIGNED.match(line)
        if not found:
            continue
        target, builtin, name, rest = found.groups()
        taken = NAME.findall(rest)
        if not builtin and name in functions:
            theirs = _read_function(functions[name], functions)
            theirs_by_ours = dict(zip((one.label for one in functions[name].adj.args), taken, strict=False))
            reads |= {theirs_by_ours[label] for label in theirs.reads if label in theirs_by_ours}
            writes |= {theirs_by_ours[label] for label in theirs.writes if label in theirs_by_ours}
            flops, walks = flops + theirs.flops, walks or theirs.walks
        elif builtin:
            first = taken[0] if taken else ""
            if first in parameters and (name in READS or name.startswith("atomic")):
                reads.add(first)
            if first in parameters and (name in WRITES or name.startswith("atomic")):
                writes.add(first)
            flops += _operations(name, types.get(target), [types.get(label) for label in taken])
    reads, writes = reads & parameters, writes & parameters
    return _Code(frozenset(reads), frozenset(writes), flops, walks or (loops and bool(reads | writes)))


def _read_function(function: Any, functions: Mapping[str, Any]) -> _Code:
    """Read a function that a kernel calls.

    One in C++ reads its arrays, and adds to them where it returns nothing, or sets them where its name says `write`.
    """
    if function.native_snippet is None:
        return _read_adjoint(function.adj, functions)
    arrays, none = frozenset(one.label for one in function.adj.args if wp.types.is_array(one.type)), frozenset[str]()
    reads = none if function.key.rpartition("__")[2].startswith("write") else arrays
    return _Code(reads, none if "return" in function.native_snippet else arrays, 0.0, walks=False)


def _lines(adj: Any) -> Iterator[str]:
    for block in adj.blocks:
        yield from (line.strip() for line in block.body_forward)


def _operations(name: str, result: Any, taken: Sequence[Any]) -> float:
    """Count the operations of one of Warp's functions: one for each number that comes out, but for sums of products."""
    if name in FREE or name.startswith("builtin"):
        return 0.0
    if name.startswith("atomic"):
        return float(_numbers(taken[-1] if taken else None))
    out = _numbers(result)
    first = _numbers(taken[0]) if taken else 1
    if name in {"dot", "ddot", "length_sq"}:
        return 2.0 * first - 1
    if name == "mul" and taken and _is_matrix(taken[0]) and len(taken) > 1 and _numbers(taken[1]) > 1:
        return out * (2.0 * _columns(taken[0]) - 1)
    if name == "cross":
        return 9.0
    if name == "determinant":
        return 14.0 if first == 9 else 3.0
    if name == "inverse":
        return 50.0 if first == 9 else 8.0
    return float(out)


def _plain(kind: Any) -> Any:
    return getattr(kind, "value_type", kind)  # of a reference, what it refers to


def _numbers(kind: Any) -> int:
    """How many floating-point numbers a value has; none of integers."""
    kind = _plain(kind)
    scalar = getattr(kind, "_wp_scalar_type_", kind)
    if scalar not in (wp.float16, wp.float32, wp.float64, float):
        return 0
    return int(math.prod(getattr(kind, "_shape_", (1,))))


def _is_matrix(kind: Any) -> bool:
    return len(getattr(_plain(kind), "_shape_", ())) == 2


def _columns(kind: Any) -> int:
    return int(_plain(kind)._shape_[1])
