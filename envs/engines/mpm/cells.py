"""Which particles lie in which cells at a substep, so that a scatter can go from cell to cell.

Between control steps particles lie in memory by body and cell (`order`), but they move on in between. So each substep
lists its particles by cell, and those of a cell as they lie in memory. SEGMENT cells along z, from a multiple of
SEGMENT on, make a segment, whose particles come one after the other in the list. Where in the list they are, chance
may decide: nothing depends on it.

A team of threads walks along a segment, and leaves its planes of nodes one after the other; or several teams do, each
of which leaves a `stretch` of so many planes. These get their sums from the same particles in the same order, so that
no bit depends on it. Stretches cost more, since each begins with the particles of the two cells before it, but a lone
environment, which does not keep a GPU busy, need not wait for the longest segment. Walks are listed from those with
most particles to those with fewest, by steps of STEP, so that threads that work on neighbours in the list have as much
to do.

A particle whose place is not finite is listed nowhere. Were all such in one cell, each would be held against all.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from .. import cpp
from ..runtime import precision
from .model import Box
from .nodes import HIGHEST, node_placer, place_taker
from .stencil import lattice, stencil

SEGMENT = 16  # cells
STRETCH = 4  # planes of nodes that a walk of a small batch leaves, and the last along a segment up to two more
STEP, SIZES = 4, 32  # walks are of one size up to so many particles apart, and the largest of so many sizes


@dataclass(frozen=True, eq=False)
class Lists:
    """The particles by cell: `order` [environment, place], and the walks along its segments.

    There are `full` [environment] of them, and `walks` [environment, walk] says of each which segment it goes along,
    the first place of the particles it takes, how many they are, and, counted from the segment's first, which planes of
    nodes it leaves and where it begins: the lowest plane, 256 times the one beyond the highest, and 65536 times the
    cell. The planes that a segment's particles touch are the bits of `planes` [environment, segment].

    Nodes that particles touch have places in grids, one column after the other: `touched` [environment, 2] is how many
    nodes there are, and columns, `nodes` [environment, place] which node of the box has a place, and `starts`
    [environment, column] the place of the column's node 0, if it had one.
    """

    order: wp.array
    full: wp.array
    walks: wp.array
    planes: wp.array
    starts: wp.array
    nodes: wp.array
    touched: wp.array

    def arrays(self) -> tuple[wp.array, ...]:
        """Return every array of the lists."""
        return (self.order, self.full, self.walks, self.planes, self.starts, self.nodes, self.touched)


def whole_warps(threads: int) -> int:
    """Return the number of threads of the warps that so many threads need."""
    return -(-threads // 32) * 32


def warps(box: Box) -> int:
    """Return the number of threads, in whole warps, that a box's segments take one each."""
    return whole_warps(segments(box))


def placing_warps(particles: int, box: Box) -> int:
    """Return the number of threads, in whole warps, that so many particles take one each, and a box's columns."""
    return whole_warps(max(particles, box.columns))


def segments(box: Box) -> int:
    """Return the number of segments of a box of nodes."""
    first, count = box.first[2], box.nodes[2]
    return box.nodes[0] * box.nodes[1] * ((first + count - 1) // SEGMENT - first // SEGMENT + 1)


def most_walks(box: Box, stretch: int) -> int:
    """Return the number of walks, at most, where all but the last of a segment leave so many planes."""
    return segments(box) * -(-SEGMENT // stretch)


@cache
@no_type_check
def number_taker():
    """Return the function that counts one more at a place, and returns how many there were."""

    @cpp.func_native()
    def take_number(counts: wp.array2d[wp.int32], e: int, cell: int) -> int: ...

    return take_number


@cache
@no_type_check
def counter(name: str):
    """Return the function that tells a particle at x its cell, and its number there in the order of arrival."""
    vec3 = precision(name).vec3
    Lattice, base_node, take_number = lattice(name), stencil(name).base_node, number_taker()

    @wp.func(module=f"gradscape.cells.{name}")
    def count_in_cell(
        lattice: Lattice,
        x: vec3,
        e: int,
        p: int,
        cells: wp.array2d[wp.int32],
        numbers: wp.array2d[wp.int32],
        counts: wp.array2d[wp.int32],
    ):
        base = base_node((x - lattice.origin) * lattice.inv_dx, lattice)
        bottom = lattice.first[2] / SEGMENT
        depth = (lattice.first[2] + lattice.nz - 1) / SEGMENT - bottom + 1
        column = (base[0] - lattice.first[0]) * lattice.ny + base[1] - lattice.first[1]
        cell = (column * depth - bottom) * SEGMENT + base[2]
        if wp.isfinite(x):
            cells[e, p] = cell
            numbers[e, p] = take_number(counts, e, cell)
        else:
            cells[e, p] = -1

    return count_in_cell


@cache
@no_type_check
def cell_kernels(name: str) -> SimpleNamespace:
    """Return the kernels `count, place_segments, place, tidy` of one precision, which list in this order.

    Where g2p has counted particles, `count` need not.
    """
    vec3 = precision(name).vec3
    Lattice, count_in_cell, module = lattice(name), counter(name), cpp.module(f"gradscape.cells.{name}")
    take_number, take_places, place_nodes = number_taker(), place_taker(), node_placer(name)

    Counts = wp.types.vector(SEGMENT, wp.int32)

    @cpp.func_native(template=[SEGMENT])
    def take_counts(counts: wp.array2d[wp.int32], e: int, segment: int) -> Counts: ...

    @cpp.func_native(template=[SEGMENT])
    def write_places(places: wp.array2d[wp.vec2i], e: int, segment: int, at: int, counted: Counts): ...

    @cpp.func_native()
    def count_before(arrived: wp.array2d[wp.int32], e: int, places: wp.vec2i, p: int) -> int: ...

    @wp.func(module=module)
    def size_of(particles: int):
        return wp.min(particles / STEP, SIZES - 1)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def count(
        lattice: Lattice,
        x: wp.array2d[vec3],
        cells: wp.array2d[wp.int32],
        numbers: wp.array2d[wp.int32],
        counts: wp.array2d[wp.int32],
    ):
        """Tell each particle its cell, and its number there in the order of arrival."""
        e, p = wp.tid()
        count_in_cell(lattice, x[e, p], e, p, cells, numbers, counts)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def place_segments(
        lattice: Lattice,
        counts: wp.array2d[wp.int32],
        used: wp.array2d[wp.int32],
        sizes: wp.array2d[wp.int32],
        places: wp.array2d[wp.vec2i],
        found: wp.array2d[wp.vec4i],
        numbers: wp.array2d[wp.int32],
        planes: wp.array2d[wp.int32],
        spans: wp.array2d[wp.int32],
        touched: wp.array2d[wp.int32],
        stretch: int,
    ):
        """Give each segment its places in the list, each of its cells, too, and walks a number among those of a size.

        A cell's `places` are its first in the list and the one beyond its last. `spans` has of each column of cells by
        how much the lowest plane of nodes that is touched is below HIGHEST, counted from the box's first, and the one
        beyond the highest. `counts` are 0 again.
        """
        e, s = wp.tid()
        if s == 0:
            touched[e, 0] = 0
            touched[e, 1] = 0
        bottom = lattice.first[2] / SEGMENT
        depth = (lattice.first[2] + lattice.nz - 1) / SEGMENT - bottom + 1
        there = s < lattice.nx * lattice.ny * depth
        total, low, high = wp.int32(0), wp.int32(0), wp.int32(0)
        counted = Counts()
        if there:
            counted = take_counts(counts, e, s)
            for k in range(SEGMENT):
                if counted[k] > 0:
                    if total == 0:
                        low = k
                    high = k + 3
                total += counted[k]
            planes[e, s] = (1 << high) - (1 << low)
        walks = wp.where(total > 0, (high - low - 3) / stretch + 1, 0)
        taken = take_places(used, e, total, walks)
        if total > 0:
            at, column, first = taken[0], s / depth, s % depth * SEGMENT
            write_places(places, e, s, at, counted)
            for w in range(walks):
                lowest = low + w * stretch
                beyond = wp.where(w < walks - 1, lowest + stretch, high)
                begin = wp.max(low, lowest - 2)  # whose particles touch the lowest plane
                before, count = wp.int32(0), wp.int32(0)
                for k in range(SEGMENT):
                    before += wp.where(k < begin, counted[k], 0)
                    count += wp.where(k >= begin and k < beyond, counted[k], 0)
                place = at + wp.min(before, total - 1)  # one of the list, should there be no particles
                found[e, taken[1] + w] = wp.vec4i(s, place, count, lowest + 256 * beyond + 65536 * begin)
                numbers[e, taken[1] + w] = take_number(sizes, e, size_of(count))
            first -= lattice.first[2] % SEGMENT
            wp.atomic_max(spans, e, 2 * column, HIGHEST - first - low)
            wp.atomic_max(spans, e, 2 * column + 1, first + high)

    @wp.func(module=module)
    def place_walk(
        sizes: wp.array2d[wp.int32],
        found: wp.array2d[wp.vec4i],
        numbers: wp.array2d[wp.int32],
        walks: wp.array2d[wp.vec4i],
        e: int,
        i: int,
    ):
        walk = found[e, i]
        at = numbers[e, i]
        for larger in range(size_of(walk[2]) + 1, SIZES):
            at += sizes[e, larger]
        if at < walks.shape[1]:
            walks[e, at] = walk

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def place(
        lattice: Lattice,
        cells: wp.array2d[wp.int32],
        numbers: wp.array2d[wp.int32],
        places: wp.array2d[wp.vec2i],
        used: wp.array2d[wp.int32],
        sizes: wp.array2d[wp.int32],
        found: wp.array2d[wp.vec4i],
        numbers_of_walks: wp.array2d[wp.int32],
        arrived: wp.array2d[wp.int32],
        full: wp.array[wp.int32],
        walks: wp.array2d[wp.vec4i],
        spans: wp.array2d[wp.int32],
        touched: wp.array2d[wp.int32],
        starts: wp.array2d[wp.int32],
        nodes: wp.array2d[wp.int32],
    ):
        """List particles by cell, those of a cell as they arrived, and walks by size, the largest first.

        Give the nodes of each column that particles touch, and those between them, places one after the other. Where
        there is not room for all that are touched none of them counts, and the control step is done again.
        """
        e, i = wp.tid()
        if i - i % 32 < lattice.nx * lattice.ny:  # a whole warp, whose lanes take places together
            place_nodes(lattice, spans, touched, starts, nodes, e, i)
        if i == 0:
            full[e] = used[e, 1]
        if i < cells.shape[1]:
            cell = cells[e, i]
            if cell >= 0:
                arrived[e, places[e, cell][0] + numbers[e, i]] = i
            for w in range(i, used[e, 1], cells.shape[1]):
                place_walk(sizes, found, numbers_of_walks, walks, e, w)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def tidy(
        lattice: Lattice,
        cells: wp.array2d[wp.int32],
        places: wp.array2d[wp.vec2i],
        arrived: wp.array2d[wp.int32],
        used: wp.array2d[wp.int32],
        sizes: wp.array2d[wp.int32],
        spans: wp.array2d[wp.int32],
        order: wp.array2d[wp.int32],
        touched: wp.array2d[wp.int32],
        needed: wp.array[wp.int32],
    ):
        """List them by cell, those of a cell as they lie in memory; count walks from 0 again.

        Note how many nodes an environment has `needed` at most.
        """
        e, p = wp.tid()
        if p == 0:
            used[e, 0] = 0
            used[e, 1] = 0
            needed[e] = wp.max(needed[e], touched[e, 0])
        for i in range(p, SIZES, cells.shape[1]):
            sizes[e, i] = 0
        for i in range(p, 2 * lattice.nx * lattice.ny, cells.shape[1]):
            spans[e, i] = 0
        cell = cells[e, p]
        if cell >= 0:
            mine = places[e, cell]
            order[e, mine[0] + count_before(arrived, e, mine, p)] = p

    return SimpleNamespace(count=count, place_segments=place_segments, place=place, tidy=tidy)
