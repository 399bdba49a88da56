"""How arrays lie in memory, and how they are read and written: wide reads on a GPU, Warp's own on a CPU.

A matrix of each particle lies as Warp has it on a CPU. On a GPU an environment's row holds the first numbers of all
matrices, then the second ones, and so on: threads beside each other then read what lies side by side, where the numbers
of a matrix would be read 36 bytes apart. `to_rows` brings a tensor of matrices into that order. The four numbers of a
node are read and written as one. A number is read without Warp's look at every index whether it counts from the end.
"""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import torch
import warp as wp

from ..runtime import precision

READ_MATRIX = """
#if defined(__CUDA_ARCH__)
    const REAL *row = (const REAL *)&wp::index(values, e, 0) + p;
    const int count = values.shape[1];
    return wp::mat_t<3, 3, REAL>(
        row[0], row[count], row[2 * count], row[3 * count], row[4 * count], row[5 * count], row[6 * count],
        row[7 * count], row[8 * count]);
#else
    return wp::index(values, e, p);
#endif
"""
WRITE_MATRIX = """
#if defined(__CUDA_ARCH__)
    REAL *row = (REAL *)&wp::index(values, e, 0) + p;
    const int count = values.shape[1];
    for (int number = 0; number < 9; ++number) row[number * count] = value.data[number / 3][number % 3];
#else
    wp::index(values, e, p) = value;
#endif
"""
FOUR = "struct alignas(16) Four { REAL a, b, c, d; };"
READ_NODE = """
#if defined(__CUDA_ARCH__)
    FOUR
    const Four four = ((const Four *)&wp::index(grid, e, 0))[i];
    return wp::vec_t<4, REAL>(four.a, four.b, four.c, four.d);
#else
    return wp::index(grid, e, i);
#endif
"""
WRITE_NODE = """
#if defined(__CUDA_ARCH__)
    FOUR
    ((Four *)&wp::index(grid, e, 0))[i] = Four{value[0], value[1], value[2], value[3]};
#else
    wp::index(grid, e, i) = value;
#endif
"""
READ_ELEMENT = "return (&wp::index(values, e, 0))[i];"

# Warp's own adjoints of these, for a CPU, where tests hold those by hand against them.
ADD_MATRIX = "if (adj_values.data) wp::index(adj_values, e, p) += adj_ret;"
ADD_NODE = "if (adj_grid.data) wp::index(adj_grid, e, i) += adj_ret;"
ADD_NUMBER = "if (adj_values.data) wp::index(adj_values, e, i) += adj_ret;"
TAKE_MATRIX = "if (adj_values.data) adj_value += wp::index(adj_values, e, p);"


def in_precision(code: str, name: str) -> str:
    """Put a precision's numbers into C++."""
    return code.replace("FOUR", FOUR).replace("REAL", f"wp::{name}")


@cache
@no_type_check
def layout(name: str) -> SimpleNamespace:
    """Return the functions `read_matrix, write_matrix, read_node, write_node, read_number, read_vector`."""
    types = precision(name)
    real, vec3, mat33, vec4 = types.real, types.vec3, types.mat33, types.vec4

    @wp.func_native(in_precision(READ_MATRIX, name), adj_snippet=ADD_MATRIX)
    def read_matrix(values: wp.array2d[mat33], e: int, p: int) -> mat33: ...

    @wp.func_native(in_precision(WRITE_MATRIX, name), adj_snippet=TAKE_MATRIX)
    def write_matrix(values: wp.array2d[mat33], e: int, p: int, value: mat33): ...

    @wp.func_native(in_precision(READ_NODE, name), adj_snippet=ADD_NODE)
    def read_node(grid: wp.array2d[vec4], e: int, i: int) -> vec4: ...

    @wp.func_native(in_precision(WRITE_NODE, name))
    def write_node(grid: wp.array2d[vec4], e: int, i: int, value: vec4): ...

    @wp.func_native(READ_ELEMENT, adj_snippet=ADD_NUMBER)
    def read_number(values: wp.array2d[real], e: int, i: int) -> real: ...

    @wp.func_native(READ_ELEMENT, adj_snippet=ADD_NUMBER)
    def read_vector(values: wp.array2d[vec3], e: int, i: int) -> vec3: ...

    return SimpleNamespace(
        read_number=read_number,
        read_vector=read_vector,
        read_matrix=read_matrix,
        write_matrix=write_matrix,
        read_node=read_node,
        write_node=write_node,
    )


def to_rows(values: torch.Tensor, device: str) -> torch.Tensor:
    """Return what is to be copied into an array [environment, particle], whose rows are all `values`: (particle, *)."""
    if device == "cpu" or values.ndim == 1:
        return values
    return values.flatten(1).T.contiguous().view(values.shape)
