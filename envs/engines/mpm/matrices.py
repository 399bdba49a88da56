"""Matrices of particles, read and written by a GPU's warp together.

Nine numbers of one particle lie one after the other. If each thread reads those of its own, a warp asks for 36 bytes
in 32 places nine times. Here it reads the 288 numbers of 32 particles that lie beside each other in nine rows of 32,
and shared memory turns them. No bit depends on it.
"""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ..runtime import BLOCK, precision

TOGETHER = """
    __shared__ REAL stage[WARPS][9 * 32];
    const unsigned there = __activemask();
    const int lane = threadIdx.x & 31;
    REAL *mine = (REAL *)&wp::index(values, e, p), *turned = stage[threadIdx.x >> 5] + 9 * lane;
    REAL *row = stage[threadIdx.x >> 5] + lane;
    REAL *first = (REAL *)__shfl_sync(there, (unsigned long long)mine, 0);
    const bool together = there == 0xffffffffu && __all_sync(there, mine == first + 9 * lane);
"""
READ = """
#if defined(__CUDA_ARCH__)
    TOGETHER
    if (together) {
        __syncwarp();
#pragma unroll
        for (int i = 0; i < 9; ++i) row[32 * i] = first[32 * i + lane];
        __syncwarp();
        wp::mat_t<3, 3, REAL> value;
#pragma unroll
        for (int i = 0; i < 9; ++i) value.data[i / 3][i % 3] = turned[i];
        return value;
    }
#endif
    return wp::index(values, e, p);
"""
WRITE = """
#if defined(__CUDA_ARCH__)
    TOGETHER
    if (together) {
        __syncwarp();
#pragma unroll
        for (int i = 0; i < 9; ++i) turned[i] = value.data[i / 3][i % 3];
        __syncwarp();
#pragma unroll
        for (int i = 0; i < 9; ++i) first[32 * i + lane] = row[32 * i];
        return;
    }
#endif
    wp::index(values, e, p) = value;
"""


@cache
@no_type_check
def matrices(name: str) -> SimpleNamespace:
    """Return the functions `read, write` of one precision, for kernels of BLOCK threads.

    What is read has no adjoint by Warp.
    """
    mat33 = precision(name).mat33

    def fill(code: str) -> str:
        for word, value in {"TOGETHER": TOGETHER, "WARPS": str(BLOCK // 32), "REAL": f"wp::{name}"}.items():
            code = code.replace(word, value)
        return code

    @wp.func_native(fill(READ))
    def read(values: wp.array2d[mat33], e: int, p: int) -> mat33: ...

    @wp.func_native(fill(WRITE), adj_snippet="adj_value += wp::index(adj_values, e, p);")
    def write(values: wp.array2d[mat33], e: int, p: int, value: mat33): ...

    return SimpleNamespace(read=read, write=write)
