"""Walls that reflect: fluid at such a wall meets its own image.

A particle closer to a wall than half a cell meets nodes beyond it, and a node next to the wall lacks what particles
beyond it would give. A wall that only stops its nodes pushes too little there: the pressure of a liquid at rest rises
by an eighth in the last cell before a wall. In a tank 0.2 m wide, in cells of 12.5 mm, that drives a current of 16
mm/s, which takes 6 % of the syrup's volume in 3 s to the floor's edges. So what nodes beyond a wall hold is added to
their images before it, and their velocity is the image of theirs (`native/mirrors.h`); then the liquid is still. Both
are linear, and each is the other's adjoint. A wall lies on nodes or half-way between them.
"""

from functools import cache, partial
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from .. import cpp
from ..runtime import Ints, precision
from .columns import list_functions, list_struct
from .stencil import lattice


@cache
@no_type_check
def mirror_kernels(name: str) -> SimpleNamespace:
    """Return `fold, unfold` of one precision for a CPU."""
    nodes = precision(name).rows[2]
    given = {"lattice": lattice(name), "grid": nodes}
    declare = partial(cpp.kernel_in_rows, f"gradscape.mirrors.{name}")
    return SimpleNamespace(fold=declare("fold", **given), unfold=declare("unfold", **given))


@cache
@no_type_check
def mirrors_of_columns(name: str) -> SimpleNamespace:
    """Return `unfold` of one precision for a GPU, over [environment, place in the grid]; `add_up_folded` folds."""
    Nodes, Lattice, Lists = precision(name).rows[2], lattice(name), list_struct()
    take_node = list_functions().take_node

    @cpp.func_native()
    def unfold_node(lattice: Lattice, starts: Ints, grid: Nodes, e: int, i: int, node: int): ...

    @wp.kernel(module=cpp.module(f"gradscape.mirrors.{name}.columns"), enable_backward=False, grid_stride=False)
    def unfold(lattice: Lattice, lists: Lists, grid: Nodes):
        e, i = wp.tid()
        node = take_node(lists, e, i)
        if node >= 0:
            unfold_node(lattice, lists.starts, grid, e, i, node)

    return SimpleNamespace(unfold=unfold)
