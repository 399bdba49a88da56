"""Scatters without atomic adds, for a GPU: threads walk columns of cells, and nodes add up what columns give them.

Particles are listed by cell (`cells`). Nine lanes of a warp walk along a segment (`walk`), which leaves planes of nine
numbers of four parts, and each node then adds up those of the nine columns that it is part of. Every sum has one
order, which depends on nothing but an environment's own particles: neither on its place in a batch, nor on the box of
nodes, nor on chance.
"""

from dataclasses import dataclass
from functools import cache, partial
from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from .. import cpp
from ..launches import BLOCK, blocks
from ..runtime import Ints, precision
from .model import Box
from .stencil import lattice, layout, particles, stencil

# ---- Arrays of integers that kernels share, as Warp structs.


@cache
@no_type_check
def list_struct() -> Any:
    """Return the struct `Lists`."""

    @partial(wp.struct, module="gradscape.lists")
    class Lists:
        """The particles by cell: `order` [environment, place], and the walks along its segments.

        There are `full` [environment] of them, and `walks` [environment, walk] says of each which segment it goes
        along, the first place of the particles it takes, how many they are, and, counted from the segment's first,
        which planes of nodes it leaves and where it begins: the lowest plane, 256 times the one beyond the highest, and
        65536 times the cell. The planes that a segment's particles touch are the bits of `planes` [environment,
        segment].

        Nodes that particles touch have places in grids, one column after the other: `touched` [environment, 2] is how
        many nodes there are, and columns, `nodes` [environment, place] which node of the box has a place, and `starts`
        [environment, column] the place of the column's node 0, if it had one.
        """

        order: Ints
        full: wp.array[wp.int32]
        walks: wp.array2d[wp.vec4i]
        planes: Ints
        starts: Ints
        nodes: Ints
        touched: Ints

    return Lists


def arrays_of(lists: Any) -> list[wp.array]:
    """Return every array of `Lists`."""
    return [getattr(lists, field) for field in list_struct().vars]


@cache
@no_type_check
def count_struct() -> Any:
    """Return the struct of what kernels write down on the way to `Lists`."""

    @partial(wp.struct, module="gradscape.lists")
    class Counting:
        """What is known of each particle, cell, walk and column, by environment.

        Of a particle its cell, its number there in the order of arrival, and who arrived at which place. Of a cell how
        many there are, the first of its places in the list and the one beyond its last. Of a walk what `Lists` says,
        how many are of a size, and its number among those. `used` is how many places of the list are taken, and how
        many walks there are. `spans` has of each column of cells by how much the lowest plane of nodes that is touched
        is below HIGHEST, counted from the box's first, and the one beyond the highest.
        """

        cells: Ints
        numbers: Ints
        arrived: Ints
        counts: Ints
        places: wp.array2d[wp.vec2i]
        found: wp.array2d[wp.vec4i]
        sizes: Ints
        ranks: Ints
        used: Ints
        spans: Ints

    return Counting


# ---- Which nodes particles touch, for a GPU: grids hold these, one column along z after the other, and no others.
#
# A column has its nodes from the lowest to the highest that is touched, so that gathers look up where columns are.

HIGHEST = 1 << 30  # beyond all planes of nodes


@cache
@no_type_check
def list_functions() -> SimpleNamespace:
    """Return the functions `take_places, take_number, take_node, group_of, row_of`.

    The first takes the next `count` places of an environment, and `parts` of another kind; the second counts one more
    at a place, and returns how many there were; the third says which node has a place in the grid, -1 if none has. A
    lane of a warp has a group, its segment, of which there is none from three on, and a row of nodes.
    """
    Lists = list_struct()

    @cpp.func_native()
    def take_places(used: Ints, e: int, count: int, parts: int) -> wp.vec2i: ...

    @cpp.func_native()
    def take_number(counts: Ints, e: int, cell: int) -> int: ...

    @cpp.func_native(called="group_of_lane")
    def group_of(lane: int) -> int: ...

    @cpp.func_native(called="row_of_lane")
    def row_of(lane: int) -> int: ...

    @wp.func(module="gradscape.columns.nodes")
    def take_node(lists: Lists, e: int, place: int):
        node, count = lists.nodes[e, place], lists.touched[e, 0]  # the one does not wait for the other
        return wp.where(place < count and count <= lists.nodes.shape[1], node, -1)

    return SimpleNamespace(
        take_places=take_places, take_number=take_number, take_node=take_node, group_of=group_of, row_of=row_of
    )


# ---- Which particles lie in which cells at a substep, so that a scatter can go from cell to cell.
#
# Between control steps particles lie in memory by body and cell (`order`), but they move on in between. So each substep
# lists its particles by cell, and those of a cell as they lie in memory. SEGMENT cells along z, from a multiple of
# SEGMENT on, make a segment, whose particles come one after the other in the list. Where in the list they are, chance
# may decide: nothing depends on it.
#
# A team of threads walks along a segment, and leaves its planes of nodes one after the other; or several teams do, each
# of which leaves a `stretch` of so many planes. These get their sums from the same particles in the same order, so that
# no bit depends on it. Stretches cost more, since each begins with the particles of the two cells before it, but a lone
# environment, which does not keep a GPU busy, need not wait for the longest segment. Walks are listed from those with
# most particles to those with fewest, by steps of STEP, so that threads that work on neighbours in the list have as
# much to do.
#
# A particle whose place is not finite is listed nowhere. Were all such in one cell, each would be held against all.

SEGMENT = 16  # cells
STRETCH = 4  # planes of nodes that a walk of a small batch leaves, and the last along a segment up to two more
STEP, SIZES = 4, 32  # walks are of one size up to so many particles apart, and the largest of so many sizes


def whole_warps(threads: int) -> int:
    """Return the number of threads of the warps that so many threads need."""
    return -(-threads // 32) * 32


def segments(box: Box) -> int:
    """Return the number of segments of a box of nodes."""
    first, count = box.first[2], box.nodes[2]
    return box.nodes[0] * box.nodes[1] * ((first + count - 1) // SEGMENT - first // SEGMENT + 1)


def most_walks(box: Box, stretch: int) -> int:
    """Return the number of walks, at most, where all but the last of a segment leave so many planes."""
    return segments(box) * -(-SEGMENT // stretch)


@cache
@no_type_check
def counter(name: str):
    """Return the function that tells a particle at x its cell, and its number there in the order of arrival."""
    vec3, Counting = precision(name).vec3, count_struct()
    Lattice, base_node, take_number = lattice(name), stencil(name).base_node, list_functions().take_number

    @wp.func(module=f"gradscape.cells.{name}")
    def count_in_cell(lattice: Lattice, x: vec3, e: int, p: int, found: Counting):
        base = base_node((x - lattice.origin) * lattice.inv_dx, lattice)
        bottom = lattice.first[2] / SEGMENT
        depth = (lattice.first[2] + lattice.nz - 1) / SEGMENT - bottom + 1
        column = (base[0] - lattice.first[0]) * lattice.ny + base[1] - lattice.first[1]
        cell = (column * depth - bottom) * SEGMENT + base[2]
        if wp.isfinite(x):
            found.cells[e, p] = cell
            found.numbers[e, p] = take_number(found.counts, e, cell)
        else:
            found.cells[e, p] = -1

    return count_in_cell


@cache
@no_type_check
def cell_kernels(name: str) -> SimpleNamespace:
    """Return the kernels `count, place_segments, place, tidy` of one precision, which list in this order.

    Where g2p has counted particles, `count` need not.
    """
    Vectors, Lattice, Counting, Lists = precision(name).rows[1], lattice(name), count_struct(), list_struct()
    count_in_cell, module = counter(name), cpp.module(f"gradscape.cells.{name}")
    take_number, take_places = list_functions().take_number, list_functions().take_places
    Counts = wp.types.vector(SEGMENT, wp.int32)

    @cpp.func_native(template=[SEGMENT])
    def take_counts(counts: Ints, e: int, segment: int) -> Counts: ...

    @cpp.func_native(template=[SEGMENT])
    def write_places(places: wp.array2d[wp.vec2i], e: int, segment: int, at: int, counted: Counts): ...

    @cpp.func_native()
    def count_before(arrived: Ints, e: int, places: wp.vec2i, p: int) -> int: ...

    @cpp.func_native(template=[HIGHEST])
    def find_touched(lattice: Lattice, spans: Ints, e: int, column: int) -> wp.vec2i: ...

    @cpp.func_native()
    def name_nodes(nodes: Ints, e: int, column: int, depth: int, low: int, count: int, start: int): ...

    @wp.func(module=module)
    def place_nodes(lattice: Lattice, spans: Ints, lists: Lists, e: int, column: int):
        """Give nodes of a column that are touched, and those between them, places; a warp calls it together."""
        found = find_touched(lattice, spans, e, column)
        low, count = found[0], found[1] - found[0]
        start = take_places(lists.touched, e, count, wp.min(count, 1))[0]
        if column < lattice.nx * lattice.ny:
            lists.starts[e, column] = start - low
        name_nodes(lists.nodes, e, column, lattice.nz, low, count, start)

    @wp.func(module=module)
    def size_of(particles: int):
        return wp.min(particles / STEP, SIZES - 1)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def count(lattice: Lattice, x: Vectors, counts: Counting):
        """Tell each particle its cell, and its number there in the order of arrival."""
        e, p = wp.tid()
        count_in_cell(lattice, x[e, p], e, p, counts)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def place_segments(lattice: Lattice, counts: Counting, lists: Lists, stretch: int):
        """Give each segment its places in the list, each of its cells, too, and walks a number among those of a size.

        Counts are 0 again.
        """
        e, s = wp.tid()
        if s == 0:
            lists.touched[e, 0] = 0
            lists.touched[e, 1] = 0
        bottom = lattice.first[2] / SEGMENT
        depth = (lattice.first[2] + lattice.nz - 1) / SEGMENT - bottom + 1
        there = s < lattice.nx * lattice.ny * depth
        total, low, high = wp.int32(0), wp.int32(0), wp.int32(0)
        counted = Counts()
        if there:
            counted = take_counts(counts.counts, e, s)
            for k in range(SEGMENT):
                if counted[k] > 0:
                    if total == 0:
                        low = k
                    high = k + 3
                total += counted[k]
            lists.planes[e, s] = (1 << high) - (1 << low)
        walks = wp.where(total > 0, (high - low - 3) / stretch + 1, 0)
        taken = take_places(counts.used, e, total, walks)
        if total > 0:
            at, column, first = taken[0], s / depth, s % depth * SEGMENT
            write_places(counts.places, e, s, at, counted)
            for w in range(walks):
                lowest = low + w * stretch
                beyond = wp.where(w < walks - 1, lowest + stretch, high)
                begin = wp.max(low, lowest - 2)  # whose particles touch the lowest plane
                before, count = wp.int32(0), wp.int32(0)
                for k in range(SEGMENT):
                    before += wp.where(k < begin, counted[k], 0)
                    count += wp.where(k >= begin and k < beyond, counted[k], 0)
                place = at + wp.min(before, total - 1)  # one of the list, should there be no particles
                counts.found[e, taken[1] + w] = wp.vec4i(s, place, count, lowest + 256 * beyond + 65536 * begin)
                counts.ranks[e, taken[1] + w] = take_number(counts.sizes, e, size_of(count))
            first -= lattice.first[2] % SEGMENT
            wp.atomic_max(counts.spans, e, 2 * column, HIGHEST - first - low)
            wp.atomic_max(counts.spans, e, 2 * column + 1, first + high)

    @wp.func(module=module)
    def place_walk(counts: Counting, lists: Lists, e: int, i: int):
        walk = counts.found[e, i]
        at = counts.ranks[e, i]
        for larger in range(size_of(walk[2]) + 1, SIZES):
            at += counts.sizes[e, larger]
        if at < lists.walks.shape[1]:
            lists.walks[e, at] = walk

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def place(lattice: Lattice, counts: Counting, lists: Lists):
        """List particles by cell, those of a cell as they arrived, and walks by size, the largest first.

        Give the nodes of each column that particles touch, and those between them, places one after the other. Where
        there is not room for all that are touched none of them counts, and the control step is done again.
        """
        e, i = wp.tid()
        if i - i % 32 < lattice.nx * lattice.ny:  # a whole warp, whose lanes take places together
            place_nodes(lattice, counts.spans, lists, e, i)
        if i == 0:
            lists.full[e] = counts.used[e, 1]
        particles = counts.cells.shape[1]
        if i < particles:
            cell = counts.cells[e, i]
            if cell >= 0:
                counts.arrived[e, counts.places[e, cell][0] + counts.numbers[e, i]] = i
            for w in range(i, counts.used[e, 1], particles):
                place_walk(counts, lists, e, w)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def tidy(lattice: Lattice, counts: Counting, lists: Lists, needed: wp.array[wp.int32]):
        """List them by cell, those of a cell as they lie in memory; count walks from 0 again.

        Note how many nodes an environment has `needed` at most.
        """
        e, p = wp.tid()
        particles = counts.cells.shape[1]
        if p == 0:
            counts.used[e, 0] = 0
            counts.used[e, 1] = 0
            needed[e] = wp.max(needed[e], lists.touched[e, 0])
        for i in range(p, SIZES, particles):
            counts.sizes[e, i] = 0
        for i in range(p, 2 * lattice.nx * lattice.ny, particles):
            counts.spans[e, i] = 0
        cell = counts.cells[e, p]
        if cell >= 0:
            mine = counts.places[e, cell]
            lists.order[e, mine[0] + count_before(counts.arrived, e, mine, p)] = p

    return SimpleNamespace(count=count, place_segments=place_segments, place=place, tidy=tidy)


# ---- How a warp of a GPU walks along the cells of its segments, and adds up what their particles give to nodes.
#
# Nine lanes take the particles of a segment one after the other. Each holds the sums of three of the 27 nodes around
# the present cell, a row along z. Where the next cell begins, the lowest nine are written down, side by side,
# since a cache takes whole sectors much faster than parts of them, and the others become lower by one. Planes below
# those of a stretch, which another walk leaves, are not written.
#
# A lane works out what one particle gives to all nine rows, and puts it into memory that the warp shares, where each
# lane reads what concerns its own row, since reading there is what limits a scatter. No more than nine particles of a
# segment are there at once: the cache has what shared memory leaves of the same storage.

PLANES = SEGMENT + 2  # of nodes that the cells of a segment touch
PARTS = 9 * PLANES  # numbers of four parts that a segment leaves


@cache
@no_type_check
def walker(name: str, *, sloping: bool) -> SimpleNamespace:
    """Return the functions `at_nodes, most, open, walk, close` of one precision.

    `at_nodes` says what a particle gives to its nodes, as a `Given`, whose a, mass and third q must be 0 unless it is
    `sloping`. A warp's lanes call the others together: `most` for the greatest of their counts, `open` before they walk
    along their segment, whose parts begin at `at`, `close` after it. `walk` adds the next `count` particles of each
    group to its parts, of which a lane knows that of its row. `span` is what `Lists` has of planes and the first cell.
    """
    types = precision(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    State = wp.types.vector(13, real)
    Lattice, base_node = lattice(name), stencil(name).base_node

    @partial(wp.struct, module=f"gradscape.given.{name}")
    class Given:
        """A particle's cell in its segment, where it is from its base node, and what node i gets of it.

        That is w_i (q + a i), i counted from the base node, and w_i mass.
        """

        cell: int
        f: vec3
        mass: real
        q: vec3
        a: mat33

    @cpp.func_native(called="greatest_count")
    def most(count: int) -> int: ...

    @cpp.func_native()
    def open_segment(parts: wp.array2d[vec4], e: int, at: int, span: int) -> State: ...

    @cpp.func_native(called="walk_segment", template=[str(sloping).lower(), BLOCK // 32])
    def walk(parts: wp.array2d[vec4], e: int, at: int, span: int, count: int, p: Given, state: State) -> State: ...

    @cpp.func_native()
    def close_segment(parts: wp.array2d[vec4], e: int, at: int, span: int, state: State): ...

    @wp.func(module=f"gradscape.given.{name}")
    def at_nodes(lattice: Lattice, x: vec3):
        """Return what a particle there gives to its nodes: nothing as yet."""
        given = Given()
        s = (x - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        given.cell = base[2] % SEGMENT
        given.f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        return given

    return SimpleNamespace(at_nodes=at_nodes, most=most, open=open_segment, walk=walk, close=close_segment)


@dataclass(frozen=True)
class Team:
    """How threads share walks: `groups` of them, a walk each, of `size` lanes, in a warp of so many `lanes`."""

    lanes: int
    groups: int
    size: int

    def threads(self, box: Box, stretch: int = SEGMENT) -> int:
        """Return how many threads a box of nodes takes whose walks leave stretches of so many planes."""
        return -(-most_walks(box, stretch) // self.groups) * self.lanes


GPU_TEAM, CPU_TEAM = Team(32, 3, 9), Team(1, 1, 1)  # on a CPU a thread has a walk

# Threads go through the rows of a batch from the last one on. Kernels before and after go from the first one on, and a
# GPU's cache still has what was written last.
WALK = """
def kernel(lattice, rows, lists, OWN, parts):
    k, t = wp.tid()
    e = rows - 1 - k
    mine = take_walk(e, t, lists)
    if t / lanes * groups >= lists.full[e]:
        return
    at, begin, count, span = mine[0] * PARTS, mine[1], mine[2], mine[3]
    state = open_segment(parts, e, at, span)
    last = begin + wp.max(count - 1, 0)
    place = begin + row_of(t % lanes)
    p = listed(lists.order, e, place, last)
    for i in range(0, most(count), size):
        what = given(lattice, OWN, e, p)
        p = listed(lists.order, e, place + i + size, last)  # asked for before the present ones are walked
        state = walk(parts, e, at, span, wp.min(size, count - i), what, state)
    close_segment(parts, e, at, span, state)
"""


@cache
@no_type_check
def walk_taker(team: Team):
    """Return the functions `take_walk, listed` of a team.

    The first says of a thread's walk (segment, first place, count, span), none if it has none; the second which
    particle has a place in the list, or the `last` one of a walk.
    """
    lanes, groups, group_of, Lists = team.lanes, team.groups, list_functions().group_of, list_struct()

    @wp.func(module=f"gradscape.columns.{lanes}")
    def take_walk(e: int, t: int, lists: Lists):
        group = group_of(t % lanes)
        i = t / lanes * groups + group
        mine = lists.walks[e, wp.min(i, lists.walks.shape[1] - 1)]  # does not wait for how many there are
        if group >= groups or i >= lists.full[e]:
            return wp.vec4i(0, 0, 0, 0)
        return mine

    @wp.func(module=f"gradscape.columns.{lanes}")
    def listed(order: Ints, e: int, place: int, last: int):
        return order[e, wp.min(place, last)]

    return take_walk, listed


def walking_kernel(key: str, name: str, team: Team, given: Any, *, sloping: bool) -> Any:
    """Return the kernel that leaves parts of sums at nodes, to which a particle gives what the function `given` says.

    It runs over [environment, thread of a `team`], and takes what WALK says, OWN being what `given` takes besides the
    lattice, an environment and a particle. What particles give is `sloping`, or not, as the `walker` has it.
    """
    steps, row_of, (take_walk, listed) = walker(name, sloping=sloping), list_functions().row_of, walk_taker(team)
    most, open_segment, walk, close_segment = steps.most, steps.open, steps.walk, steps.close
    lanes, groups, size = team.lanes, team.groups, team.size

    def kernel() -> Any:  # which Warp finds here by their names
        functions = given, take_walk, listed, row_of, most, open_segment, walk, close_segment
        return functions, lanes, groups, size, PARTS

    own = {label: kind for label, kind in given.input_types.items() if label not in ("lattice", "e", "p")}
    kinds = {"lattice": lattice(name), "rows": int, "lists": list_struct()} | own | {"parts": precision(name).rows[2]}
    bounds = {"grid_stride": False} | ({"launch_bounds": blocks(name)} if blocks(name) else {})
    return wp.Kernel(
        cpp.with_arguments(kernel, kinds),
        key=key.replace(".", "__locals__"),
        module=wp.get_module(cpp.module(given.module.name)),
        options={"enable_backward": False} | bounds,
        source=WALK.replace("OWN", ", ".join(own)),
    )


@cache
@no_type_check
def column_kernels(name: str, team: Team) -> SimpleNamespace:
    """Return the kernels `p2g, adjoint_g2p` of one precision, over [environment, thread of a `team`].

    They are the scatters of `transfers`, up to the parts of sums that nodes then add up (`grid`).
    """
    types, at_nodes, lies = precision(name), walker(name, sloping=True).at_nodes, layout(name)
    real, (Reals, Vectors, _, Matrices) = types.real, types.rows
    Lattice, Particles, module = lattice(name), particles(name), cpp.module(f"gradscape.columns.{name}.{team.lanes}")
    read_number, read_vector, read_matrix = lies.read_number, lies.read_vector, lies.read_matrix

    @wp.func(module=module)
    def momentum(lattice: Lattice, mass: Reals, now: Particles, A: Matrices, e: int, p: int):
        """Return what a particle gives to its nodes of momentum m v + A (x_i - x) and mass."""
        given = at_nodes(lattice, read_vector(now.x, e, p))
        given.mass = read_number(mass, e, p)
        given.a = read_matrix(A, e, p) * (real(1.0) / lattice.inv_dx)
        given.q = given.mass * read_vector(now.v, e, p) - given.a * given.f
        return given

    @wp.func(module=module)
    def velocity_adjoint(lattice: Lattice, dt: real, x: Vectors, adj_new: Particles, e: int, p: int):
        """Return what a particle gives to its nodes of the adjoints of the velocities that g2p gathered."""
        given = at_nodes(lattice, read_vector(x, e, p))
        given.a = (real(4.0) * lattice.inv_dx) * read_matrix(adj_new.C, e, p)
        given.q = read_vector(adj_new.v, e, p) + dt * read_vector(adj_new.x, e, p) - given.a * given.f
        return given

    return SimpleNamespace(
        p2g=walking_kernel("column_kernels.p2g", name, team, momentum, sloping=True),
        adjoint_g2p=walking_kernel("column_kernels.adjoint_g2p", name, team, velocity_adjoint, sloping=True),
    )
