"""How a warp of a GPU walks along the cells of its segments, and adds up what their particles give to nodes.

Nine lanes take the particles of a segment one after the other. Each holds the sums of three of the 27 nodes around the
present cell, a row along z. Where the next cell begins, the lowest nine are written down, beside each other, since a
cache takes whole sectors much faster than parts of them, and the others become lower by one. Planes below those of a
stretch, which another walk leaves, are not written.

A lane works out what one particle gives to all nine rows, and puts it into memory that the warp shares, where each lane
reads what concerns its own row, since reading there is what limits a scatter. No more than nine particles of a segment
are there at once: the cache has what shared memory leaves of the same storage.
"""

from functools import cache, partial
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from .. import cpp
from ..launches import BLOCK
from ..runtime import precision
from .cells import SEGMENT
from .stencil import lattice, stencil

PLANES = SEGMENT + 2  # of nodes that the cells of a segment touch
PARTS = 9 * PLANES  # numbers of four parts that a segment leaves


@cache
@no_type_check
def lane_numbers() -> SimpleNamespace:
    """Return the functions `group` and `row` of a lane of a warp: its segment, none from three on, and its nodes."""

    @cpp.func_native(called="group_of_lane")
    def group(lane: int) -> int: ...

    @cpp.func_native(called="row_of_lane")
    def row(lane: int) -> int: ...

    return SimpleNamespace(group=group, row=row)


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
