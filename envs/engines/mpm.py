"""MLS-MPM (Hu et al. 2018) for a batch of environments, with gradients recomputed from control-step checkpoints.

One substep, state (x, v, C, S) of frame s to frame s + 1, S being each material's own state:

    update  S'   = deform(S, C), A = -dt V 4/dx^2 tau(S', C) + m C
    p2g     m_i  = sum w m,   q_i = sum w (m v + A (x_i - x))
    grid    v_i  = boundary(q_i / m_i + dt g)
    g2p     v'   = sum w v_i, C' = 4/dx^2 sum w v_i (x_i - x)^T, x' = x + dt v'

Particles are kept at the ends of control steps; as many of the last control steps as fit are kept whole, with A and
grids of every substep (on a CPU all or one). The gradient recomputes the others, one at a time.
"""

import threading
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import torch
import warp as wp

from .graphs import Replay
from .grid import velocity_kernel
from .model import MARGIN, Box, Model, around, place
from .runtime import free_memory, load, precision, to_torch
from .transfers import transfers

EMPTY = 1e-8  # nodes lighter than this part of the lightest particle carry no velocity


@dataclass(frozen=True, eq=False)
class Frame:
    """The state of a batch at one instant, or its adjoint: arrays [environment, particle]."""

    x: wp.array
    v: wp.array
    C: wp.array
    S: tuple[wp.array, ...]

    def arrays(self) -> tuple[wp.array, ...]:
        """Return every array of the frame."""
        return (self.x, self.v, self.C, *self.S)


@dataclass(frozen=True, eq=False)
class Grid:
    """What nodes hold in one substep, [environment, node]: momentum and mass, then velocity; or the adjoints."""

    m: wp.array
    v: wp.array


CROWD, FULL_CARD = 8_000, 1_000_000  # particles that hide what a launch costs on one core, that keep a GPU busy
KEPT = 192e6  # bytes up to which a CPU keeps an episode whole
LAUNCHES = 200_000  # particles up to which launches cost a GPU more than what they launch
GRAIN = 4  # nodes to which a GPU's boxes are rounded, so that the same ones come again
LANES = 32  # copies of the tools on a GPU, so that fewer nodes wait for each other to add to the same adjoint


def capacity(model: Model, device: str) -> int:
    """Return how many environments of a model a solver should take at once."""
    if device == "cpu":
        return max(1, min(4, CROWD // model.particles))  # few enough for the cache
    fitting = free_memory() * 3 // 4 // memory(model, device)
    return max(1, min(1024, FULL_CARD // model.particles, fitting))


def memory(model: Model, device: str) -> int:
    """Return about how many bytes an environment takes; a GPU's spare memory is used beyond that."""
    whole = model.bytes_per_environment(model.steps)
    return whole if device == "cpu" and whole <= KEPT else model.bytes_per_environment(1)


class Solver:
    """Run up to `capacity` environments of one model at once, and differentiate where their control steps end.

    Setting `stop` ends a run within a control step, with InterruptedError.
    """

    def __init__(self, model: Model, *, capacity: int, device: str, stop: threading.Event | None = None) -> None:
        self.model, self.capacity, self.device = model, capacity, device
        self.stop = stop or threading.Event()
        self.types = precision(model.precision)
        self.kernels = transfers(model.precision)
        self.velocity = velocity_kernel(model.precision, *model.boundary.function(model.precision))
        self.boundary = model.boundary.data(model.precision, device)
        self.materials = [body.material.kernels(model.precision) for body in model.bodies]
        transferring = [self.kernels.p2g, self.kernels.g2p, self.kernels.adjoint_p2g, self.kernels.adjoint_g2p]
        load([*transferring, self.velocity, *chain.from_iterable(self.materials)], device)
        self.first = np.concatenate([[0], np.cumsum([len(body.x) for body in model.bodies])]).tolist()
        self.mass = self._constant(model.mass)
        self.volume = self._constant(np.concatenate([body.volume for body in model.bodies]))
        self.empty = EMPTY * float(model.mass.min())
        self.boxes = [Box((0, 0, 0), model.nodes)] * model.steps
        self.checkpoints = [self.frame() for _ in range(model.steps + 1)]
        self.replay = Replay(device)
        whole = device == "cpu" and memory(model, device) > model.bytes_per_environment(1)
        self.windows = [_Window(self) for _ in range(model.steps if whole else 1)]
        self.spacious = device == "cpu"  # whether spare memory has been put to use
        self.lanes = 1 if device == "cpu" else LANES
        self.tools = self.paths()
        self.strayed, self.escaped = (wp.zeros(capacity, dtype=wp.int32, device=device) for _ in range(2))
        self.adjoint: _Adjoint | None = None
        self._start()

    def run(self, tools: torch.Tensor) -> torch.Tensor:
        """Simulate with the boundary's `tools`, shape (batch, step + 1, slot, 3); return x at the end [m]."""
        batch = len(tools)
        self.escaped.zero_()
        self.by_lane(self.tools)[:batch] = tools[:, None].to(self.types.torch)
        for step in range(self.model.steps):
            self._explore(step, batch)
        if not self.spacious:
            self._keep_more()
        return self.reached(self.model.steps, batch)

    def _keep_more(self) -> None:
        """Keep more control steps whole from the next run on, in half of a GPU's memory that is free after a first."""
        self.spacious = True
        more = min(self.model.steps - 1, free_memory() // 2 // self.windows[0].bytes)
        cells = self.windows[0].grids[0].m.shape[1]
        self.windows += [_Window(self, cells) for _ in range(more)]
        self.windows[0].step = -1  # it keeps other steps now
        self.replay.forget()

    def reached(self, step: int, batch: int) -> torch.Tensor:
        """Return x [m] before control step `step` of the last run, shape (batch, particle, 3)."""
        return to_torch(self.checkpoints[step].x)[:batch]

    def positions(self, environment: int) -> torch.Tensor:
        """Return x [m] of one environment of the last run at the ends of control steps, (step + 1, particle, 3)."""
        return torch.stack([to_torch(frame.x)[environment] for frame in self.checkpoints]).double().cpu()

    def left_grid(self, batch: int) -> torch.Tensor:
        """Say for each environment whether a particle has left the grid, shape (batch,)."""
        return to_torch(self.escaped)[:batch] > 0

    def gradient(self, adj_x: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """Return the adjoint of the tools of the last run from those of x before some control steps, same shapes."""
        if self.adjoint is None:
            self.adjoint = _Adjoint(self)
        return self.adjoint.run(adj_x)

    def frames(self, step: int) -> list[Frame]:
        """Return the frames of one control step, both ends included."""
        return [self.checkpoints[step], *self.window(step).frames, self.checkpoints[step + 1]]

    def window(self, step: int) -> "_Window":
        """Return where a control step is kept whole, or another one at the moment."""
        return self.windows[step % len(self.windows)]

    def _explore(self, step: int, batch: int) -> None:
        """Simulate a control step on the nodes around the particles, or on more where one leaves them."""
        margin, whole = MARGIN, Box((0, 0, 0), self.model.nodes)
        while True:
            grain = 1 if self.device == "cpu" else GRAIN
            self.boxes[step] = around(self.model, self.reached(step, batch), margin, grain)
            self.strayed.zero_()
            self._advance(step, batch)
            margin *= 2
            if self.boxes[step] == whole or not bool(to_torch(self.strayed)[:batch].any()):
                break
        to_torch(self.escaped)[:batch] += to_torch(self.strayed)[:batch]

    def _advance(self, step: int, batch: int) -> None:
        if self.stop.is_set():
            raise InterruptedError("the simulation was stopped")
        self.window(step).hold(step, self)
        self.launches(("forward", step, batch), batch, lambda: self._substeps(step, batch))

    def launches(self, key: tuple[Any, ...], batch: int, work: Callable[[], None]) -> None:
        """Launch a control step's work, where launching is what it costs as one graph."""
        if batch * self.model.particles > LAUNCHES:
            work()
        else:
            self.replay((*key, self.boxes[key[1]]), work)

    def _substeps(self, step: int, batch: int) -> None:
        window, frames = self.window(step), self.frames(step)
        for s in range(self.model.substeps):
            self._update(frames[s], frames[s + 1], window.A[s], batch)
            self._scatter(frames[s], step, s, batch)
            self._gather(frames[s], frames[s + 1], step, s, batch)

    def _update(self, frame: Frame, new: Frame, A: wp.array, batch: int) -> None:
        for b, (update, _) in enumerate(self.materials):
            self.launch(update, self.size(b), batch, [*self.material_inputs(b, frame), new.S[b], A])

    def _scatter(self, frame: Frame, step: int, substep: int, batch: int) -> None:
        """Fill the substep's grid: momentum and mass from particles, then velocity."""
        window = self.window(step)
        self.clear(window.grids[substep].m, step, batch)
        inputs = [window.lattice, self.mass, frame.x, frame.v, window.A[substep], window.grids[substep].m]
        self.launch(self.kernels.p2g, self.model.particles, batch, inputs)
        self.launch(self.velocity, self.boxes[step].cells, batch, self.velocity_inputs(step, substep))

    def clear(self, grid: wp.array, step: int, batch: int) -> None:
        """Zero what a control step uses of a grid."""
        if self.device == "cpu":  # where numpy is quicker, and torch would spread it over threads that others want
            grid.numpy()[:batch, : self.boxes[step].cells] = 0.0
        else:
            self.launch(self.kernels.wipe, self.boxes[step].cells, batch, [grid])

    def _gather(self, frame: Frame, new: Frame, step: int, substep: int, batch: int) -> None:
        window = self.window(step)
        grid_v = window.grids[substep].v
        inputs = [window.lattice, self.model.dt, frame.x, grid_v, new.x, new.v, new.C, self.strayed]
        self.launch(self.kernels.g2p, self.model.particles, batch, inputs)

    def material_inputs(self, b: int, frame: Frame) -> list[Any]:
        """Return what both kernels of a material take."""
        dt, scale = self.model.dt, -self.model.dt * 4.0 / self.model.dx**2
        constants = self.model.bodies[b].material.constants()
        return [self.first[b], dt, scale, *constants, self.mass, self.volume, frame.S[b], frame.C]

    def velocity_inputs(self, step: int, substep: int) -> list[Any]:
        """Return the arguments of the grid's velocity kernel."""
        model, window = self.model, self.window(step)
        time = [self.lanes, step, substep / model.substeps, 1.0 / (model.substeps * model.dt)]
        grid = window.grids[substep]
        return [
            window.lattice,
            self.boundary,
            model.dt,
            model.gravity,
            self.empty,
            *time,
            self.tools,
            self.tools,
            grid.m,
            grid.v,
        ]

    def size(self, b: int) -> int:
        """Return the number of particles of body b."""
        return len(self.model.bodies[b].x)

    def launch(self, kernel: Any, size: int, batch: int, inputs: list[Any]) -> None:
        """Launch a kernel over [environment, element]."""
        wp.launch(kernel, (batch, size), inputs, device=self.device, record_tape=False)

    def array(self, dtype: Any, size: int) -> wp.array:
        """Return zeros [environment, element]."""
        return wp.zeros((self.capacity, size), dtype=dtype, device=self.device)

    def frame(self) -> Frame:
        """Return a frame of zeros."""
        types, count = self.types, self.model.particles
        x, v, C = (self.array(kind, count) for kind in (types.vec3, types.vec3, types.mat33))
        states = (self.array(b.material.state(self.model.precision), len(b.x)) for b in self.model.bodies)
        return Frame(x, v, C, tuple(states))

    def grid(self, cells: int) -> Grid:
        """Return a grid of zeros."""
        return Grid(*(self.array(self.types.vec4, cells) for _ in range(2)))

    def paths(self) -> wp.array:
        """Return zeros [environment and lane, step, slot]."""
        shape = self.capacity * self.lanes, self.model.steps + 1, self.model.boundary.slots
        return wp.zeros(shape, dtype=self.types.vec3, device=self.device)

    def by_lane(self, paths: wp.array) -> torch.Tensor:
        """View paths as [environment, lane, step, slot, axis]."""
        view = to_torch(paths)
        return view.view(self.capacity, self.lanes, *view.shape[1:])

    def _constant(self, values: np.ndarray) -> wp.array:
        return wp.array(values, dtype=self.types.real, device=self.device)

    def _start(self) -> None:
        first = self.checkpoints[0]
        to_torch(first.x)[:] = torch.from_numpy(np.concatenate([body.x for body in self.model.bodies]))
        for body, state in zip(self.model.bodies, first.S, strict=True):
            to_torch(state)[:] = torch.from_numpy(body.material.initial(body.ratio))


class _Window:
    """Hold one control step whole: frames between its ends, A and grids of its substeps, and where the grids lie."""

    def __init__(self, solver: Solver, cells: int = 1) -> None:
        model = solver.model
        self.step = -1
        self.frames = [solver.frame() for _ in range(model.substeps - 1)]
        self.A = [solver.array(solver.types.mat33, model.particles) for _ in range(model.substeps)]
        self.grids = [solver.grid(cells) for _ in range(model.substeps)]
        self.lattice = place(model)

    @property
    def bytes(self) -> int:
        """What its arrays take."""
        grids = [array for grid in self.grids for array in (grid.m, grid.v)]
        frames = [array for frame in self.frames for array in frame.arrays()]
        return sum(array.capacity for array in (*frames, *self.A, *grids))

    def hold(self, step: int, solver: Solver) -> None:
        """Make room for a control step."""
        self.step, self.lattice = step, place(solver.model, solver.boxes[step])
        cells = solver.boxes[step].cells
        if self.grids[0].m.shape[1] < cells:
            self.grids = [solver.grid(min(cells * 5 // 4, solver.model.cells)) for _ in self.grids]
            solver.replay.forget()


class _Adjoint:
    """Hold the adjoint arrays of a solver and run its backward pass."""

    def __init__(self, solver: Solver) -> None:
        self.solver = weakref.proxy(solver)  # which holds this: a cycle would keep a GPU's memory until it is collected
        self.new, self.old = solver.frame(), solver.frame()
        self.A = solver.array(solver.types.mat33, solver.model.particles)
        self.grid = solver.grid(max(box.cells for box in solver.boxes))
        self.tools = solver.paths()
        self.structs = solver.kernels.Lattice(), type(solver.boundary)()  # unwanted adjoints, whose place Warp wants

    def run(self, adj_x: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """Return the adjoint of the tools, shape (batch, step + 1, slot, 3)."""
        solver, batch = self.solver, len(next(iter(adj_x.values())))
        for array in (*self.new.arrays(), self.tools):
            array.zero_()
        for step in reversed(range(max(adj_x))):
            if step + 1 in adj_x:
                to_torch(self.new.x)[:batch] += adj_x[step + 1].to(to_torch(self.new.x))
            if solver.window(step).step != step:
                solver._advance(step, batch)
            self._retreat(step, batch)
        by_lane: torch.Tensor = solver.by_lane(self.tools)[:batch]
        return by_lane.sum(dim=1)

    def _retreat(self, step: int, batch: int) -> None:
        solver = self.solver
        if self.grid.m.shape[1] < solver.boxes[step].cells:
            self.grid = solver.grid(solver.boxes[step].cells)
            solver.replay.forget()
        ends = (self.old, self.new) if solver.model.substeps % 2 else (self.new, self.old)
        key = "backward", step, batch, id(self.new)
        solver.launches(key, batch, lambda: self._substeps(step, batch))
        self.new, self.old = ends  # a replayed graph exchanges nothing here

    def _substeps(self, step: int, batch: int) -> None:
        solver = self.solver
        window, frames = solver.window(step), solver.frames(step)
        for s in reversed(range(solver.model.substeps)):
            solver.clear(self.grid.v, step, batch)
            self._gather(frames[s], window, s, batch)
            solver.clear(self.grid.m, step, batch)
            self._velocity(step, s, batch)
            self._scatter(frames[s], window, s, batch)
            self._update(frames[s], batch)
            self.new, self.old = self.old, self.new

    def _gather(self, frame: Frame, window: _Window, substep: int, batch: int) -> None:
        solver = self.solver
        inputs = [window.lattice, solver.model.dt, frame.x, window.grids[substep].v]
        inputs += [self.new.x, self.new.v, self.new.C, self.grid.v, self.old.x]
        solver.launch(solver.kernels.adjoint_g2p, solver.model.particles, batch, inputs)

    def _velocity(self, step: int, substep: int, batch: int) -> None:
        solver = self.solver
        inputs = solver.velocity_inputs(step, substep)
        adjoints = [*self.structs, *[None] * (len(inputs) - 6), self.tools, None, self.grid.m, self.grid.v]
        self._launch(solver.velocity, solver.boxes[step].cells, batch, inputs, adjoints)

    def _scatter(self, frame: Frame, window: _Window, substep: int, batch: int) -> None:
        solver = self.solver
        inputs = [window.lattice, solver.mass, frame.x, frame.v, window.A[substep], self.grid.m]
        inputs += [self.old.x, self.old.v, self.A]
        solver.launch(solver.kernels.adjoint_p2g, solver.model.particles, batch, inputs)

    def _update(self, frame: Frame, batch: int) -> None:
        solver = self.solver
        for b, (_, adjoint) in enumerate(solver.materials):
            inputs = [*solver.material_inputs(b, frame), self.new.S[b], self.A, self.old.S[b], self.old.C]
            solver.launch(adjoint, solver.size(b), batch, inputs)

    def _launch(self, kernel: Any, size: int, batch: int, inputs: list[Any], adjoints: list[Any]) -> None:
        wp.launch(
            kernel,
            (batch, size),
            inputs,
            adj_inputs=adjoints,
            adj_outputs=[],
            device=self.solver.device,
            adjoint=True,
            record_tape=False,
        )
