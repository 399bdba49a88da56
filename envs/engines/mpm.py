"""MLS-MPM (Hu et al. 2018) for a batch of environments, with gradients recomputed from control-step checkpoints.

One substep, state (x, v, C, S) of frame s to frame s + 1, S being each material's own state:

    update  S'   = deform(S, C), A = -dt V 4/dx^2 tau(S', C) + m C
    p2g     m_i  = sum w m,   q_i = sum w (m v + A (x_i - x))
    grid    v_i  = boundary(q_i / m_i + dt g)
    g2p     v'   = sum w v_i, C' = 4/dx^2 sum w v_i (x_i - x)^T, x' = x + dt v'

Particles are kept at the ends of control steps only. The gradient recomputes one control step at a time, and keeps that
one whole: particles, A, and the grids too unless they are large.
"""

import threading
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import chain
from typing import Any, no_type_check

import numpy as np
import torch
import warp as wp

from .model import Box, Model, around, place
from .runtime import free_memory, load, precision, to_torch
from .transfers import transfers

MARGIN = 2  # cells around the particles that a control step begins with
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


CROWD, FULL_CARD = 8_000, 2_000_000  # particles that hide what a launch costs on one core, that keep a GPU busy


def capacity(model: Model, device: str) -> int:
    """Return how many environments of a model a solver should take at once."""
    if device == "cpu":
        return max(1, min(4, CROWD // model.particles))  # few enough for the cache
    fitting = free_memory() * 3 // 4 // model.bytes_per_environment()
    return max(1, min(1024, FULL_CARD // model.particles, fitting))


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
        self.checkpoints = [self._frame() for _ in range(model.steps + 1)]
        self.window = [self._frame() for _ in range(model.substeps - 1)]
        self.A = [self._array(self.types.mat33, model.particles) for _ in range(model.substeps)]
        self.grids = [self._grid() for _ in range(model.substeps if model.keeps_grids else 1)]
        self.tools = self._tools()
        self.strayed, self.escaped = (wp.zeros(capacity, dtype=wp.int32, device=device) for _ in range(2))
        self.held = -1  # the control step whose frames and grids are in the window
        self.adjoint: _Adjoint | None = None
        self._start()

    def run(self, tools: torch.Tensor) -> torch.Tensor:
        """Simulate with the boundary's `tools`, shape (batch, step + 1, slot, 3); return x at the end [m]."""
        batch = len(tools)
        self.escaped.zero_()
        to_torch(self.tools)[:batch] = tools.to(self.types.torch)
        for step in range(self.model.steps):
            self._explore(step, batch)
        return self.reached(self.model.steps, batch)

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
        return [self.checkpoints[step], *self.window, self.checkpoints[step + 1]]

    def _explore(self, step: int, batch: int) -> None:
        """Simulate a control step on the nodes around the particles, or on more where one leaves them."""
        margin, whole = MARGIN, Box((0, 0, 0), self.model.nodes)
        while True:
            self.boxes[step] = around(self.model, self.reached(step, batch), margin)
            self.strayed.zero_()
            self._advance(step, batch)
            margin *= 2
            if self.boxes[step] == whole or not bool(to_torch(self.strayed)[:batch].any()):
                break
        to_torch(self.escaped)[:batch] += to_torch(self.strayed)[:batch]

    def _advance(self, step: int, batch: int) -> None:
        if self.stop.is_set():
            raise InterruptedError("the simulation was stopped")
        self.held, self.lattice = step, place(self.model, self.boxes[step])
        frames = self.frames(step)
        for s in range(self.model.substeps):
            self._update(frames[s], frames[s + 1], self.A[s], batch)
            self.scatter(frames[s], step, s, batch)
            self._gather(frames[s], frames[s + 1], self.grid(s), batch)

    def grid(self, substep: int) -> Grid:
        """Return the grid of a substep of the control step in the window, or the one that all share."""
        return self.grids[substep % len(self.grids)]

    def _update(self, frame: Frame, new: Frame, A: wp.array, batch: int) -> None:
        for b, (update, _) in enumerate(self.materials):
            self.launch(update, self.size(b), batch, [*self.material_inputs(b, frame), new.S[b], A])

    def scatter(self, frame: Frame, step: int, substep: int, batch: int) -> None:
        """Fill the substep's grid: momentum and mass from particles, then velocity."""
        grid = self.grid(substep)
        self.clear(grid.m, step, batch)
        inputs = [self.lattice, self.mass, frame.x, frame.v, self.A[substep], grid.m]
        self.launch(self.kernels.p2g, self.model.particles, batch, inputs)
        self.launch(self.velocity, self.boxes[step].cells, batch, self.velocity_inputs(step, substep))

    def clear(self, grid: wp.array, step: int, batch: int) -> None:
        """Zero what a control step uses of a grid."""
        to_torch(grid)[:batch, : self.boxes[step].cells].zero_()

    def _gather(self, frame: Frame, new: Frame, grid: Grid, batch: int) -> None:
        inputs = [self.lattice, self.model.dt, frame.x, grid.v, new.x, new.v, new.C, self.strayed]
        self.launch(self.kernels.g2p, self.model.particles, batch, inputs)

    def material_inputs(self, b: int, frame: Frame) -> list[Any]:
        """Return what both kernels of a material take."""
        dt, scale = self.model.dt, -self.model.dt * 4.0 / self.model.dx**2
        constants = self.model.bodies[b].material.constants()
        return [self.first[b], dt, scale, *constants, self.mass, self.volume, frame.S[b], frame.C]

    def velocity_inputs(self, step: int, substep: int) -> list[Any]:
        """Return the arguments of the grid's velocity kernel."""
        model = self.model
        time = [step, substep / model.substeps, 1.0 / (model.substeps * model.dt)]
        grid = self.grid(substep)
        return [self.lattice, self.boundary, model.dt, model.gravity, self.empty, *time, self.tools, grid.m, grid.v]

    def size(self, b: int) -> int:
        """Return the number of particles of body b."""
        return len(self.model.bodies[b].x)

    def launch(self, kernel: Any, size: int, batch: int, inputs: list[Any]) -> None:
        """Launch a kernel over [environment, element]."""
        wp.launch(kernel, (batch, size), inputs, device=self.device, record_tape=False)

    def _array(self, dtype: Any, size: int) -> wp.array:
        return wp.zeros((self.capacity, size), dtype=dtype, device=self.device)

    def _frame(self) -> Frame:
        types, count = self.types, self.model.particles
        x, v, C = (self._array(kind, count) for kind in (types.vec3, types.vec3, types.mat33))
        states = (self._array(b.material.state(self.model.precision), len(b.x)) for b in self.model.bodies)
        return Frame(x, v, C, tuple(states))

    def _grid(self) -> Grid:
        return Grid(*(self._array(self.types.vec4, self.model.cells) for _ in range(2)))

    def _tools(self) -> wp.array:
        shape = self.capacity, self.model.steps + 1, self.model.boundary.slots
        return wp.zeros(shape, dtype=self.types.vec3, device=self.device)

    def _constant(self, values: np.ndarray) -> wp.array:
        return wp.array(values, dtype=self.types.real, device=self.device)

    def _start(self) -> None:
        first = self.checkpoints[0]
        to_torch(first.x)[:] = torch.from_numpy(np.concatenate([body.x for body in self.model.bodies]))
        for body, state in zip(self.model.bodies, first.S, strict=True):
            to_torch(state)[:] = torch.from_numpy(body.material.initial(body.ratio))


class _Adjoint:
    """Hold the adjoint arrays of a solver and run its backward pass."""

    def __init__(self, solver: Solver) -> None:
        self.solver = weakref.proxy(solver)  # which holds this: a cycle would keep a GPU's memory until it is collected
        self.new, self.old = solver._frame(), solver._frame()
        self.A = wp.zeros_like(solver.A[0])
        self.grid = solver._grid()
        self.tools = solver._tools()
        self.structs = solver.kernels.Lattice(), type(solver.boundary)()  # unwanted adjoints, whose place Warp wants

    def run(self, adj_x: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """Return the adjoint of the tools, shape (batch, step + 1, slot, 3)."""
        solver, batch = self.solver, len(next(iter(adj_x.values())))
        for array in (*self.new.arrays(), self.tools):
            array.zero_()
        for step in reversed(range(max(adj_x))):
            if step + 1 in adj_x:
                to_torch(self.new.x)[:batch] += adj_x[step + 1].to(to_torch(self.new.x))
            if solver.held != step:
                solver._advance(step, batch)
            self._retreat(step, batch)
        return to_torch(self.tools)[:batch].clone()

    def _retreat(self, step: int, batch: int) -> None:
        solver = self.solver
        frames = solver.frames(step)
        for s in reversed(range(solver.model.substeps)):
            if not solver.model.keeps_grids:
                solver.scatter(frames[s], step, s, batch)
            solver.clear(self.grid.v, step, batch)
            self._gather(frames[s], solver.grid(s), batch)
            solver.clear(self.grid.m, step, batch)
            self._velocity(step, s, batch)
            self._scatter(frames[s], solver.A[s], batch)
            self._update(frames[s], batch)
            self.new, self.old = self.old, self.new

    def _gather(self, frame: Frame, grid: Grid, batch: int) -> None:
        solver = self.solver
        inputs = [solver.lattice, solver.model.dt, frame.x, grid.v]
        inputs += [self.new.x, self.new.v, self.new.C, self.grid.v, self.old.x]
        solver.launch(solver.kernels.adjoint_g2p, solver.model.particles, batch, inputs)

    def _velocity(self, step: int, substep: int, batch: int) -> None:
        solver = self.solver
        inputs = solver.velocity_inputs(step, substep)
        adjoints = [*self.structs, *[None] * (len(inputs) - 5), self.tools, self.grid.m, self.grid.v]
        self._launch(solver.velocity, solver.boxes[step].cells, batch, inputs, adjoints)

    def _scatter(self, frame: Frame, A: wp.array, batch: int) -> None:
        solver = self.solver
        inputs = [solver.lattice, solver.mass, frame.x, frame.v, A, self.grid.m]
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


@cache
@no_type_check
def velocity_kernel(name: str, meet: Any, Data: Any) -> Any:
    """Return the kernel that turns a node's momentum into its velocity after gravity and boundary."""
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    Lattice = transfers(name).Lattice

    @wp.kernel(module="unique")
    def velocity(
        lattice: Lattice,
        boundary: Data,
        dt: real,
        gravity: real,
        empty: real,
        step: int,
        fraction: real,
        rate: real,
        tools: wp.array3d[vec3],
        grid_m: wp.array2d[vec4],
        grid_v: wp.array2d[vec4],
    ):
        e, i = wp.tid()
        g = grid_m[e, i]
        if g[3] > empty:
            first = lattice.first
            k = i % lattice.nz
            j = (i / lattice.nz) % lattice.ny
            node = vec3(real(i / (lattice.nz * lattice.ny) + first[0]), real(j + first[1]), real(k + first[2]))
            p = lattice.origin + node * (real(1.0) / lattice.inv_dx)
            v = vec3(g[0], g[1], g[2]) / g[3] - vec3(real(0.0), dt * gravity, real(0.0))
            v = meet(boundary, p, v, e, tools, step, fraction, rate)
            grid_v[e, i] = vec4(v[0], v[1], v[2], real(0.0))
        else:
            grid_v[e, i] = vec4()

    return velocity
