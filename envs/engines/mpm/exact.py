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

from ..runtime import precision

LANES = 8  # copies of the sums, so that fewer nodes wait for each other to add to the same one
BITS = 16
SUMS = {"float32": 17, "float64": 132}  # ranges that hold all exponents, and the last: how many are no numbers

ADD = {
    "float32": """
        const unsigned bits = __float_as_uint(value), exponent = bits >> 23 & 255u;
        const long long mantissa = (bits & 0x7fffffu) | (exponent ? 0x800000u : 0u);
        const int shift = exponent ? exponent - 1 : 0;
        const int last = exponent == 255u;
        const long long part = last ? 1 : mantissa << (shift & 15);
        atomicAdd(sums + (last ? SUMS - 1 : shift >> 4), (unsigned long long)(bits >> 31 && !last ? -part : part));
    """,
    "float64": """
        const unsigned long long bits = __double_as_longlong(value), exponent = bits >> 52 & 2047u;
        const unsigned long long mantissa = (bits & 0xfffffffffffffull) | (exponent ? 0x10000000000000ull : 0ull);
        if (exponent == 2047u) {
            atomicAdd(sums + SUMS - 1, 1ull);
            continue;
        }
        for (int third = 0; third < 3; ++third) {
            const int shift = (exponent ? (int)exponent - 1 : 0) + 18 * third;
            const long long part = (long long)(mantissa >> 18 * third & 0x3ffffull) << (shift & 15);
            if (part) atomicAdd(sums + (shift >> 4), (unsigned long long)(bits >> 63 ? -part : part));
        }
    """,
}
READ = "return wp::index(tools, e, step + after, slot);"
ADJOINT_READ = """
#if defined(__CUDA_ARCH__)
    unsigned long long *all = (unsigned long long *)&wp::index(sums, e * LANES + lane, 0);
    for (int axis = 0; axis < 3; ++axis) {
        const REAL value = adj_ret[axis];
        if (value == REAL(0.0)) continue;
        unsigned long long *sums = all + ((after * tools.shape[2] + slot) * 3 + axis) * SUMS;
        ADD
    }
#else
    wp::adj_atomic_add(&wp::index(adj_tools, e, step + after, slot), adj_ret);
#endif
"""
TAKE = """
    long long *first = (long long *)&wp::index(sums, e * LANES, at), total = 0;
    const int across = sums.shape[1];
#pragma unroll
    for (int lane = 0; lane < LANES; ++lane) total += first[lane * across];
#pragma unroll
    for (int lane = 0; lane < LANES; ++lane) first[lane * across] = 0;
    return total;
"""
WEIGH = "return ldexp((double)sum, BITS * range - LOWEST);"
LOWEST = {"float32": 149, "float64": 1074}  # 2^-LOWEST is the least number


@cache
@no_type_check
def tool_readers(name: str) -> SimpleNamespace:
    """Return the functions `read, look` of one precision: where a tool is, and the same without an adjoint.

    read(tools, sums, e, lane, step, after, slot) is tools[e, step + after, slot]. On a GPU its adjoint goes to the
    integers `sums` of the environment's `lane`, after being 0 or 1; `settle` takes it from there.
    """
    vec3 = precision(name).vec3
    words = {"ADD": ADD[name], "SUMS": str(SUMS[name]), "REAL": f"wp::{name}", "LANES": str(LANES)}
    adjoint = ADJOINT_READ
    for word, value in words.items():
        adjoint = adjoint.replace(word, value)

    @wp.func_native(READ, adj_snippet=adjoint)
    def read(
        tools: wp.array3d[vec3], sums: wp.array2d[wp.int64], e: int, lane: int, step: int, after: int, slot: int
    ) -> vec3: ...

    @wp.func_native(READ, adj_snippet="")
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

    @wp.func_native(WEIGH.replace("BITS", str(BITS)).replace("LOWEST", str(LOWEST[name])))
    def weigh(sum: wp.int64, range: int) -> wp.float64: ...

    @wp.func_native(TAKE.replace("LANES", str(LANES)))
    def take_sum(sums: wp.array2d[wp.int64], e: int, at: int) -> wp.int64: ...

    @wp.func_native("return NAN;")
    def no_number() -> wp.float64: ...

    @wp.kernel(module=f"gradscape.exact.{name}", enable_backward=False)
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
