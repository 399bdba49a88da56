"""Walls that reflect: fluid at such a wall meets its own image.

A particle closer to a wall than half a cell meets nodes beyond it, and a node next to the wall lacks what particles
beyond it would give. A wall that only stops its nodes pushes too little there: the pressure of a liquid at rest rises
by an eighth in the last cell before a wall, and drives a current of 16 mm/s through the tank of `fluid` (at `standard`),
which takes 8 % of its volume in 3 s to the floor's edges. So what nodes beyond a wall hold is added to their images
before it, and their velocity is the image of theirs (`native/mirrors.h`); then the liquid is still. Both are linear,
and each is the other's adjoint.
"""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from .. import cpp
from ..runtime import Ints, precision
from .columns import list_struct, node_taker
from .stencil import lattice


@cache
@no_type_check
def mirror_kernels(name: str) -> SimpleNamespace:
    """Return `fold, unfold` of one precision for a CPU."""
    nodes = precision(name).rows[2]
    given = {"lattice": lattice(name), "grid": nodes}
    declare = lambda function: cpp.kernel_in_rows(f"gradscape.mirrors.{name}", function, **given)  # noqa: E731
    return SimpleNamespace(fold=declare("fold"), unfold=declare("unfold"))


@cache
@no_type_check
def mirrors_of_columns(name: str) -> SimpleNamespace:
    """Return `unfold` of one precision for a GPU, over [environment, place in the grid]; sums are folded as added up."""
    Nodes, Lattice, Listed, take_node = precision(name).rows[2], lattice(name), list_struct(), node_taker()

    @cpp.func_native()
    def unfold_node(lattice: Lattice, starts: Ints, grid: Nodes, e: int, i: int, node: int): ...

    @wp.kernel(module=cpp.module(f"gradscape.mirrors.{name}.columns"), enable_backward=False, grid_stride=False)
    def unfold(lattice: Lattice, lists: Listed, grid: Nodes):
        e, i = wp.tid()
        node = take_node(lists, e, i)
        if node >= 0:
            unfold_node(lattice, lists.starts, grid, e, i, node)

    return SimpleNamespace(unfold=unfold)
