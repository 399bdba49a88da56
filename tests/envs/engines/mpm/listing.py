"""Particles listed by cell, on arrays of a CPU: by its own launches, or by a GPU's in emulation."""

import warp as wp

from gradscape.envs.engines.mpm.columns import (
    SEGMENT,
    SIZES,
    Lists,
    cell_kernels,
    most_walks,
    placing_warps,
    segments,
    warps,
)
from gradscape.envs.engines.runtime import precision, to_torch


class Listing:
    """Lists of particles at `x` [row, particle, axis], which kernels make that `launch` runs, as `wp.launch` would."""

    def __init__(self, launch, name, lattice, box, x, stretch=SEGMENT):
        self.launch, self.kernels, self.lattice, self.box = launch, cell_kernels(name), lattice, box
        self.stretch, walks = stretch, most_walks(box, stretch)
        self.shape, self.x = x.shape[:2], wp.array(x.numpy(), dtype=precision(name).vec3)
        rows, count, room = *self.shape, segments(box)
        order, self.cells, self.numbers, self.arrived = (wp.zeros((rows, count), dtype=wp.int32) for _ in range(4))
        self.counts = wp.zeros((rows, room * SEGMENT), dtype=wp.int32)
        self.places = wp.zeros((rows, room * SEGMENT), dtype=wp.vec2i)
        self.used, self.sizes, ranks, planes = (wp.zeros((rows, n), dtype=wp.int32) for n in (2, SIZES, walks, room))
        unsorted, found = (wp.zeros((rows, walks), dtype=wp.vec4i) for _ in range(2))
        self.found = [unsorted, ranks]
        self.needed = wp.zeros(rows, dtype=wp.int32)
        counts = 2 * box.columns, box.columns, box.cells, 2
        self.spans, starts, nodes, touched = (wp.zeros((rows, count), dtype=wp.int32) for count in counts)
        self.lists = Lists(order, wp.zeros(rows, dtype=wp.int32), found, planes, starts, nodes, touched)

    def run(self):
        """Make the lists, and begin where the last run has ended: at zeros."""
        lists, counts = self.lists, [self.used, self.sizes]
        self.launch(self.kernels.count, self.shape, [self.lattice, self.x, self.cells, self.numbers, self.counts])
        inputs = [self.lattice, self.counts, *counts, self.places, *self.found, lists.planes]
        inputs += [self.spans, lists.touched, self.stretch]
        self.launch(self.kernels.place_segments, (self.shape[0], warps(self.box)), inputs)
        inputs = [self.lattice, self.cells, self.numbers, self.places, *counts, *self.found, self.arrived, lists.full]
        inputs += [lists.walks, self.spans, lists.touched, lists.starts, lists.nodes]
        self.launch(self.kernels.place, (self.shape[0], placing_warps(self.shape[1], self.box)), inputs)
        inputs = [self.lattice, self.cells, self.places, self.arrived, *counts, self.spans, lists.order]
        self.launch(self.kernels.tidy, self.shape, [*inputs, lists.touched, self.needed])
        assert not any(to_torch(array).any() for array in (self.counts, *counts, self.spans))
