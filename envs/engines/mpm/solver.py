"""MLS-MPM (Hu et al. 2018) for a batch of environments, with gradients recomputed from control-step checkpoints.

One substep, state (x, v, C, S) of frame s to frame s + 1, S being each material's own state:

    update  S'   = deform(S, C), A = -dt V 4/dx^2 tau(S', C) + m C
    p2g     m_i  = sum w m,   q_i = sum w (m v + A (x_i - x))
    grid    v_i  = boundary(q_i / m_i + dt g), between images in walls that reflect (`mirrors`)
    g2p     v'   = sum w v_i, C' = 4/dx^2 sum w v_i (x_i - x)^T, x' = x + dt v'

Particles are kept at the ends of control steps; as many of the last control steps as fit are kept whole, with A and
grids of every substep (on a CPU all or one). The gradient recomputes the others, one at a time, and a step that is too
large to be kept whole in pieces. Between control steps particles are sorted (`order`), and a fluid's volume ratios
smoothed (`smoothing`).
"""

import threading
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cache, partial
from itertools import chain
from types import SimpleNamespace
from typing import Any, no_type_check

import numpy as np
import torch
import warp as wp

from ....landscapes.sampling.memory import release_idle
from .. import cpp
from ..cpp import threads
from ..launches import Launches
from ..runtime import free_memory, load, precision, to_torch
from .boundaries import settle_kernel, substep_struct
from .checkpoints import Allocator, Frame, Sizes, Tape
from .columns import GPU_TEAM, cell_kernels, column_kernels, list_struct, segments
from .grid import velocity_on
from .mirrors import mirror_kernels, mirrors_of_columns
from .model import BOX_MARGIN, EMPTY, Box, Model, nodes_around, walls_that_reflect
from .order import Order, Sorter, sorting_kernels
from .scatter import ByColumns, InPlace, Scatter, nodes
from .smoothing import ColumnSmoother, Smoother, smoothing_columns, smoothing_kernels
from .stencil import lattice, to_rows
from .transfers import transfers, transfers_of_columns

# ---- All kernels of a model at once: compiled in parallel, where a solver's parts ask for theirs one by one.


def compile_all(model: Model, device: str) -> None:
    """Compile what a solver of the model launches, forward and backward, or fetch it from the cache."""
    load(kernels(model, device), device)


def kernels(model: Model, device: str) -> Iterator[Any]:
    """Yield a kernel or more of each module, those first that take longest to compile."""
    name, columns = model.precision, device != "cpu"
    if columns:
        yield from (transfers_of_columns(name).g2p, column_kernels(name, GPU_TEAM).p2g, cell_kernels(name).count)
        yield settle_kernel(name)
    else:
        yield transfers(name).p2g
    if any(body.material.smoothing for body in model.groups):
        yield (smoothing_columns(name, GPU_TEAM) if columns else smoothing_kernels(name)).spread
    yield velocity_on(name, model.boundary, columns=columns)
    if any(chain.from_iterable(walls_that_reflect(model))):
        yield (mirrors_of_columns if columns else mirror_kernels)(name).unfold
    for body in model.groups:
        yield from body.material.kernels(name, columns=columns)
    yield extent_kernels(name).look
    sorting = sorting_kernels(name, wp.int32)  # with which all but huge batches are sorted
    yield sorting.label
    for body in model.groups:
        yield from sorting.states[body.material.state(name)]


# ---- The backward pass of MLS-MPM: the adjoints of the states of particles, control step by control step, and of
# tools.


class Adjoint:
    """Hold the adjoint arrays of a solver and run its backward pass."""

    def __init__(self, solver: Any) -> None:
        self.solver = weakref.proxy(solver)  # which holds this: a cycle would keep a GPU's memory until it is collected
        self.new, self.old = solver.allocator.frame(), solver.allocator.frame()
        self.A = None if solver.columns else solver.allocator.affine_momentum()
        self.grid = solver.allocator.grid(max(tape.cells for tape in solver.tapes))
        self.tools = solver.allocator.paths()
        self.tools_by_axis: Any = wp.from_torch(to_torch(self.tools), requires_grad=False)
        self.settle = settle_kernel(solver.model.precision)  # of a GPU, where nodes do not add to the adjoint itself
        load([self.settle] if solver.device != "cpu" else [], solver.device)
        # Adjoints that nobody wants, but Warp their place.
        self.structs = lattice(solver.model.precision)(), type(solver.boundary)(), solver.substep()
        self.lists = [list_struct()()] if solver.columns else []

    def run(self, adj_x: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """Return the adjoint of the tools, shape (batch, step + 1, slot, 3)."""
        solver, batch = self.solver, len(next(iter(adj_x.values())))
        for array in (*self.new.arrays(), self.tools, solver.sums):
            array.zero_()
        solver.scatter.begin()
        for step in reversed(range(max(adj_x))):
            if step + 1 in adj_x:
                x = to_torch(self.new.x)[:batch]
                x += solver.orders[step + 1].from_model(adj_x[step + 1].to(x))
            if solver.tape(step).step != step:
                solver.advance(step, batch)
            self._retreat(step, batch)
        return to_torch(self.tools)[:batch].clone()

    def _retreat(self, step: int, batch: int) -> None:
        solver = self.solver
        if self.grid.m.shape[1] < solver.tape(step).cells:
            self.grid = solver.allocator.grid(solver.tape(step).cells)
            solver.launches.clear(lambda key: key[0] == "backward")
        ends = (self.new, self.old) if solver.model.substeps % 2 else (self.old, self.new)  # as often exchanged
        key = "backward", step, batch, id(self.new)
        solver.launch_again(key, step, batch, lambda: self._substeps(step, batch))
        self.new, self.old = ends  # launches that are kept exchange nothing here
        if solver.pieces > 1:
            solver.tape(step).step = -1  # it holds the first piece now

    def _substeps(self, step: int, batch: int) -> None:
        solver, count = self.solver, self.solver.model.substeps
        solver.sorter.unsort(self.new, self.old, solver.orders[step + 1], batch)
        self.new, self.old = self.old, self.new
        length = solver.model.piece(solver.pieces)
        for first in reversed(range(0, count, length)):
            piece = range(first, min(first + length, count))
            if piece.stop < count:
                solver.substeps(step, batch, piece)
            self._substeps_back(step, batch, piece)
        for smoother in solver.smoothers:
            smoother.run_back(solver, step, batch, self.new)
        if solver.device != "cpu":
            solver.launch(self.settle, 6 * solver.model.boundary.slots, batch, [step, solver.sums, self.tools_by_axis])

    def _substeps_back(self, step: int, batch: int, substeps: range) -> None:
        solver, frames = self.solver, self.solver.frames(step)
        for s in reversed(substeps):
            solver.scatter.adjoint_g2p(step, s, frames[s], self.new, self.grid.v, self.old.x, batch)
            self._adjoint_velocity(step, s, batch)
            self._adjoint_p2g(step, s, frames[s], batch)
            self.new, self.old = self.old, self.new

    def _adjoint_velocity(self, step: int, substep: int, batch: int) -> None:
        solver = self.solver
        inputs = solver.velocity_inputs(step, substep)
        adjoints = [*self.structs, self.tools, None, self.grid.m, self.grid.v, *self.lists, None]
        how = {"adj_inputs": adjoints, "adj_outputs": [], "adjoint": True}
        solver.fold(self.grid.v, step, batch)
        solver.launch_at_nodes(solver.velocity, step, batch, inputs, **how)
        solver.unfold(self.grid.m, step, substep, batch)

    def _adjoint_p2g(self, step: int, substep: int, frame: Frame, batch: int) -> None:
        """Launch the adjoint of p2g, and those of the materials after it or as its continuation."""
        solver, tape, old, new = self.solver, self.solver.tape(step), self.old, self.new
        if not solver.columns:
            given = [tape.lattice, solver.orders[step].mass, frame.x, frame.v, tape.A[substep]]
            inputs = [*given, self.grid.m, old.x, old.v, self.A]
            solver.launch(solver.kernels.adjoint_p2g, solver.model.particles, batch, inputs)
        for b, (_, adjoint) in enumerate(solver.materials):
            law = solver.law(b, step)
            if solver.columns:
                given = [frame.particles, new.particles, old.particles, self.grid.m, tape.grids[substep].v]
                inputs = [*solver.scatter.where(step, substep), *given, law, frame.S[b], new.S[b], old.S[b]]
            else:
                inputs = [law, frame.S[b], frame.C, new.S[b], self.A, old.S[b], old.C]
            with solver.parallel_to_others(b):
                solver.launch(adjoint, solver.size(b), batch, inputs)
        solver.launches.join()


# ---- Between which corners particles are, which decides on which nodes a control step runs.

SHARES, LANES = 2048, 256  # of a GPU
WARP = 32  # threads of a GPU that find out together


@cache
@no_type_check
def extent_kernels(name: str) -> SimpleNamespace:
    """Return the kernels `look`, at particles, and `gather` what was found; of each the first has the corners.

    Of threads that are `together`, a warp of a GPU or one, one writes down what all have found.
    """
    types = precision(name)
    real, vec3, module = types.real, types.vec3, cpp.module(f"gradscape.extent.{name}")

    @cpp.func_native(called="least_of_warp")
    def least(x: vec3) -> vec3: ...

    @cpp.func_native(called="greatest_of_warp")
    def greatest(x: vec3) -> vec3: ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def look(
        x: wp.array2d[vec3],
        shares: int,
        together: int,
        low: wp.array[vec3],
        high: wp.array[vec3],
        left: wp.array[wp.int32],
    ):
        e, share = wp.tid()
        lowest, highest = vec3(real(wp.inf)), vec3(real(-wp.inf))
        for p in range(share, x.shape[1], shares):
            here = x[e, p]
            lowest, highest = wp.min(lowest, here), wp.max(highest, here)
            if not wp.isfinite(here):  # a minimum passes over what is not a number
                lowest = vec3(real(-wp.inf))
                left[e] = 1
        lowest, highest = least(lowest), greatest(highest)
        if share % together == 0:
            at = (e * shares + share) / together
            low[at] = lowest
            high[at] = highest

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def gather(
        batch: int,
        shares: int,
        low: wp.array[vec3],
        high: wp.array[vec3],
        left: wp.array[wp.int32],
        needed: wp.array[wp.int32],
        found: wp.array2d[real],
    ):
        _, lane = wp.tid()
        lowest, highest = vec3(real(wp.inf)), vec3(real(-wp.inf))
        gone, most = wp.int32(0), wp.int32(0)
        for i in range(lane, batch * shares, found.shape[0]):
            lowest, highest = wp.min(lowest, low[i]), wp.max(highest, high[i])
        for e in range(lane, batch, found.shape[0]):
            gone = wp.max(gone, left[e])
            most = wp.max(most, needed[e])
        for axis in range(3):
            found[lane, axis] = lowest[axis]
            found[lane, 3 + axis] = highest[axis]
        found[lane, 6] = real(gone)
        found[lane, 7] = real(most)

    return SimpleNamespace(look=look, gather=gather)


class Extent:
    """Find the corners of the particles of a batch, and whether one has left its box of nodes.

    Threads take one of `shares` of an environment's particles each, and one of a GPU's warp writes down what all of it
    have found; then `lanes`, few enough to be read back, take all of that. By default both are one on a CPU.
    """

    def __init__(
        self, allocator: Allocator, launches: Launches, *, shares: int | None = None, lanes: int | None = None
    ) -> None:
        model, types, device = allocator.model, allocator.types, allocator.device
        self.launches, self.device = launches, device
        self.kernels = extent_kernels(model.precision)
        load([self.kernels.look], device)
        self.shares, lanes = shares or (1 if device == "cpu" else SHARES), lanes or (1 if device == "cpu" else LANES)
        self.together = 1 if device == "cpu" else WARP
        size = allocator.capacity * self.shares // self.together
        self.low, self.high = (wp.zeros(size, dtype=types.vec3, device=device) for _ in range(2))
        self.found: wp.array = wp.zeros((lanes, 8), dtype=types.real, device=device)
        self.event: Any = None if device == "cpu" else wp.Event(device)
        self.host: wp.array = wp.zeros((lanes, 8), dtype=types.real, device="cpu", pinned=device != "cpu")

    def find(self, x: wp.array, left: wp.array, needed: wp.array, batch: int, *, small: bool) -> None:
        """Begin to find the corners of `x` [environment, particle], if any row has `left`, the most nodes one `needed`.

        A row has where a particle's coordinates are not finite, too: a loss need not tell, if it looks at others only.
        """
        self.launches.run(("extent", batch), None, lambda: self._launch(x, left, needed, batch), small=small)
        if self.device != "cpu":
            wp.record_event(self.event)

    def read(self) -> tuple[np.ndarray, np.ndarray, bool, int]:
        """Return the lowest and highest coordinates [m], not finite where a particle's are not, if one left, and nodes.

        These are the most that a row needed.
        """
        if self.device != "cpu":
            wp.synchronize_event(self.event)
        found = self.host.numpy().astype(np.float64)
        return found[:, :3].min(axis=0), found[:, 3:6].max(axis=0), bool(found[:, 6].any()), int(found[:, 7].max())

    def _launch(self, x: wp.array, left: wp.array, needed: wp.array, batch: int) -> None:
        inputs = [x, self.shares, self.together, self.low, self.high, left]
        self.launches.launch(self.kernels.look, (batch, self.shares), inputs)
        inputs = [batch, self.shares // self.together, self.low, self.high, left, needed, self.found]
        self.launches.launch(self.kernels.gather, (1, self.found.shape[0]), inputs)
        self.launches.call(partial(wp.copy, self.host, self.found))  # which holds nothing that holds the launches


CROWD = 8_000  # particles that hide what a launch costs on one core
BUSY, FULL_CARD = 400_000, 1_750_000  # particles that keep a GPU busy; more than which gain nothing
WHOLE_EPISODE = 300e6  # bytes up to which a CPU stores an episode whole
LAUNCHES = 200_000  # particles up to which launches cost a GPU more than what they launch
LEFT = 0.15, 6e9  # part of a GPU's free memory, and bytes of it, that control steps leave, whichever is less
STEPWISE = ("forward", "backward")  # launches that work on what a control step stores, whose keys name it second
GRAIN = 4  # nodes to which boxes of columns are rounded, so that the same ones come again


def capacity(model: Model, device: str) -> int:
    """Return how many environments of a model a solver should take at once."""
    if device == "cpu":
        return max(1, min(4, CROWD // model.particles))  # few enough for the cache
    release_idle()
    free, whole = free_memory() * 7 // 8, model.bytes_per_environment(model.steps, columns=True)
    fitting = free // memory(model, device)
    return max(1, min(1024, FULL_CARD // model.particles, fitting, max(free // whole, BUSY // model.particles)))


def memory(model: Model, device: str) -> int:
    """Return about how many bytes an environment takes; a GPU's spare memory is used beyond that."""
    if device != "cpu":
        return model.bytes_per_environment(1, columns=True, pieces=pieces_that_fit(model, device))
    whole = model.bytes_per_environment(model.steps)
    return whole if whole <= WHOLE_EPISODE else model.bytes_per_environment(1)


def pieces_that_fit(model: Model, device: str) -> int:
    """Return into how many pieces a control step has to be cut so that one of them fits into memory."""
    if device == "cpu":
        return 1
    free, count = free_memory() * 7 // 8, 1
    while count < model.substeps and model.bytes_per_environment(1, columns=True, pieces=count) > free:
        count += 1
    return count


class Solver:
    """Run up to `capacity` environments of one model at once, and differentiate where their control steps end.

    Setting `stop` ends a run within a control step, with InterruptedError. Every sum has one order, which depends on
    an environment's own particles only: on a GPU, or where `columns` says so, by columns of cells (`scatter`). Of a
    control step in `pieces` one is kept, by default the largest that fits; no bit depends on their number.
    """

    def __init__(
        self,
        model: Model,
        *,
        capacity: int,
        device: str,
        stop: threading.Event | None = None,
        columns: bool | None = None,
        pieces: int | None = None,
    ) -> None:
        self.model, self.capacity, self.device = model, capacity, device
        self.pieces = pieces or pieces_that_fit(model, device)
        self.stop = stop or threading.Event()
        self.columns = columns = device != "cpu" if columns is None else columns
        self.allocator = Allocator(model, capacity, device, columns=columns)
        self.types = self.allocator.types
        self.kernels = (transfers_of_columns if columns else transfers)(model.precision)
        self.velocity = velocity_on(model.precision, model.boundary, columns=columns)
        self.reflects = any(chain.from_iterable(walls_that_reflect(model)))
        self.mirrors = (mirrors_of_columns if columns else mirror_kernels)(model.precision)
        self.boundary, self.substep = model.boundary.data(model.precision, device), substep_struct(model.precision)
        self.materials = [group.material.kernels(model.precision, columns=columns) for group in model.groups]
        mirrors = vars(self.mirrors).values() if self.reflects else ()
        load([*vars(self.kernels).values(), *mirrors, self.velocity, *chain.from_iterable(self.materials)], device)
        self.first = np.concatenate([[0], np.cumsum([len(group.x) for group in model.groups])]).tolist()
        self.empty = EMPTY * float(model.mass.min())
        self.scatter: Scatter = ByColumns(self) if columns else InPlace(self)
        smooth = [b for b, group in enumerate(model.groups) if group.material.smoothing]
        self.smoothers = [(ColumnSmoother if columns else Smoother)(self, b) for b in smooth]
        self.boxes = [Box((0, 0, 0), model.nodes)] * model.steps
        self.widest: list[Box | None] = [None] * model.steps  # by columns, which holds those of all batches so far
        self.margins = [BOX_MARGIN] * model.steps  # cells around the particles, as each step has needed so far
        self.touched = [model.touched] * model.steps  # nodes of which grids hold no others, by columns, likewise
        self.most = Sizes(0, 0, 0)  # columns and segments of any step: boxes differ more than what is in them
        self.checkpoints = [self.allocator.frame() for _ in range(model.steps + 1)]
        self.orders = [Order(model, capacity, device) for _ in self.checkpoints]
        self.end = self.allocator.frame()  # of a control step, before its particles are sorted
        self.launches = Launches(device)
        self.sorter = Sorter(model, capacity, device, self.launches)
        self.extent = Extent(self.allocator, self.launches)
        whole = device == "cpu" and memory(model, device) > model.bytes_per_environment(1)
        self.tapes = [Tape(self.allocator, pieces=self.pieces) for _ in range(model.steps if whole else 1)]
        self.spare_used = device == "cpu"  # whether spare memory has been put to use
        self.tools = self.allocator.paths()
        self.sums = self.allocator.sums()
        self.listed = [] if columns else [self.allocator.array(wp.int32, model.cells + 1)]
        self.left_box, self.needed, self.escaped = (wp.zeros(capacity, dtype=wp.int32, device=device) for _ in range(3))
        self.adjoint: Adjoint | None = None
        self._start()

    def run(self, tools: torch.Tensor) -> torch.Tensor:
        """Simulate with the boundary's `tools`, shape (batch, step + 1, slot, 3); return x at their end [m]."""
        batch, steps = len(tools), tools.shape[1] - 1
        self.escaped.zero_()
        self.scatter.begin()
        to_torch(self.tools)[:batch, : steps + 1] = tools.to(self.types.torch)
        corners = self.model.corners
        for step in range(steps):
            corners = self._advance_on_box(step, batch, *corners)
        if not self.spare_used:
            self._add_tapes()
        return self.read_positions(steps, batch)

    def _add_tapes(self) -> None:
        """Store more control steps whole from the next run on, in most of a GPU's memory that is free after a first.

        The place of the first run, which has room for every step, is then that of the last steps.
        """
        self.spare_used, first, free = True, self.tapes[0], free_memory()
        spare = free - min(LEFT[0] * free, LEFT[1])
        for kept in range(self.model.steps - 1, -1, -1):
            needed = [self.room(step) for step in range(kept)]
            if sum(map(first.bytes_on, needed)) <= spare:
                break
        self.tapes = [*(Tape(self.allocator, first.room(one.nodes), self.pieces) for one in needed), first]
        self.launches.clear()

    def read_positions(self, step: int, batch: int) -> torch.Tensor:
        """Return x [m] before control step `step` of the last run, shape (batch, particle, 3)."""
        return self.orders[step].to_model(to_torch(self.checkpoints[step].x)[:batch])

    def read_trajectory(self, environment: int) -> torch.Tensor:
        """Return x [m] of one environment of the last run at the ends of control steps, (step + 1, particle, 3)."""
        rows = [self.read_positions(step, environment + 1)[environment] for step in range(len(self.checkpoints))]
        return torch.stack(rows).double().cpu()

    def read_escaped(self, batch: int) -> torch.Tensor:
        """Say for each environment whether a particle has left the grid, shape (batch,)."""
        return to_torch(self.escaped)[:batch] > 0

    def gradient(self, adj_x: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """Return the adjoint of the tools of the last run from those of x before some control steps, same shapes."""
        if self.adjoint is None:
            self.adjoint = Adjoint(self)
        return self.adjoint.run(adj_x)

    def frames(self, step: int) -> list[Frame]:
        """Return the frames of one control step, both ends included."""
        tape = self.tape(step)
        return [tape.start(self.checkpoints[step]), *tape.frames, self.end]

    def tape(self, step: int) -> Tape:
        """Return where a control step is stored whole: in the last place all that have none of their own, in turn."""
        return self.tapes[min(step, len(self.tapes) - 1)]

    def room(self, step: int) -> Sizes:
        """Return the room that a control step needs on its box, by what is known."""
        cells = self.boxes[step].cells
        return self.most._replace(nodes=min(self.touched[step], cells) if self.columns else cells)

    def set_box(self, step: int, box: Box) -> None:
        """Let a control step run on a box of nodes, and note how wide the widest is."""
        self.boxes[step] = box
        if self.columns:
            self.most = Sizes(0, max(self.most.columns, box.columns), max(self.most.segments, segments(box)))

    def _advance_on_box(
        self, step: int, batch: int, low: np.ndarray, high: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulate a control step on the nodes around the particles, or on more where one leaves them.

        Take the corners between which they are at its beginning [m], shape (3,), and return those of its end.
        """
        whole = Box((0, 0, 0), self.model.nodes)
        while True:
            box = self._place_box(step, low, high)
            self.set_box(step, box)
            self.advance(step, batch)
            self.extent.find(self.end.x, self.left_box, self.needed, batch, small=self.small(batch))
            self._sort(step, batch)  # which a GPU does while corners are read, whether or not the step holds
            *corners, left, needed = self.extent.read()
            self.touched[step] = max(self.touched[step], needed)
            if needed > self.tape(step).cells:
                continue
            if box == whole or not left:
                break
            self.margins[step] *= 2
        if left:
            to_torch(self.escaped)[:batch] += to_torch(self.left_box)[:batch]
        return corners[0], corners[1]

    def _place_box(self, step: int, low: np.ndarray, high: np.ndarray) -> Box:
        """Return the nodes for a control step whose particles begin between two corners [m], shape (3,).

        By columns it holds those of earlier batches too: launches are prepared for a box, which costs Python more than
        empty columns cost a GPU. A batch that needs the whole grid, of an exploded body perhaps, widens no later box.
        """
        if not self.columns:
            return nodes_around(self.model, low, high, self.margins[step])
        box, before = nodes_around(self.model, low, high, self.margins[step], GRAIN), self.widest[step]
        if box.nodes != self.model.nodes:
            box = self.widest[step] = box if before is None else box.around(before)
        return box

    def _sort(self, step: int, batch: int) -> None:
        """Bring the particles at a control step's end into the order of the next one."""
        orders, after = (self.orders[step], self.orders[step + 1]), self.checkpoints[step + 1]
        work = partial(self.sorter.sort, self.end, after, *orders, batch)
        self.launches.run(("sort", step, batch), None, work, small=self.small(batch))

    def advance(self, step: int, batch: int) -> None:
        """Simulate a control step on the nodes that it has been given, and keep it whole, or its last piece.

        Raises InterruptedError where `stop` has been set.
        """
        if self.stop.is_set():
            raise InterruptedError("the simulation was stopped")
        self._make_room(step)
        self.launch_again(("forward", step, batch), step, batch, lambda: self._launch_step(step, batch))

    def _launch_step(self, step: int, batch: int) -> None:
        self.launches.call(self.left_box.zero_)
        self.launches.call(self.needed.zero_)
        self.substeps(step, batch, range(self.model.substeps))

    def _make_room(self, step: int) -> None:
        """Make room for a control step, at the cost of others where memory runs out."""
        needed = self.room(step)
        while len(self.tapes) > 1 and not self._fits(self.tape(step).growth(needed)):
            self._drop_tape()
        if self.scatter.make_room(self.boxes[step]):
            self.launches.clear()
        if self.tape(step).growth(needed):
            self._forget_launches(step)
        try:
            self.tape(step).make_room(step, self.boxes[step], needed)
        except RuntimeError:  # what is free need not be of one piece
            if len(self.tapes) == 1 and (self.capacity > 1 or self.model.piece(self.pieces) == 1):
                raise
        else:
            return
        (self._drop_tape if len(self.tapes) > 1 else self._cut_smaller)()
        self._make_room(step)

    def _fits(self, growth: int) -> bool:
        """Say whether a tape can grow by so many bytes and leave a GPU as much memory as it takes.

        Torch, and Warp's sorting, want some, and of an allocation that fails Warp says so on standard error.
        """
        return self.device == "cpu" or not growth or growth <= free_memory() // 2

    def _drop_tape(self) -> None:
        """Store one control step fewer, the last that has a place of its own."""
        self._forget_launches(len(self.tapes) - 2)
        del self.tapes[-2]
        wp.synchronize_device(self.device)  # what is given back counts as free after that

    def _cut_smaller(self) -> None:
        """Keep a piece of half as many substeps, in new arrays."""
        self.pieces *= 2
        self.launches.clear()
        self.tapes.clear()
        wp.synchronize_device(self.device)
        self.tapes.append(Tape(self.allocator, pieces=self.pieces))

    def _forget_launches(self, step: int) -> None:
        """Forget the launches of all control steps that are stored where this one is, whose arrays are replaced."""
        place = self.tape(step)
        self.launches.clear(lambda key: key[0] in STEPWISE and self.tape(key[1]) is place)

    def launch_again(self, key: tuple[Any, ...], step: int, batch: int, work: Callable[[], None]) -> None:
        """Do a control step's work, by the launches kept from the last time if there was one."""
        place = self.tape(step).lattice
        self.launches.run(key, self.boxes[step], work, place=place, small=self.small(batch))

    def small(self, batch: int) -> bool:
        """Say whether so few environments do not keep a GPU busy."""
        return batch * self.model.particles <= LAUNCHES

    def substeps(self, step: int, batch: int, substeps: range) -> None:
        """Launch substeps of a control step."""
        tape, frames = self.tape(step), self.frames(step)
        for s in substeps:
            with self.launches.on_stream(1):
                self.scatter.list_particles(step, s, frames[s], batch, counted=s != substeps.start)
            if s == 0 and self.smoothers:
                self.launches.join()
                for smoother in self.smoothers:
                    smoother.run(self, step, batch)
            self._update(step, frames[s], frames[s + 1], tape.A[s], batch)
            self.launches.join()
            self._fill_grid(frames[s], step, s, batch)
            self._move_particles(frames[s], frames[s + 1], step, s, batch, followed=s + 1 in substeps)

    def _update(self, step: int, frame: Frame, new: Frame, A: wp.array, batch: int) -> None:
        for b, (update, _) in enumerate(self.materials):
            with self.parallel_to_others(b):
                self.launch(update, self.size(b), batch, [self.law(b, step), frame.S[b], frame.C, new.S[b], A])

    def _fill_grid(self, frame: Frame, step: int, substep: int, batch: int) -> None:
        """Fill the substep's grid: momentum and mass from particles, then velocity."""
        self.scatter.p2g(step, substep, frame, batch)
        grid = self.tape(step).grids[substep]
        self.fold(grid.m, step, batch)
        self.launch_at_nodes(self.velocity, step, batch, self.velocity_inputs(step, substep))
        self.unfold(grid.v, step, substep, batch)

    def fold(self, grid: wp.array, step: int, batch: int) -> None:
        """Add what nodes beyond walls that reflect hold to their images; by columns, nodes that add up do so."""
        if self.reflects and not self.columns:
            self.launch(self.mirrors.fold, 1, batch, [self.tape(step).lattice, grid])

    def unfold(self, grid: wp.array, step: int, substep: int, batch: int) -> None:
        """Give nodes beyond walls that reflect the image of what those before them hold."""
        if self.reflects and self.columns:
            inputs = [self.tape(step).lattice, self.tape(step).lists[substep], grid]
            self.launch_at_nodes(self.mirrors.unfold, step, batch, inputs)
        elif self.reflects:
            self.launch(self.mirrors.unfold, 1, batch, [self.tape(step).lattice, grid])

    def _move_particles(self, frame: Frame, new: Frame, step: int, substep: int, batch: int, *, followed: bool) -> None:
        grid_v, where = self.tape(step).grids[substep].v, self.scatter.where(step, substep)
        moved = [new.particles] if self.columns else [new.x, new.v, new.C]
        inputs = [*where, self.model.dt, frame.x, grid_v, *moved, self.left_box, *self.scatter.counting(followed)]
        self.launch(self.kernels.g2p, self.model.particles, batch, inputs)

    def law(self, b: int, step: int) -> Any:
        """Return what both kernels of a group's material share."""
        model, order = self.model, self.orders[step]
        law = model.groups[b].material.law(model.precision)
        law.first, law.dt, law.scale = self.first[b], model.dt, -model.dt * 4.0 / model.dx**2
        law.mass, law.volume = order.mass, order.volume
        return law

    def velocity_inputs(self, step: int, substep: int) -> list[Any]:
        """Return the arguments of the grid's velocity kernel."""
        model, tape, now = self.model, self.tape(step), self.substep()
        now.dt, now.gravity, now.empty = model.dt, model.gravity, self.empty
        now.step, now.fraction, now.rate = step, substep / model.substeps, 1.0 / (model.substeps * model.dt)
        grid, summed = tape.grids[substep], self.scatter.to_add_up(step, substep)
        return [tape.lattice, self.boundary, now, self.tools, self.sums, grid.m, grid.v, *summed, *self.listed]

    def parallel_to_others(self, b: int) -> AbstractContextManager[None]:
        """Let a GPU run what is launched for a body parallel to what is for the others, up to the next join."""
        return self.launches.on_stream(2 + b) if b < len(self.materials) - 1 else nullcontext()

    def size(self, b: int) -> int:
        """Return the number of particles of group b."""
        return len(self.model.groups[b].x)

    def launch(self, kernel: Any, size: int, batch: int, inputs: list[Any]) -> None:
        """Launch a kernel over [environment, element], or over environments where it takes their rows."""
        self.launches.launch(kernel, (batch, threads(kernel, size)), inputs)

    def launch_at_nodes(self, kernel: Any, step: int, batch: int, inputs: list[Any], **how: Any) -> None:
        """Launch a kernel over [environment, node] of the grids of a control step."""
        if self.columns:
            self.launches.launch(kernel, (batch, self.tape(step).cells), inputs, **how)
        else:
            self.launch_on_box(kernel, nodes, batch, inputs, **how)

    def launch_on_box(self, kernel: Any, size: Callable[[Box], int], batch: int, inputs: list[Any], **how: Any) -> None:
        """Launch a kernel over [environment, whatever `size` counts of the box of the control step under way]."""
        self.launches.launch(kernel, lambda box: (batch, threads(kernel, size(box))), inputs, **how)

    def _start(self) -> None:
        first = self.checkpoints[0]
        to_torch(first.x)[:] = torch.from_numpy(np.concatenate([body.x for body in self.model.bodies]))
        for group, state in zip(self.model.groups, first.S, strict=True):
            to_torch(state)[:] = to_rows(torch.from_numpy(group.material.initial(group.ratio)), self.device)
