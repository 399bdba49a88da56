"""Sums that come out the same whatever their order, because they are exact: the adjoints of tools on a GPU.

Many nodes add to the adjoint of one tool, in an order that chance decides, and sums of floating-point numbers depend on
theirs. Sums of integers do not. So each number is added as an integer, its mantissa, to one of many sums that stand for
ranges of exponents, BITS of them each (a Kulisch accumulator: Kulisch 2002, Advanced arithmetic for the digital
computer). What they come to is rounded once. 2^24 numbers in single precision, 2^30 in double, fit into such a sum.

On a CPU, whose sums have one order, numbers are added to the adjoint itself.
"""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from .. import cpp
from ..runtime import precision

LANES = 8  # copies of the sums, so that fewer nodes wait for each other to add to the same one
BITS = 16
SUMS = {"float32": 17, "float64": 132}  # ranges that hold all exponents, and the last: how many are no numbers

LOWEST = {"float32": 149, "float64": 1074}  # 2^-LOWEST is the least number


@cache
@no_type_check
def tool_readers(name: str) -> SimpleNamespace:
    """Return the functions `read, look` of one precision: where a tool is, and the same without an adjoint.

    read(tools, sums, e, lane, step, after, slot) is tools[e, step + after, slot]. On a GPU its adjoint goes to the
    integers `sums` of the environment's `lane`, after being 0 or 1; `settle` takes it from there.
    """
    vec3 = precision(name).vec3

    @cpp.func_native(called="read_tool", template=[LANES, SUMS[name]], adjoint="adj_read_tool")
    def read(
        tools: wp.array3d[vec3], sums: wp.array2d[wp.int64], e: int, lane: int, step: int, after: int, slot: int
    ) -> vec3: ...

    @cpp.func_native(called="look_at_tool", adjoint="")
    def look(tools: wp.array3d[vec3], e: int, step: int, after: int, slot: int) -> vec3: ...

    return SimpleNamespace(read=read, look=look)


@cache
@no_type_check
def settle_kernel(name: str):
    """Return the kernel that takes the sums of a control step to the adjoint of tools, and clears them.

    It runs over [environment, axis of a slot at the step's start or end].
    """
    types, count = precision(name), SUMS[name]
    real = types.real

    @cpp.func_native(called="weigh_sum", template=[BITS, LOWEST[name]])
    def weigh(sum: wp.int64, range: int) -> wp.float64: ...

    @cpp.func_native(template=[LANES])
    def take_sum(sums: wp.array2d[wp.int64], e: int, at: int) -> wp.int64: ...

    @cpp.func_native()
    def no_number() -> wp.float64: ...

    @wp.kernel(module=cpp.module(f"gradscape.exact.{name}"), enable_backward=False)
    def settle(step: int, sums: wp.array2d[wp.int64], adj_tools: wp.array4d[real]):
        e, place = wp.tid()
        value = wp.float64(0.0)
        for i in range(count):
            total = take_sum(sums, e, place * count + count - 1 - i)
            if i == 0 and total > wp.int64(0):
                value = no_number()
            elif i > 0:
                value += weigh(total, count - 1 - i)
        slots = adj_tools.shape[2]
        at_step, slot, axis = step + place / (3 * slots), place / 3 % slots, place % 3
        adj_tools[e, at_step, slot, axis] = adj_tools[e, at_step, slot, axis] + real(value)

    return settle
