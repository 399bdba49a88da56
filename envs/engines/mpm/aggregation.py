"""How particles add to grid nodes.

Atomic adds are most of what a scatter costs on a GPU. So the lanes of a warp (32 threads) whose particles lie in the
same cell add up what they have for a node, and one of them adds that to the grid, all four numbers by one instruction
(Hopper or later; PTX 8.1). Sorted particles then need a fifth of the atomic adds.
"""

from typing import Any, no_type_check

import warp as wp

from ..runtime import precision

FIND_RUN = """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    const unsigned lanes = __activemask();
    const int lane = threadIdx.x & 31;
    const int next_e = __shfl_down_sync(lanes, e, 1);
    const int next_i = __shfl_down_sync(lanes, i, 1);
    const bool last = lane == 31 || !(lanes >> (lane + 1) & 1u) || next_e != e || next_i != i;
    const unsigned lasts = __ballot_sync(lanes, last);
    const int behind = __ffs(lasts >> lane) - 1;
    const bool first = lane == 0 || !(lanes >> (lane - 1) & 1u) || (lasts >> (lane - 1) & 1u);
    return wp::vec_t<4, wp::int32>(behind, first, __reduce_max_sync(lanes, behind), (int)lanes);
#else
    return wp::vec_t<4, wp::int32>();
#endif
"""
ADD_RUN = """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    for (int step = 1; step <= run[2]; step *= 2) {
        #pragma unroll
        for (int k = 0; k < 4; ++k)
            if (k < parts) {
                const float other = __shfl_down_sync((unsigned)run[3], value[k], step);
                if (step <= run[0]) value[k] += other;
            }
    }
    if (run[1])
        asm volatile("red.global.add.v4.f32 [%0], {%1, %2, %3, %4};" ::
            "l"(__cvta_generic_to_global(&wp::index(grid, e, i))),
            "f"(value[0]), "f"(value[1]), "f"(value[2]), "f"(value[3]) : "memory");
#else
    wp::atomic_add(grid, e, i, value);
#endif
"""


@no_type_check
def aggregation(name: str, module: str, *, native: bool) -> tuple[Any, Any]:
    """Return the functions (find_run, add) that scatters call, with instructions of a GPU's own if `native`.

    find_run(e, i) tells a lane about its run, the lanes with the same environment e and node i: how many follow, if it
    is the first, the most that follow any, which lanes are there. add(grid, e, i, value, run, parts) adds the first
    `parts` numbers of `value` to node i; the others are zero. All lanes must come by, each with the same offset from
    the node that `find_run` was told.
    """
    vec4 = precision(name).vec4

    def find_run(e: int, i: int) -> wp.vec4i:
        return wp.vec4i()

    def add(grid: wp.array2d[vec4], e: int, i: int, value: vec4, run: wp.vec4i, parts: int):
        wp.atomic_add(grid, e, i, value)

    if native:
        return wp.func_native(FIND_RUN)(find_run), wp.func_native(ADD_RUN)(add)
    return wp.func(find_run, module=module), wp.func(add, module=module)
