"""MLS-MPM (Hu et al. 2018) in Taichi, as DiffTaichi (Hu et al. 2020) writes it: the reference for the Warp engine.

One kernel per equation, time index first, gradients by the compiler. Substep s takes (x, v, C, S)[s] to s + 1:

    update    S' = deform(S, C), A = -dt V 4/dx^2 tau(S', C) + m C          (each material's own)
    p2g       m_i = sum w m, q_i = sum w (m v + A (x_i - x))
    grid_op   v_i = boundary(q_i / m_i + dt g) where there is mass
    g2p       v' = sum w v_i, C' = 4/dx^2 sum w v_i (x_i - x)^T
    move      x' = x + dt v'

Before a control step a fluid's volume ratios are smoothed, by torch.

Arrays are torch's, [substep, environment, particle] or [environment, node], and kernels work on their memory. Particles
are kept at the ends of control steps, and for all substeps of one: the backward pass simulates each control step once
more, and fills its one grid anew for each substep. Threads add in any order, so the last digits of results may differ.
"""

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any, no_type_check

import numpy as np
import torch

from ....landscapes.threads import one_torch_thread
from ...batching import copied
from ..mpm.model import EMPTY, Model
from ..mpm.smoothing import smooth_volume_ratios
from ..runtime import precision
from .boundaries import boundary_contact
from .materials import kernels, types
from .runtime import start, ti


@dataclass(frozen=True, eq=False)
class States:
    """States over time: x, v, C and each body's own S, [time, environment, particle]."""

    x: torch.Tensor
    v: torch.Tensor
    C: torch.Tensor
    S: tuple[torch.Tensor, ...]

    def arrays(self) -> tuple[torch.Tensor, ...]:
        """Return every array."""
        return (self.x, self.v, self.C, *self.S)


@dataclass(frozen=True, eq=False)
class Grid:
    """What nodes hold in one substep, [environment, i, j, k]: momentum, mass, velocity."""

    q: torch.Tensor
    m: torch.Tensor
    v: torch.Tensor

    def arrays(self) -> tuple[torch.Tensor, ...]:
        """Return every array."""
        return (self.q, self.m, self.v)


class Solver:
    """Run up to `capacity` environments of one model at once, and differentiate where their control steps end.

    Setting `stop` ends a run within a control step, with InterruptedError. One solver at a time: Taichi has one thread.
    """

    def __init__(self, model: Model, *, capacity: int, device: str, stop: threading.Event | None = None) -> None:
        start(device)
        self.model, self.capacity, self.device = model, capacity, device
        self.stop = stop or threading.Event()
        self.dtype = precision(model.precision).torch
        self.transfers = transfers(model.precision)
        boundary: Any = model.boundary
        self.grid_op = grid_kernel(model.precision, boundary_contact(boundary, model.precision))
        self.materials = [kernels(body.material, model.precision) for body in model.bodies]
        self.first = np.cumsum([0, *(len(body.x) for body in model.bodies)]).tolist()
        self.mass = self._constant(model.mass)
        self.volume = self._constant(np.concatenate([body.volume for body in model.bodies]))
        self.origin = ti.Vector(model.origin)
        self.empty = EMPTY * float(model.mass.min())
        self.smooth = [b for b, body in enumerate(model.bodies) if body.material.smoothing]
        self.checkpoints = self._states(model.steps + 1)
        self.tape = self._states(model.substeps + 1)
        self.A = self._zeros(model.substeps, capacity, model.particles, 3, 3)
        nodes = capacity, *model.nodes
        self.grid = Grid(self._zeros(*nodes, 3), self._zeros(*nodes), self._zeros(*nodes, 3))
        self.tools = self._zeros(capacity, model.steps + 1, model.boundary.slots, 3)
        self.differentiated = (*self.tape.arrays(), self.A, *self.grid.arrays(), self.tools)
        for array in self.differentiated:
            array.requires_grad_()
            array.grad = torch.zeros_like(array)
        self.escaped = torch.zeros(capacity, dtype=torch.bool, device=device)
        self.tape_step = -1  # the control step in the tape
        self._start()

    @one_torch_thread()
    def run(self, tools: torch.Tensor) -> torch.Tensor:
        """Simulate with the boundary's `tools`, shape (batch, step + 1, slot, 3); return x at their end [m]."""
        batch, steps = len(tools), tools.shape[1] - 1
        self.escaped.zero_()
        self.tools.detach()[:batch, : steps + 1] = tools.detach().to(self.tools)
        for step in range(steps):
            self._advance(step, batch)
            self.escaped |= self._outside()
            for checkpoint, array in zip(self.checkpoints.arrays(), self.tape.arrays(), strict=True):
                checkpoint[step + 1] = array.detach()[-1]
        return self.read_positions(steps, batch)

    def read_positions(self, step: int, batch: int) -> torch.Tensor:
        """Return x [m] before control step `step` of the last run, shape (batch, particle, 3)."""
        return self.checkpoints.x[step, :batch]

    def read_trajectory(self, environment: int) -> torch.Tensor:
        """Return x [m] of one environment of the last run at the ends of control steps, (step + 1, particle, 3)."""
        return copied(self.checkpoints.x[:, environment])

    def read_escaped(self, batch: int) -> torch.Tensor:
        """Say for each environment whether a particle has left the grid, shape (batch,)."""
        return self.escaped[:batch].clone()

    @one_torch_thread()
    def gradient(self, adj_x: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """Return the adjoint of the tools of the last run from those of x before some control steps, same shapes."""
        batch = len(next(iter(adj_x.values())))
        for array in self.differentiated:
            _grad(array).zero_()
        for step in reversed(range(max(adj_x))):
            if step + 1 in adj_x:
                _grad(self.tape.x)[-1, :batch] += adj_x[step + 1].to(self.tape.x)
            if self.tape_step != step:
                self._advance(step, batch)
            self._retreat(step, batch)
        return _grad(self.tools)[:batch].clone()

    def _advance(self, step: int, batch: int) -> None:
        if self.stop.is_set():
            raise InterruptedError("the simulation was stopped")
        self.tape_step = step
        for checkpoint, array in zip(self.checkpoints.arrays(), self.tape.arrays(), strict=True):
            array.detach()[0] = checkpoint[step]
            array.detach()[1:] = 0.0  # what g2p adds to
        for b in self.smooth:
            self.tape.S[b].detach()[0, :batch] = smooth_volume_ratios(self.model, b, *self._before(b, step, batch))
        for s in range(self.model.substeps):
            for (update, _), inputs in zip(self.materials, self._material_inputs(s, batch), strict=True):
                update(*inputs)
            self._fill_grid(step, s, batch)
            self.transfers.g2p(*self._g2p_inputs(s, batch))
            self.transfers.move(*self._move_inputs(s, batch))

    def _fill_grid(self, step: int, s: int, batch: int) -> None:
        for array in self.grid.arrays():
            array.detach().zero_()
        self.transfers.p2g(*self._p2g_inputs(s, batch))
        self.grid_op(*self._grid_inputs(step, s, batch))

    def _retreat(self, step: int, batch: int) -> None:
        """Take gradients from the tape's last state to its first, then to the last of the step before."""
        _grad(self.A).zero_()
        for s in reversed(range(self.model.substeps)):
            self._fill_grid(step, s, batch)
            for array in self.grid.arrays():
                _grad(array).zero_()
            self.transfers.move.grad(*self._move_inputs(s, batch))
            self.transfers.g2p.grad(*self._g2p_inputs(s, batch))
            self.grid_op.grad(*self._grid_inputs(step, s, batch))
            self.transfers.p2g.grad(*self._p2g_inputs(s, batch))
            for (_, adjoint), inputs in zip(self.materials, self._material_inputs(s, batch), strict=True):
                adjoint(*inputs)
        for b in self.smooth:
            self._retreat_smoothing(b, step, batch)
        for array in self.tape.arrays():
            grad = _grad(array)
            grad[-1] = grad[0]
            grad[:-1] = 0.0

    def _before(self, b: int, step: int, batch: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return x [m] and J of body b before a control step, and before J is smoothed."""
        x = self.checkpoints.x[step, :batch, self.first[b] : self.first[b + 1]]
        return x, self.checkpoints.S[b][step, :batch]

    def _retreat_smoothing(self, b: int, step: int, batch: int) -> None:
        """Turn the gradient of the tape's first J of body b into that of J before smoothing; add to that of x."""
        x, J = (values.clone().requires_grad_() for values in self._before(b, step, batch))
        grad_J = _grad(self.tape.S[b])[0, :batch]
        with torch.enable_grad():
            smoothed = smooth_volume_ratios(self.model, b, x, J)
        found = torch.autograd.grad(smoothed, (x, J), grad_J)
        _grad(self.tape.x)[0, :batch, self.first[b] : self.first[b + 1]] += found[0]
        grad_J[:] = found[1]

    def _material_inputs(self, s: int, batch: int) -> list[tuple[Any, ...]]:
        model, tape = self.model, self.tape
        scale = -model.dt * 4.0 / model.dx**2
        return [
            (s, batch, first, model.dt, scale, *body.material.constants(), self.mass, self.volume, tape.C, S, self.A)
            for body, first, S in zip(model.bodies, self.first[:-1], tape.S, strict=True)
        ]

    def _p2g_inputs(self, s: int, batch: int) -> tuple[Any, ...]:
        tape, grid = self.tape, self.grid
        return s, batch, self.origin, self.model.dx, self.mass, tape.x, tape.v, self.A, grid.q, grid.m

    def _grid_inputs(self, step: int, s: int, batch: int) -> tuple[Any, ...]:
        model, fall = self.model, self.model.dt * self.model.gravity
        time = step, s / model.substeps, 1.0 / (model.substeps * model.dt)
        return batch, self.origin, model.dx, fall, self.empty, *time, self.tools, *self.grid.arrays()

    def _g2p_inputs(self, s: int, batch: int) -> tuple[Any, ...]:
        tape = self.tape
        return s, batch, self.origin, self.model.dx, tape.x, self.grid.v, tape.v, tape.C

    def _move_inputs(self, s: int, batch: int) -> tuple[Any, ...]:
        return s, batch, self.model.dt, self.tape.v, self.tape.x

    def _outside(self) -> torch.Tensor:
        """Say for each environment whether particles in the tape had nodes that the grid has not."""
        origin, last = (self._constant(np.array(values)) for values in (self.model.origin, self.model.nodes))
        node = ((self.tape.x.detach()[:-1] - origin) / self.model.dx - 0.5).floor()
        return ~((node >= 0) & (node <= last - 3)).all(dim=3).all(dim=2).all(dim=0)

    def _states(self, times: int) -> States:
        count = times, self.capacity
        initial = [body.material.initial(body.ratio).shape for body in self.model.bodies]
        x, v, C = (self._zeros(*count, self.model.particles, *shape) for shape in ((3,), (3,), (3, 3)))
        return States(x, v, C, tuple(self._zeros(*count, *shape) for shape in initial))

    def _zeros(self, *shape: int) -> torch.Tensor:
        return torch.zeros(shape, dtype=self.dtype, device=self.device)

    def _constant(self, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).to(self.device, self.dtype)

    def _start(self) -> None:
        self.checkpoints.x[0] = self._constant(np.concatenate([body.x for body in self.model.bodies]))
        for body, S in zip(self.model.bodies, self.checkpoints.S, strict=True):
            S[0] = self._constant(body.material.initial(body.ratio))


def _grad(array: torch.Tensor) -> torch.Tensor:
    if array.grad is None:
        raise ValueError("this array has no gradient")
    return array.grad


@cache
@no_type_check
def transfers(name: str) -> SimpleNamespace:
    """Return the kernels `p2g, g2p, move` of one precision.

    Each particle's 27 nodes are taken in rows of three, or planes of nine, that are unrolled: to unroll them all takes
    the compiler three minutes, to unroll none halves the speed. Rows and planes are part of the one parallel loop. In a
    loop inside it, AD keeps only one turn's share of what was computed before, and may read what was never written.
    """
    real, array = types(name)
    vec3 = ti.types.vector(3, real)

    @ti.func
    def spline(d):
        """Return the quadratic B-spline's weight at a distance of d nodes."""
        far = ti.max(real(1.5) - ti.abs(d), real(0.0))
        return ti.select(ti.abs(d) < real(0.5), real(0.75) - d * d, real(0.5) * far * far)

    @ti.func
    def lowest(y, grid: ti.template()):
        """Return the lowest node that a particle at y [nodes] meets; one out of the grid meets its edge."""
        node = ti.floor(y - real(0.5), ti.i32)
        for a in ti.static(range(3)):
            node[a] = ti.max(0, ti.min(node[a], grid.shape[a + 1] - 3))
        return node

    @ti.kernel
    def p2g(
        s: ti.i32, batch: ti.i32, origin: vec3, dx: real, mass: array(1),
        x: array(3, 3), v: array(3, 3), A: array(3, 3, 3), q: array(4, 3), m: array(4),
    ):  # fmt: skip
        for e, p, i, j in ti.ndrange(batch, x.shape[2], 3, 3):
            y = (x[s, e, p] - origin) / dx
            for k in ti.static(range(3)):
                node = lowest(y, m) + ti.Vector([i, j, k])
                d = ti.cast(node, real) - y
                w = spline(d[0]) * spline(d[1]) * spline(d[2])
                q[e, node[0], node[1], node[2]] += w * (mass[p] * v[s, e, p] + dx * (A[s, e, p] @ d))
                m[e, node[0], node[1], node[2]] += w * mass[p]

    @ti.kernel
    def g2p(
        s: ti.i32, batch: ti.i32, origin: vec3, dx: real,
        x: array(3, 3), grid_v: array(4, 3), v: array(3, 3), C: array(3, 3, 3),
    ):  # fmt: skip
        for e, p, i in ti.ndrange(batch, x.shape[2], 3):
            y = (x[s, e, p] - origin) / dx
            plane_v = ti.Vector.zero(real, 3)
            plane_C = ti.Matrix.zero(real, 3, 3)
            for j, k in ti.static(ti.ndrange(3, 3)):
                node = lowest(y, grid_v) + ti.Vector([i, j, k])
                d = ti.cast(node, real) - y
                w = spline(d[0]) * spline(d[1]) * spline(d[2])
                share = w * grid_v[e, node[0], node[1], node[2]]
                plane_v += share
                plane_C += (real(4.0) / dx) * share.outer_product(d)
            v[s + 1, e, p] += plane_v
            C[s + 1, e, p] += plane_C

    @ti.kernel
    def move(s: ti.i32, batch: ti.i32, dt: real, v: array(3, 3), x: array(3, 3)):
        for e, p in ti.ndrange(batch, x.shape[2]):
            x[s + 1, e, p] = x[s, e, p] + dt * v[s + 1, e, p]

    return SimpleNamespace(p2g=p2g, g2p=g2p, move=move)


@cache
@no_type_check
def grid_kernel(name: str, contact: Any) -> Any:
    """Return the kernel that turns nodes' momentum into velocity after gravity and boundary; `fall` is dt g."""
    real, array = types(name)
    vec3 = ti.types.vector(3, real)

    @ti.kernel
    def grid_op(
        batch: ti.i32, origin: vec3, dx: real, fall: real, empty: real, step: ti.i32, fraction: real, rate: real,
        tools: array(3, 3), q: array(4, 3), m: array(4), v: array(4, 3),
    ):  # fmt: skip
        for e, i, j, k in ti.ndrange(batch, m.shape[1], m.shape[2], m.shape[3]):
            if m[e, i, j, k] > empty:
                p = origin + dx * ti.Vector([real(i), real(j), real(k)])
                free = q[e, i, j, k] / m[e, i, j, k] - ti.Vector([real(0.0), fall, real(0.0)])
                v[e, i, j, k] = contact(p, free, e, tools, step, fraction, rate)

    return grid_op
