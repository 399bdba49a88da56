"""How arrays lie in memory, and how they are read and written: wide reads on a GPU, Warp's own on a CPU.

A matrix of each particle lies as Warp has it on a CPU. On a GPU an environment's row holds the first numbers of all
matrices, then the second ones, and so on: threads beside each other then read what lies side by side, where the numbers
of a matrix would be read 36 bytes apart. `to_rows` brings a tensor of matrices into that order. The four numbers of a
node are read and written as one. `native/layout.h` does so.
"""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import torch
import warp as wp

from .. import cpp
from ..runtime import precision


@cache
@no_type_check
def layout(name: str) -> SimpleNamespace:
    """Return the functions `read_matrix, write_matrix, read_node, write_node, read_number, read_vector`."""
    types = precision(name)
    real, vec3, mat33, vec4 = types.real, types.vec3, types.mat33, types.vec4

    @cpp.func_native(adjoint="adj_read_element")
    def read_matrix(values: wp.array2d[mat33], e: int, p: int) -> mat33: ...

    @cpp.func_native(adjoint="adj_write_matrix")
    def write_matrix(values: wp.array2d[mat33], e: int, p: int, value: mat33): ...

    @cpp.func_native(adjoint="adj_read_element")
    def read_node(grid: wp.array2d[vec4], e: int, i: int) -> vec4: ...

    @cpp.func_native()
    def write_node(grid: wp.array2d[vec4], e: int, i: int, value: vec4): ...

    @cpp.func_native(called="read_element", adjoint="adj_read_element")
    def read_number(values: wp.array2d[real], e: int, i: int) -> real: ...

    @cpp.func_native(called="read_element", adjoint="adj_read_element")
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
