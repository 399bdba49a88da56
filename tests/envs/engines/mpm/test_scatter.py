"""Sums by columns of cells, as a GPU makes them, against those in place; here each warp's work is done by one thread."""

import pytest
import torch
import warp as wp

from gradscape.envs.engines.mpm.cells import SEGMENT, Lister, segments
from gradscape.envs.engines.mpm.model import Box, place_grid
from gradscape.envs.engines.runtime import to_torch

from .bodies import kneaded, kneading, stirred, weights


def assert_equal_but_for_rounding(got, wanted):
    torch.testing.assert_close(got, wanted, rtol=0, atol=1e-11 * float(wanted.abs().max()))


def test_clay_under_tools_moves_as_in_place():
    model, paths = kneading()
    adj_x = {2: weights(model, 3, 5), model.steps: weights(model, 3, 6)}
    wanted, got = (kneaded(model, paths, adj_x, columns=columns) for columns in (False, True))
    assert_equal_but_for_rounding(got[1], wanted[1])
    assert_equal_but_for_rounding(got[2], wanted[2])
    assert wanted[2].abs().max() > 0


def test_a_stirred_fluid_is_smoothed_and_moves_as_in_place():
    ends = []
    for columns in (False, True):
        solver, paths = stirred(smoothing=0.7, columns=columns)
        end = solver.run(paths).clone()
        ends.append((end, solver.gradient({solver.model.steps: weights(solver.model, 2, 7)})))
    assert_equal_but_for_rounding(ends[1][0], ends[0][0])
    assert_equal_but_for_rounding(ends[1][1], ends[0][1])
    assert ends[0][1].abs().max() > 0


@pytest.mark.parametrize("first", [0, 3])
def test_particles_are_listed_by_cell_and_then_as_they_lie(first):
    model, _ = kneading()
    box = Box((0, 0, first), (*model.nodes[:2], model.nodes[2] - first))
    x = torch.rand((2, 500, 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.4 - 0.2
    x[:, :, 1] += 0.4
    lister = Lister("float64", 500, 2, "cpu")
    order, begins, ends = list_by_hand(lister, model, box, x)
    s = (x - torch.tensor(model.origin)) / model.dx
    cell = (s - 0.5).floor().long()
    for row in range(2):
        keys = [(*cell[row, p, :2].tolist(), int(cell[row, p, 2]), p) for p in range(500)]
        assert order[row].tolist() == [key[-1] for key in sorted(keys)]
        full = (ends[row] > 0).nonzero()[:, 0]
        assert len(full) == len({(i, j, k // SEGMENT) for i, j, k, _ in keys})
        assert begins[row, full].tolist() == [0, *ends[row, full][:-1].tolist()]
        for segment in full.tolist():
            members = order[row, begins[row, segment] : ends[row, segment]].tolist()
            assert len({(i, j, k // SEGMENT) for i, j, k in cell[row, members].tolist()}) == 1


def list_by_hand(lister, model, box, x):
    """Return the order of particles, and the beginnings and ends of segments, all [row, *]."""
    lattice, count = place_grid(model, box), segments(box)
    at = wp.array(x.numpy(), dtype=wp.vec3d)
    order, first, end = (wp.zeros((len(x), size), dtype=wp.int32) for size in (x.shape[1], count, count))
    wp.launch(lister.kernels.label, x.shape[:2], [lattice, at, lister.keys, lister.places])
    lister.sort(box, len(x))
    wp.launch(lister.kernels.forget, (len(x), count), [lattice, first, end])
    inputs = [lattice, lister.keys, lister.places, order, first, end]
    wp.launch(lister.kernels.list_cells, x.shape[:2], inputs)
    return to_torch(order).clone(), to_torch(first).clone(), to_torch(end).clone()
