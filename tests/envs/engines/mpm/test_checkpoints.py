"""What MLS-MPM keeps of an episode changes no bit of it: parts of the grid, control steps whole or repeated, memory."""

import gc
import weakref
from dataclasses import fields, is_dataclass

import pytest
import torch
import warp as wp

from gradscape.envs.engines.mpm import solver as mpm
from gradscape.envs.engines.mpm.checkpoints import Allocator, Tape
from gradscape.envs.engines.mpm.model import Box, nodes_around
from gradscape.envs.engines.mpm.solver import Solver
from gradscape.envs.engines.runtime import cuda_available, to_torch
from gradscape.envs.mpm.fluid import Fluid

from .bodies import CLAY, SPONGE, SYRUP, free_model, kneaded, kneading, lumps, over_time, solved, stirred, weights

GPU = pytest.mark.skipif(not cuda_available(), reason="no CUDA device")
MODEL, PATHS = kneading()
ADJ_X = {2: weights(MODEL, 3, 5), MODEL.steps: weights(MODEL, 3, 6)}
WHOLE = Box((0, 0, 0), MODEL.nodes)
by_columns = pytest.mark.parametrize("columns", [False, True])


@pytest.fixture(scope="module")
def usual():
    """Return (solver, last x, gradient) of the kneaded lumps, in place and by columns."""
    return {columns: kneaded(MODEL, PATHS, ADJ_X, columns=columns) for columns in (False, True)}


def solver_of(model=MODEL, rows=3, **settings):
    return Solver(model, capacity=rows, device="cpu", **settings)


def assert_does(solver, wanted):
    """Hold what a solver makes of the paths against the last x and the gradient of another."""
    for found, known in zip((solver.run(PATHS), solver.gradient(ADJ_X)), wanted[1:], strict=True):
        assert torch.equal(found, known)
    assert wanted[2].abs().max() > 0


@by_columns
def test_results_do_not_depend_on_what_else_is_in_the_batch(columns):
    """The others lie elsewhere and stray farther, so that another part of the grid is worked on."""
    adj_x = weights(MODEL, 3, 3)
    lone = kneaded(MODEL, PATHS[:1], {MODEL.steps: adj_x[:1]}, columns=columns)
    solver = solver_of(columns=columns)
    to_torch(solver.checkpoints[0].x)[1:] += torch.tensor([[[0.25, 0.1, 0.05]], [[-0.2, 0.2, -0.1]]])
    end, gradient = solver.run(PATHS), solver.gradient({MODEL.steps: adj_x})
    assert all(box.cells < more.cells for box, more in zip(lone[0].boxes, solver.boxes, strict=True))
    assert torch.equal(end[:1], lone[1])
    assert torch.equal(gradient[:1], lone[2])
    assert gradient[0].abs().max() > 0


@by_columns
def test_the_whole_grid_and_its_parts_give_the_same_bits(monkeypatch, usual, columns):
    assert all(box.cells < MODEL.cells / 2 for box in usual[columns][0].boxes)
    monkeypatch.setattr(mpm, "BOX_MARGIN", 1000)
    whole = solver_of(columns=columns)
    assert_does(whole, usual[columns])
    assert whole.boxes == [WHOLE] * MODEL.steps


def test_an_episode_kept_whole_and_one_repeated_step_by_step_give_the_same_bits(monkeypatch, usual):
    monkeypatch.setattr(mpm, "WHOLE_EPISODE", 0)
    repeated = solver_of()
    assert len(usual[False][0].tapes) == MODEL.steps > len(repeated.tapes) == 1
    assert_does(repeated, usual[False])


@by_columns
@pytest.mark.parametrize("materials", [(CLAY, CLAY), (SYRUP, SPONGE), (SYRUP, CLAY)])
def test_an_episode_is_the_same_after_one_elsewhere(materials, columns):
    """The second is run by the launches of the first, on other nodes."""
    model, _ = kneading(bodies=lumps(*materials))
    solver = solver_of(model, columns=columns)
    x = to_torch(solver.checkpoints[0].x)
    start = x.clone()
    x += torch.tensor([0.25, 0.1, 0.05])
    solver.run(PATHS + 0.1)
    solver.gradient(ADJ_X)
    elsewhere = list(solver.boxes)
    x[:] = start
    assert_does(solver, kneaded(model, PATHS, ADJ_X, columns=columns))
    assert all(box != other for box, other in zip(solver.boxes[1:], elsewhere[1:], strict=True))


def test_by_columns_boxes_of_nodes_hold_those_of_all_batches_but_exploded_ones():
    """So that launches that were prepared for one batch serve the next, which has other parameters."""
    solver = solver_of(columns=True)
    x, boxes = to_torch(solver.checkpoints[0].x), list[list[Box]]()
    start = x.clone()
    for moved in (0.0, 0.25, 0.0, 0.1, torch.nan, 0.25):
        x[:] = start + torch.tensor([moved, 0.0, 0.0])
        solver.run(PATHS)
        boxes.append(solver.boxes[1:])
    first, second, again, between, exploded, last = boxes
    assert first != second == again == between == last
    assert WHOLE not in last
    assert set(exploded) == {WHOLE}


@by_columns
@pytest.mark.parametrize("pieces", [2, 3, 100])
def test_a_control_step_in_pieces_gives_the_same_bits(pieces, columns, usual):
    """The last piece has fewer substeps; a second gradient of the same episode is the first."""
    assert MODEL.substeps % MODEL.piece(3) != 0
    cut = solver_of(columns=columns, pieces=pieces)
    assert_does(cut, usual[columns])
    assert cut.tapes[0].bytes < usual[columns][0].tapes[0].bytes
    assert torch.equal(cut.gradient(ADJ_X), usual[columns][2])


def test_a_smoothed_fluid_in_pieces_gives_the_same_bits():
    found = []
    for pieces in (1, 2):
        solver, paths = stirred(smoothing=0.2, columns=True, pieces=pieces)
        end = solver.run(paths).clone()
        found.append((end, solver.gradient({solver.model.steps: weights(solver.model, 2, 7)})))
    assert all(map(torch.equal, *found))
    assert found[0][1].abs().max() > 0


def test_a_control_step_is_cut_into_as_few_pieces_as_fit(monkeypatch):
    sizes = [MODEL.bytes_per_environment(1, columns=True, pieces=count) for count in (1, 2, 3)]
    assert sizes == sorted(sizes, reverse=True)
    for count, size in enumerate(sizes, start=1):
        monkeypatch.setattr(mpm, "free_memory", lambda size=size: -(-size * 8 // 7))
        assert mpm.pieces_that_fit(MODEL, "cuda") == count
    assert mpm.pieces_that_fit(MODEL, "cpu") == 1


@pytest.mark.parametrize("speed", [4.0, 18.0])  # [m/s], so 0.8 or 3.6 cells in a control step
def test_the_grid_grows_where_a_particle_leaves_its_part(monkeypatch, speed):
    """One cell of margin is enough for the slow; the quick make it repeat the step on more, with the same bits."""
    model, velocity = free_model(steps=1), torch.zeros(1, 192, 3, dtype=torch.float64)
    velocity[:, :64, 1], velocity[:, 64:128, 1] = speed, -speed
    cropped = solved(model, 1, velocity)
    assert (cropped.boxes[0] == nodes_around(model, *model.corners, mpm.BOX_MARGIN)) == (speed < 10)
    monkeypatch.setattr(mpm, "BOX_MARGIN", 1000)
    whole = solved(model, 1, velocity)
    assert not any(solver.read_escaped(1).any() for solver in (cropped, whole))
    for name in "xvC":
        assert torch.equal(over_time(cropped, name), over_time(whole, name))


@by_columns
def test_a_tape_grows_by_the_bytes_it_says(columns):
    solver = solver_of(columns=columns)
    tape = Tape(solver.allocator)
    for margin in (0, 3):  # the second time it has something to lose
        solver.set_box(0, box := nodes_around(MODEL, *MODEL.corners, mpm.BOX_MARGIN + margin))
        before, growth = tape.bytes, tape.growth(solver.room(0))
        tape.make_room(0, box, solver.room(0))
        assert tape.bytes - before == growth > 0
    assert tape.growth(solver.room(0)) == 0


@pytest.mark.parametrize("few", [3, 150])
def test_where_more_nodes_are_touched_than_there_is_room_for_the_step_is_done_again(few, usual):
    solver = solver_of(columns=True)
    solver.touched = [few] * MODEL.steps
    assert_does(solver, usual[True])
    for step, touched in enumerate(solver.touched):
        nodes = max(int(to_torch(one.touched)[:, 0].max()) for one in solver.tape(step).lists)
        assert few < nodes <= touched <= solver.tape(step).cells < solver.boxes[step].cells


def test_nodes_at_rest_are_counted(usual):
    """By columns, from the lowest node that a particle touches to the highest: of two lumps above each other, say."""
    assert MODEL.touched == int(to_torch(usual[True][0].tape(0).lists[0].touched)[0, 0])


def test_as_many_control_steps_are_kept_as_fit_on_their_own_boxes(monkeypatch, usual):
    def keep(free):
        monkeypatch.setattr(mpm, "free_memory", lambda: free)
        solver = solver_of(columns=True)
        solver.tapes, solver.spare_used = solver.tapes[:1], False
        for _ in range(2):
            assert_does(solver, usual[True])
        return solver.tapes

    sizes = [tape.bytes for tape in keep(1 << 40)]
    assert len(sizes) == MODEL.steps
    assert max(sizes) > min(sizes)
    enough = int(sum(sizes[:-1]) / (1 - mpm.LEFT[0])) + 1
    for free, kept in ((enough, MODEL.steps), (int(0.99 * enough), MODEL.steps - 1), (0, 1)):
        assert len(keep(free)) == kept
    monkeypatch.setattr(mpm, "LEFT", (1.0, 1e6))  # so many bytes are less than all that is free
    for free, kept in ((1_000_000, MODEL.steps), (999_999, MODEL.steps - 1)):
        assert len(keep(sum(sizes[:-1]) + free)) == kept


@by_columns
def test_a_control_step_that_needs_more_nodes_is_launched_anew_and_no_other(columns, usual):
    """Launches are stored with the arrays they work on; each run of other parameters has steps that need more."""
    solver = solver_of(columns=columns)
    solver.margins[2] += 5  # what all control steps share has room for the largest
    solver.touched[2] *= 3
    for _ in range(2):
        assert_does(solver, usual[columns])
    before, room = dict(solver.launches.sequences), solver.tapes[1].bytes
    if columns:
        solver.touched[1] *= 2  # all steps have room for the largest box
    else:
        solver.margins[1] += 2
    assert_does(solver, usual[columns])
    assert solver.tapes[1].bytes > room
    recorded = {key for key, sequence in solver.launches.sequences.items() if before.get(key) is not sequence}
    assert {key[:2] for key in recorded} == {("forward", 1), ("backward", 1)}


@by_columns
@pytest.mark.parametrize("kept", [1, 2, 3])
def test_control_steps_given_up_one_by_one_change_no_bit(kept, columns, usual):
    """Between two runs, and before the way back, where they are computed again; and their memory is given back."""
    assert MODEL.steps > kept
    solver = solver_of(columns=columns)
    solver.run(PATHS)
    while len(solver.tapes) > kept + 1:
        solver._drop_tape()
    assert_does(solver, usual[columns])
    solver.run(PATHS)
    given_up = weakref.ref(solver.tapes[-2].grids[0].m)
    solver._drop_tape()
    assert given_up() is None  # launches that are stored would hold it
    assert torch.equal(solver.gradient(ADJ_X), usual[columns][2])
    assert len(solver.tapes) == kept


@pytest.mark.parametrize("warned", [True, False])
def test_control_steps_are_given_up_for_memory_and_no_bit_is_lost(monkeypatch, warned, usual):
    """Either it is foreseen that a tape does not fit, or the allocation fails."""
    solver, grid = solver_of(), Allocator.grid

    def scarce(allocator, cells):
        if cells > 1 and allocator is solver.allocator and len(solver.tapes) > 2:
            raise RuntimeError("Failed to allocate 1 bytes on device 'cuda:0'")
        return grid(allocator, cells)

    if warned:
        monkeypatch.setattr(Solver, "_fits", lambda solver, step: len(solver.tapes) <= 2)
    else:
        monkeypatch.setattr(Allocator, "grid", scarce)
    assert_does(solver, usual[False])
    assert (len(usual[False][0].tapes), len(solver.tapes)) == (MODEL.steps, 2)


@by_columns
def test_a_control_step_that_does_not_fit_is_cut_and_no_bit_is_lost(monkeypatch, columns, usual):
    """Only of a single environment: a batch is to be halved first."""
    grid = Allocator.grid

    def scarce(allocator, cells):
        if cells > 1 and solver.pieces < 4:
            raise RuntimeError("Failed to allocate 1 bytes on device 'cuda:0'")
        return grid(allocator, cells)

    monkeypatch.setattr(Allocator, "grid", scarce)
    solver = solver_of(rows=1, columns=columns, pieces=1)
    solver.tapes = solver.tapes[:1]
    assert torch.equal(solver.run(PATHS[:1]), usual[columns][1][:1])
    assert torch.equal(solver.gradient({step: adj_x[:1] for step, adj_x in ADJ_X.items()}), usual[columns][2][:1])
    assert solver.pieces == 4
    solver = solver_of(columns=columns, pieces=1)
    solver.tapes = solver.tapes[:1]
    with pytest.raises(RuntimeError, match="allocate"):
        solver.run(PATHS)


@by_columns
def test_a_solver_goes_when_nothing_needs_it(columns):
    """Nothing that it stores may hold it: a GPU's memory would stay taken until it is collected."""
    gc.collect()
    gc.disable()
    try:
        solver, *_ = kneaded(MODEL, PATHS, {MODEL.steps: weights(MODEL, 3, 3)}, columns=columns)
        there = weakref.ref(solver)
        del solver
        assert there() is None
    finally:
        gc.enable()


@GPU
def test_memory_that_runs_short_is_foreseen(capfd):
    """Another takes most of it once the batch has been chosen: results are the same, and nobody says it ran out."""
    env = Fluid(fidelity="draft", device="cuda")
    x = env.space.uniform(env.preferred_batch, seed=0)
    wanted = env.evaluate(x, grad=True)
    env = Fluid(fidelity="draft", device="cuda")
    hoard = []
    while wp.get_device("cuda").free_memory > 12 << 30:
        hoard.append(torch.empty(1 << 30, dtype=torch.uint8, device="cuda"))
    for _ in range(2):  # it keeps more from its second run on
        found = env.evaluate(x, grad=True)
        torch.testing.assert_close(found.loss, wanted.loss, rtol=1e-4, atol=1e-5)
    assert "out of memory" not in "".join(capfd.readouterr())


def arrays(thing, seen):
    """Yield every array a solver holds that grows with its capacity."""
    if isinstance(thing, wp.array):
        if thing.ndim > 1 and thing.ptr not in seen:
            seen.add(thing.ptr)
            yield thing
    elif is_dataclass(thing):
        for field in fields(thing):
            yield from arrays(getattr(thing, field.name), seen)
    elif isinstance(thing, list | tuple):
        for item in thing:
            yield from arrays(item, seen)


def test_the_memory_estimate_is_what_a_solver_takes():
    solver, path = stirred()
    solver.run(path)
    solver.gradient({solver.model.steps: torch.ones((2, solver.model.particles, 3), dtype=torch.float64)})
    seen = set()
    held = [*vars(solver).values(), *vars(solver.adjoint).values()]
    held += [part for tape in solver.tapes for part in vars(tape).values()]
    taken = sum(array.capacity for thing in held for array in arrays(thing, seen))
    assert taken / solver.capacity == pytest.approx(mpm.memory(solver.model, "cpu"), rel=0.25)  # grids as they come
