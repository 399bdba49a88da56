"""Sums by columns of cells, as a GPU makes them, against those in place; here a thread does the work of a warp."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest
import torch
import warp as wp

from gradscape.envs.engines.mpm.columns import SEGMENT, SIZES, STEP, STRETCH, arrays_of, segments
from gradscape.envs.engines.mpm.model import Body, Box, Model, place_grid
from gradscape.envs.engines.mpm.solver import Solver
from gradscape.envs.engines.runtime import to_torch

from ..bench import draw
from .bodies import CLAY, SPONGE, SYRUP, kneaded, kneading, lumps, stirred, weights
from .listing import Listing

MODEL, PATHS = kneading()
PARTICLE = Body(CLAY, MODEL.bodies[0].x[:1], np.full(1, 1e-5), np.ones(1))
BODIES = {
    "clay": MODEL.bodies,
    "a fluid beside a sponge": lumps(SYRUP, SPONGE),
    "a sponge beside clay": lumps(SPONGE, CLAY),
    "a lone particle": (PARTICLE,),
}


@pytest.mark.parametrize("bodies", [*BODIES, "a smoothed fluid"])
def test_bodies_move_as_in_place(bodies):
    """By columns the way back computes A again, so that no substep keeps it."""
    found = []
    for columns in (False, True):
        if bodies == "a smoothed fluid":
            solver, paths = stirred(smoothing=0.7, columns=columns)
        else:
            model, paths = replace(MODEL, bodies=BODIES[bodies]), PATHS
            solver = Solver(model, capacity=3, device="cpu", columns=columns)
        adj_x = {step: weights(solver.model, len(paths), step) for step in (2, solver.model.steps)}
        found.append((solver.run(paths).clone(), solver.gradient(adj_x)))
        assert torch.equal(solver.run(paths), found[-1][0])
        assert len(solver.tapes[0].A) == (1 if columns else solver.model.substeps)
    for wanted, got in zip(*found, strict=True):
        torch.testing.assert_close(got, wanted, rtol=0, atol=1e-11 * float(wanted.abs().max()))
        assert wanted.abs().max() > 0


@pytest.mark.parametrize("columns", [False, True])
def test_bodies_of_one_material_are_simulated_together_and_no_bit_changes(monkeypatch, columns):
    model = replace(MODEL, bodies=lumps(CLAY, CLAY))
    adj_x = {model.steps: weights(model, 3, 6)}
    (group,) = model.groups
    assert len(group.x) == model.particles
    together = kneaded(model, PATHS, adj_x, columns=columns)
    assert len(together[0].materials) == 1
    monkeypatch.setattr(Model, "groups", property(lambda model: model.bodies))
    apart = kneaded(model, PATHS, adj_x, columns=columns)
    assert len(apart[0].materials) == 2
    assert torch.equal(together[1], apart[1])
    assert torch.equal(together[2], apart[2])


@pytest.mark.parametrize("stretch", [SEGMENT, STRETCH, 1])
@pytest.mark.parametrize("first", [0, 3])
def test_particles_are_listed_by_cell_and_then_as_they_lie(first, stretch):
    """A walk has the particles that touch its planes, and the walks along a segment have its planes between them."""
    model = MODEL
    box = Box((0, 0, first), (*model.nodes[:2], model.nodes[2] - first))
    x = 0.4 * draw(2, 500, 3, seed=1)
    x[:, :, 1] += 0.4
    cell = ((x - torch.tensor(model.origin)) / model.dx - 0.5).floor().long()
    depth = segments(box) // (box.nodes[0] * box.nodes[1])
    listing = Listing(wp.launch, "float64", place_grid(model, box), box, x, stretch)
    for _ in range(2):  # the second time it begins where the first has ended
        listing.run()
        order, full, walks, planes, *_ = (to_torch(array).clone() for array in arrays_of(listing.lists))
        for row in range(2):
            keys = sorted((i, j, k // SEGMENT, k % SEGMENT, p) for p, (i, j, k) in enumerate(cell[row].tolist()))
            found = {}
            sizes = [min(count // STEP, SIZES - 1) for count in walks[row, : full[row], 2].tolist()]
            assert sizes == sorted(sizes, reverse=True)
            for s, begin, count, span in walks[row, : full[row]].tolist():
                column, layer = divmod(s, depth)
                place = *divmod(column, box.nodes[1]), layer + first // SEGMENT
                walk = span % 256, span // 256 % 256, span // 65536, order[row, begin : begin + count].tolist()
                found.setdefault(place, []).append(walk)
            wanted = {where: list(group) for where, group in groupby(keys, key=lambda key: key[:3])}
            assert found.keys() == wanted.keys()
            for place, group in wanted.items():
                spans = [(lowest, beyond) for lowest, beyond, *_ in sorted(found[place])]
                ends = [group[0][3], *(beyond for _, beyond in spans)]
                assert ends[-1] == group[-1][3] + 3
                assert [lowest for lowest, _ in spans] == ends[:-1]
                *others, last = [beyond - lowest for lowest, beyond in spans]
                assert others == [stretch] * len(others)
                assert 3 <= last <= stretch + 2
                for lowest, beyond, start, listed in found[place]:
                    assert start == max(ends[0], lowest - 2)
                    assert listed == [key[-1] for key in group if lowest - 2 <= key[3] < beyond]
                s = (place[0] * box.nodes[1] + place[1]) * depth + place[2] - first // SEGMENT
                assert planes[row, s] == sum(1 << plane for plane in range(ends[0], ends[-1]))
            assert int((planes[row] > 0).sum()) == len(wanted)
            assert full[row] >= len(wanted)
            assert (full[row] == len(wanted)) == (stretch == SEGMENT)


def test_particles_that_are_nowhere_are_not_listed():
    box = Box((0, 0, 0), MODEL.nodes)
    x = 0.4 * draw(2, 500, 3, seed=1)
    x[0, ::3, 1], x[0, 1, 2], x[1] = torch.nan, torch.inf, -torch.inf
    listing = Listing(wp.launch, "float64", place_grid(MODEL, box), box, x)
    for _ in range(2):  # the second time it begins where the first has ended
        listing.run()
        order, full, segments_found, *_ = (to_torch(array).clone() for array in arrays_of(listing.lists))
        listed = torch.cat([order[0, begin : begin + count] for _, begin, count, _ in segments_found[0, : full[0]]])
        assert sorted(listed.tolist()) == [p for p in range(500) if p % 3 and p != 1]
        assert full[1] == 0


def test_an_environment_that_has_blown_up_changes_no_other():
    adj_x = {MODEL.steps: weights(MODEL, 3, 5)}
    lone = kneaded(MODEL, PATHS, adj_x, columns=True)
    solver = Solver(MODEL, capacity=3, device="cpu", columns=True)
    to_torch(solver.checkpoints[0].x)[1] = torch.nan
    end, gradient = solver.run(PATHS), solver.gradient(adj_x)
    assert end[1].isnan().all()
    for row in (0, 2):
        assert torch.equal(end[row], lone[1][row])
        assert torch.equal(gradient[row], lone[2][row])


def test_a_batch_that_keeps_a_gpu_busy_walks_whole_segments_and_gives_the_same_bits(monkeypatch):
    adj_x = {MODEL.steps: weights(MODEL, 3, 6)}
    monkeypatch.setattr("gradscape.envs.engines.mpm.scatter.STRETCH", 1)
    short, *results = kneaded(MODEL, PATHS, adj_x, columns=True)
    monkeypatch.setattr("gradscape.envs.engines.mpm.solver.LAUNCHES", 0)
    whole, *others = kneaded(MODEL, PATHS, adj_x, columns=True)
    walks, longer = (to_torch(solver.tapes[0].lists[0].full).sum() for solver in (short, whole))
    assert walks > longer
    assert all(map(torch.equal, results, others))
