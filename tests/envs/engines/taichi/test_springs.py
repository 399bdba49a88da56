"""The Taichi sheets against Warp's, which share no more than the scene's data."""

import gc
from dataclasses import replace

import pytest
import torch

from gradscape.envs.engines.sheets import springs
from gradscape.envs.engines.sheets.contact import AnchoredFloor, Floor, PanOverFloor
from gradscape.envs.engines.taichi import springs as taichi_springs
from gradscape.envs.engines.taichi.runtime import start

from ..sheets.cloths import DT, PAN, ROWS, crumpled, drive

pytestmark = pytest.mark.slow

STEPS = 40


def across(surface):
    """Return a sheet of 4 x 4 cells, of which two corners are held, that crosses its surface.

    It lies on the floor, or across the whole pan: one vertex starts on the axis, corners are beyond the rim.
    """
    pitch = 0.04 if isinstance(surface, Floor) else 0.08
    sheet = crumpled(4, pitch, (-2 * pitch, 0.0, -2 * pitch), held=(20, 24))
    sheet.x[12] = 0.0, -0.002, 0.0
    return sheet


def made(engine, surface, rule):
    given = dict(dt=DT, steps=STEPS, name="float64", capacity=ROWS + 1, device="cpu", rule=rule)
    return engine.Solver(across(surface), surface, **given)


ROUGH = PanOverFloor(replace(PAN, friction=0.3), Floor(height=-0.02, friction=0.2))
SURFACES = {
    "floor": (Floor(height=0.001), "end"),
    "floor under anchors": (AnchoredFloor(height=0.001), "start"),
    "pan": (PAN, "end"),
    "pan once inside": (PAN, "start"),
    "pan over floor, with friction": (ROUGH, "end"),
}


@pytest.fixture(scope="module", params=SURFACES.values(), ids=SURFACES.keys())
def case(request):
    return request.param


@pytest.fixture(scope="module")
def driven():
    return drive(across(Floor()), STEPS, turn=10.0)


@pytest.fixture(scope="module")
def solver(case):
    return made(taichi_springs, *case)


@pytest.fixture(scope="module")
def warp(case, driven):
    """Return Warp's path and gradient."""
    inputs, adj_x = driven
    solver = made(springs, *case)
    return solver.run(*inputs).clone(), solver.gradient(adj_x)


def assert_close(ours, theirs, tolerance):
    """Compare by the largest value."""
    torch.testing.assert_close(ours, theirs, rtol=0, atol=tolerance * float(theirs.abs().max()))


def test_sheets_move_as_warps_do(solver, driven, warp):
    x = solver.run(*driven[0])
    assert x.shape == (STEPS + 1, ROWS, 25, 3)
    assert_close(x, warp[0], 1e-13)


def test_the_compilers_adjoint_is_the_one_written_by_hand(solver, driven, warp):
    inputs, adj_x = driven
    solver.run(*inputs)
    for _ in range(2):  # nothing is added to the gradient before
        for given, ours, theirs in zip(inputs, solver.gradient(adj_x), warp[1], strict=True):
            assert ours.shape == given.shape
            assert_close(ours, theirs, 1e-12)


def test_a_surface_without_poses_stands_still(solver, driven):
    velocity, stiffness, poses = driven[0]
    assert torch.equal(solver.run(velocity, stiffness), solver.run(velocity, stiffness, torch.zeros_like(poses)))


def one_step(engine, sheet):
    return engine.Solver(sheet, Floor(), dt=DT, steps=1, name="float64", capacity=1, device="cpu")


def test_ends_that_coincide_pull_in_no_direction(driven):
    sheet = across(Floor())
    sheet.x[1] = sheet.x[0]
    (velocity, stiffness, _), adj_x = driven
    ends = []
    for engine in (taichi_springs, springs):
        solver = one_step(engine, sheet)
        ends.append([solver.run(velocity[:1], stiffness[:1])[-1].clone(), *solver.gradient(adj_x[:1])])
    for ours, theirs in zip(*ends, strict=True):
        assert_close(ours, theirs, 1e-12)


def test_what_does_not_fit_is_refused_since_kernels_check_no_index(solver, driven):
    (velocity, stiffness, poses), adj_x = driven
    more = [part[[0, 1, 2, 0, 1]] for part in driven[0]]
    with pytest.raises(ValueError, match="up to 4 rows; got 5"):
        solver.run(*more)
    with pytest.raises(ValueError, match=r"stiffness of shape \(3, 25\); got \(3, 24\)"):
        solver.run(velocity, stiffness[:, 1:], poses)
    with pytest.raises(ValueError, match=r"poses of shape \(3, 41, 3\); got \(3, 40, 3\)"):
        solver.run(velocity, stiffness, poses[:, 1:])
    solver.run(velocity, stiffness, poses)
    with pytest.raises(ValueError, match=r"adj_x of shape \(3, 25, 3\); got \(2, 25, 3\)"):
        solver.gradient(adj_x[1:])


def test_a_stopped_solver_raises_within_a_step_and_leaves_nothing_behind(solver, driven, warp, monkeypatch):
    inputs, adj_x = driven
    for simulate in (lambda: solver.run(*inputs), lambda: solver.gradient(adj_x)):
        asked = iter([False] * 10 + [True])
        monkeypatch.setattr(solver.stop, "is_set", lambda asked=asked: next(asked))
        with pytest.raises(InterruptedError, match="the simulation was stopped"):
            simulate()
        monkeypatch.undo()
        solver.run(*inputs)
    for ours, theirs in zip(solver.gradient(adj_x), warp[1], strict=True):
        assert_close(ours, theirs, 1e-12)


def test_fields_go_with_their_solver():
    trees = start("cpu").lang.impl.get_runtime().prog.get_snode_tree_size
    counts = []
    for _ in range(2):
        one_step(taichi_springs, across(Floor()))
        gc.collect()
        counts.append(trees())
    assert counts[0] == counts[1]


def test_a_row_is_the_same_bit_for_bit_alone_and_among_others(solver, driven):
    inputs, adj_x = driven
    x, gradient = solver.run(*inputs).clone(), solver.gradient(adj_x)
    for row in range(ROWS):
        one = slice(row, row + 1)
        assert torch.equal(solver.run(*(part[one] for part in inputs)), x[:, one])
        for alone, among in zip(solver.gradient(adj_x[one]), gradient, strict=True):
            assert torch.equal(alone, among[one])


def test_starting_taichi_leaves_subnormal_numbers_to_others():
    start("cpu")
    least = torch.tensor([5e-324], dtype=torch.float64)
    assert torch.equal(least + 0, least)
