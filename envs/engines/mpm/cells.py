"""Which particles lie in which cells at a substep, so that a scatter can go from cell to cell.

Between control steps particles lie in memory by body and cell (`order`), but they move on in between. So each substep
lists its particles by cell, and those of a cell as they lie in memory. SEGMENT cells along z, from a multiple of
SEGMENT on, make a segment, whose particles come one after the other in the list.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from ..runtime import precision
from .model import Box
from .stencil import lattice, stencil

SEGMENT = 8  # cells


@dataclass(frozen=True, eq=False)
class Lists:
    """The particles by cell: `order` [environment, place], and where a segment's begin and end there.

    `first` and `end` are [environment, segment]; both are 0 where a segment has none.
    """

    order: wp.array
    first: wp.array
    end: wp.array


def segments(box: Box) -> int:
    """Return the number of segments of a box of nodes."""
    first, count = box.first[2], box.nodes[2]
    return box.nodes[0] * box.nodes[1] * ((first + count - 1) // SEGMENT - first // SEGMENT + 1)


@cache
@no_type_check
def cell_functions(name: str) -> SimpleNamespace:
    """Return the functions `depth, column` of one precision.

    depth(lattice) is the number of segments along z, column(lattice, i, j) that of the first segment of a column.
    """
    Lattice, module = lattice(name), f"gradscape.cells.{name}"

    @wp.func(module=module)
    def depth(lattice: Lattice):
        return (lattice.first[2] + lattice.nz - 1) / SEGMENT - lattice.first[2] / SEGMENT + 1

    @wp.func(module=module)
    def column(lattice: Lattice, i: int, j: int):
        return (i * lattice.ny + j) * depth(lattice)

    return SimpleNamespace(depth=depth, column=column)


@cache
@no_type_check
def cell_kernels(name: str) -> SimpleNamespace:
    """Return the kernels `label, forget, list_cells` of one precision."""
    types = precision(name)
    real, vec3 = types.real, types.vec3
    Lattice, base_node, functions = lattice(name), stencil(name).base_node, cell_functions(name)
    depth, column, module = functions.depth, functions.column, f"gradscape.cells.{name}"

    @wp.kernel(module=module, enable_backward=False)
    def label(lattice: Lattice, x: wp.array2d[vec3], keys: wp.array[wp.int32], places: wp.array[wp.int32]):
        """Give each particle a key by environment and cell."""
        e, p = wp.tid()
        base = base_node((x[e, p] - lattice.origin) * lattice.inv_dx, lattice)
        first = column(lattice, base[0] - lattice.first[0], base[1] - lattice.first[1])
        segment = first + base[2] / SEGMENT - lattice.first[2] / SEGMENT
        segment += e * lattice.nx * lattice.ny * depth(lattice)
        at = e * x.shape[1] + p
        keys[at] = segment * SEGMENT + base[2] % SEGMENT
        places[at] = p

    @wp.kernel(module=module, enable_backward=False)
    def forget(lattice: Lattice, first: wp.array2d[wp.int32], end: wp.array2d[wp.int32]):
        e, s = wp.tid()
        first[e, s] = 0
        end[e, s] = 0

    @wp.kernel(module=module, enable_backward=False)
    def list_cells(
        lattice: Lattice,
        keys: wp.array[wp.int32],
        places: wp.array[wp.int32],
        order: wp.array2d[wp.int32],
        first: wp.array2d[wp.int32],
        end: wp.array2d[wp.int32],
    ):
        """Take the particles' order, and find where each segment begins and ends in it."""
        e, p = wp.tid()
        count = order.shape[1]
        at = e * count + p
        order[e, p] = places[at]
        here = keys[at] / SEGMENT
        segment = here - e * lattice.nx * lattice.ny * depth(lattice)
        before, after = int(-1), int(-1)
        if p > 0:
            before = keys[at - 1] / SEGMENT
        if p < count - 1:
            after = keys[at + 1] / SEGMENT
        if before != here:
            first[e, segment] = p
        if after != here:
            end[e, segment] = p + 1

    return SimpleNamespace(label=label, forget=forget, list_cells=list_cells)


class Lister:
    """List the particles of up to `capacity` environments by cell."""

    def __init__(self, name: str, particles: int, capacity: int, device: str) -> None:
        self.kernels, self.particles, self.device = cell_kernels(name), particles, device
        room = 2 * capacity * particles
        self.keys, self.places = (wp.zeros(room, dtype=wp.int32, device=device) for _ in range(2))

    def sort(self, box: Box, batch: int) -> None:
        """Bring keys and places into the order of keys; those that are equal stay as they are."""
        bits = (batch * segments(box) * SEGMENT).bit_length()
        wp.utils.radix_sort_pairs(self.keys, self.places, batch * self.particles, 0, bits)
