"""Which nodes particles touch, for a GPU: grids hold these, one column along z after the other, and no others.

A column has its nodes from the lowest to the highest that is touched, so that gathers look up where columns are.
"""

from functools import cache
from typing import no_type_check

import warp as wp

from .stencil import lattice

HIGHEST = 1 << 30  # beyond all planes of nodes

# The next `count` places of an environment, and the next `parts` of another kind: a warp's lanes take theirs together.
TAKE_PLACES = """
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    if (!__ballot_sync(all, count > 0)) return wp::vec_t<2, wp::int32>(0, 0);
    const int lane = threadIdx.x & 31;
    int before = count, more = parts;
    for (int step = 1; step < 32; step *= 2) {
        const int other = __shfl_up_sync(all, before, step), others = __shfl_up_sync(all, more, step);
        if (lane >= step) before += other, more += others;
    }
    int place = 0, part = 0;
    if (lane == 31) {
        place = atomicAdd(&wp::index(used, e, 0), before);
        part = atomicAdd(&wp::index(used, e, 1), more);
    }
    place = __shfl_sync(all, place, 31) + before - count;
    part = __shfl_sync(all, part, 31) + more - parts;
#else
    const int place = wp::index(used, e, 0), part = wp::index(used, e, 1);
    wp::index(used, e, 0) += count;
    wp::index(used, e, 1) += parts;
#endif
    return wp::vec_t<2, wp::int32>(place, part);
"""
# From which node of a column to which one, along z, particles of its nine columns of cells touch.
FIND_TOUCHED = """
    struct alignas(8) Two { int above, high; };
    const Two *span = (const Two *)&wp::index(spans, e, 0);
    const int x = column / lattice.ny, y = column % lattice.ny;
    int above = 0, high = 0;
    for (int c = 0; c < 9; ++c) {
        if (x >= lattice.nx || x < c / 3 || y < c % 3) continue;
        const Two found = span[(x - c / 3) * lattice.ny + y - c % 3];
        above = wp::max(above, found.above);
        high = wp::max(high, found.high);
    }
    return high ? wp::vec_t<2, wp::int32>(HIGHEST - above, high) : wp::vec_t<2, wp::int32>(0, 0);
"""
# Lanes of a warp have columns beside each other, whose nodes have places one after the other. They write all of these
# together, a place each, and find out to whose column it belongs.
NAME_NODES = """
    const int room = nodes.shape[1], first = column * depth + low;
    int *row = &wp::index(nodes, e, 0);
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31, begin = __shfl_sync(all, start, 0), end = __shfl_sync(all, start + count, 31);
    for (int from = begin; from < end; from += 32) {
        const int place = from + lane;
        int owner = 0;
        for (int step = 16; step > 0; step /= 2)
            if (__shfl_sync(all, start, owner + step) <= place) owner += step;
        const int node = __shfl_sync(all, first - start, owner) + place;
        if (place < wp::min(end, room)) row[place] = node;
    }
#else
    for (int place = start; place < wp::min(start + count, room); ++place) row[place] = first + place - start;
#endif
"""


@cache
@no_type_check
def place_taker():
    """Return the function that takes the next `count` places of an environment, and `parts` of another kind."""

    @wp.func_native(TAKE_PLACES)
    def take_places(used: wp.array2d[wp.int32], e: int, count: int, parts: int) -> wp.vec2i: ...

    return take_places


@cache
@no_type_check
def node_placer(name: str):
    """Return the function that gives the nodes of a column that are touched, and those between them, their places.

    A warp's lanes call it together, for columns beside each other.
    """
    Lattice, take_places = lattice(name), place_taker()

    @wp.func_native(FIND_TOUCHED.replace("HIGHEST", str(HIGHEST)))
    def find_touched(lattice: Lattice, spans: wp.array2d[wp.int32], e: int, column: int) -> wp.vec2i: ...

    @wp.func_native(NAME_NODES)
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
