"""Which nodes particles touch, for a GPU: grids hold these, one column along z after the other, and no others.

A column has its nodes from the lowest to the highest that is touched, so that gathers look up where columns are.
"""

from functools import cache
from typing import no_type_check

import warp as wp

from .. import cpp
from .stencil import lattice

HIGHEST = 1 << 30  # beyond all planes of nodes


@cache
@no_type_check
def place_taker():
    """Return the function that takes the next `count` places of an environment, and `parts` of another kind."""

    @cpp.func_native()
    def take_places(used: wp.array2d[wp.int32], e: int, count: int, parts: int) -> wp.vec2i: ...

    return take_places


@cache
@no_type_check
def node_placer(name: str):
    """Return the function that gives the nodes of a column that are touched, and those between them, their places.

    A warp's lanes call it together, for columns beside each other.
    """
    Lattice, take_places = lattice(name), place_taker()

    @cpp.func_native(template=[HIGHEST])
    def find_touched(lattice: Lattice, spans: wp.array2d[wp.int32], e: int, column: int) -> wp.vec2i: ...

    @cpp.func_native()
    def name_nodes(nodes: wp.array2d[wp.int32], e: int, column: int, depth: int, low: int, count: int, start: int): ...

    @wp.func(module=f"gradscape.cells.{name}")
    def place_nodes(
        lattice: Lattice,
        spans: wp.array2d[wp.int32],
        touched: wp.array2d[wp.int32],
        starts: wp.array2d[wp.int32],
        nodes: wp.array2d[wp.int32],
        e: int,
        column: int,
    ):
        found = find_touched(lattice, spans, e, column)
        low, count = found[0], found[1] - found[0]
        start = take_places(touched, e, count, wp.min(count, 1))[0]
        if column < lattice.nx * lattice.ny:
            starts[e, column] = start - low
        name_nodes(nodes, e, column, lattice.nz, low, count, start)

    return place_nodes


@cache
@no_type_check
def node_taker():
    """Return the function that says which node has a place in the grid, -1 if none has."""

    @wp.func(module="gradscape.columns.nodes")
    def take_node(touched: wp.array2d[wp.int32], nodes: wp.array2d[wp.int32], e: int, place: int):
        node, count = nodes[e, place], touched[e, 0]  # the one does not wait for the other
        return wp.where(place < count and count <= nodes.shape[1], node, -1)

    return take_node
