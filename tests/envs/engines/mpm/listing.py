"""Particles listed by cell, on arrays of a CPU: by its own launches, or by a GPU's in emulation."""

import warp as wp

from gradscape.envs.engines.mpm.columns import (
    SEGMENT,
    SIZES,
    cell_kernels,
    count_struct,
    list_struct,
    most_walks,
    segments,
    whole_warps,
)
from gradscape.envs.engines.runtime import fill_struct, precision, to_torch


def integers(rows, sizes):
    return {field: wp.zeros((rows, size), dtype=wp.int32) for field, size in sizes.items()}


class Listing:
    """Lists of particles at `x` [row, particle, axis], which kernels make that `launch` runs, as `wp.launch` would."""

    def __init__(self, launch, name, lattice, box, x, stretch=SEGMENT):
        self.launch, self.kernels, self.lattice, self.box = launch, cell_kernels(name), lattice, box
        self.stretch, walks = stretch, most_walks(box, stretch)
        self.shape, self.x = x.shape[:2], wp.array(x.numpy(), dtype=precision(name).vec3)
        rows, count, room = *self.shape, segments(box)
        sizes = {"cells": count, "numbers": count, "arrived": count, "counts": room * SEGMENT, "used": 2}
        sizes |= {"sizes": SIZES, "ranks": walks, "spans": 2 * box.columns}
        self.counts = fill_struct(count_struct(), integers(rows, sizes))
        self.counts.places = wp.zeros((rows, room * SEGMENT), dtype=wp.vec2i)
        sizes = {"order": count, "planes": room, "starts": box.columns, "nodes": box.cells, "touched": 2}
        self.lists = fill_struct(list_struct(), integers(rows, sizes))
        self.counts.found, self.lists.walks = (wp.zeros((rows, walks), dtype=wp.vec4i) for _ in range(2))
        self.needed, self.lists.full = (wp.zeros(rows, dtype=wp.int32) for _ in range(2))

    def run(self):
        """Make the lists, and begin where the last run has ended: at zeros."""
        rows, count, given = *self.shape, [self.lattice, self.counts, self.lists]
        self.launch(self.kernels.count, self.shape, [self.lattice, self.x, self.counts])
        self.launch(self.kernels.place_segments, (rows, whole_warps(segments(self.box))), [*given, self.stretch])
        self.launch(self.kernels.place, (rows, whole_warps(max(count, self.box.columns))), given)
        self.launch(self.kernels.tidy, self.shape, [*given, self.needed])
        assert not any(to_torch(getattr(self.counts, field)).any() for field in ("counts", "used", "sizes", "spans"))
