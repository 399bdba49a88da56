"""Mass-spring sheets: vertices joined by damped springs, against a moving surface that takes their normal velocity.

Arrays are [row, vertex], one of each per step. A vertex gathers the forces of its own springs: every spring is computed
twice, but no sum is atomic. A CPU takes eight vertices at a time, with the same bits. The adjoint is written by hand in
the same way: with d = x_j - x_i, w = v_j - v_i and mu_i the adjoint of the force on i, a pair that pulls i by f and j
by -f adds -(mu_j - mu_i) . df to the loss's change.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from types import SimpleNamespace
from typing import Any, no_type_check

import numpy as np
import torch
import warp as wp

from ....landscapes.sampling.memory import release_idle
from .. import cpp
from ..launches import Launches
from ..runtime import fill_struct, free_memory, load, precision, to_torch
from .contact import Rule, Surface, contact_kernel, contact_kernel_in_rows, sum_kernel_in_rows, sum_kernels

STRETCH = 50  # steps that are launched at once
LANES = 8  # vertices that a CPU takes at once
SMALL = 200_000  # vertices up to which launches cost a GPU more than what they launch


@dataclass(frozen=True, eq=False)
class Sheet:
    """Vertices and the springs between them, in SI units.

    `x` are the vertices at the start, shape (vertex, 3); `pairs` the two ends of each spring, shape (spring, 2); `rest`
    its length and `weight` its share of stiffness and damping, shape (spring,). A spring of weight w between vertices
    of stiffness s_i and s_j [N/m] pulls with w (s_i + s_j) / 2 times its elongation, and with w `damping` [N s/m] times
    its rate. Where there is a `plate` [N/m], shape (spring,), a pair also attracts with so much times its distance, or
    repels where that is negative: such linear forces are how a sheet resists bending. `mass` [kg] is that of each
    vertex, or of all alike; air takes `drag` [1/s] of its velocity; `held` vertices go where the anchors do.
    """

    x: np.ndarray
    pairs: np.ndarray
    rest: np.ndarray
    weight: np.ndarray
    mass: np.ndarray | float
    damping: float
    drag: float = 0.0
    gravity: float = 9.81
    held: tuple[int, ...] = ()
    plate: np.ndarray | None = None

    @property
    def plates(self) -> np.ndarray:
        """Each pair's linear attraction [N/m], shape (spring,)."""
        return np.zeros(len(self.pairs)) if self.plate is None else self.plate

    @property
    def masses(self) -> np.ndarray:
        """The vertices' masses [kg], shape (vertex,)."""
        return np.broadcast_to(np.asarray(self.mass, dtype=np.float64), len(self.x))


def bytes_per_row(sheet: Sheet, steps: int, name: str) -> int:
    """Return the bytes an episode keeps: position and velocities of every step."""
    return 9 * (steps + 1) * len(sheet.x) * (8 if name == "float64" else 4)


def _in_rows(device: str) -> bool:
    """Say whether kernels take whole rows, eight vertices at a time, where others take a vertex in each thread."""
    return device == "cpu"


def capacity(size: int, device: str) -> int:
    """Return how many episodes of a `size` in bytes a solver should take at once."""
    if device == "cpu":
        return max(1, min(32, (1 << 28) // size))
    release_idle()
    return max(1, min(1024, free_memory() * 3 // 4 // size))


class Solver:
    """Integrate up to `capacity` sheets by semi-implicit Euler, and differentiate where they end.

    In each step springs, gravity and air change velocities; the surface takes what goes into it, by a `rule` of
    `contact`; then vertices move. The whole episode is kept. Sums have one order on every device. Setting `stop` ends
    an episode within STRETCH steps, with InterruptedError.
    """

    def __init__(
        self,
        sheet: Sheet,
        surface: Surface,
        *,
        dt: float,
        steps: int,
        name: str,
        capacity: int,
        device: str,
        stop: threading.Event | None = None,
        rule: Rule = "end",
    ) -> None:
        self.sheet, self.dt, self.steps, self.device = sheet, dt, steps, device
        self.stop = stop or threading.Event()
        self.types = precision(name)
        self.in_rows = _in_rows(device)
        self.springs = (spring_kernels_in_rows if self.in_rows else spring_kernels)(name)
        stop, Data = surface.stop(name, rule), surface.function(name)[1]
        if self.in_rows:
            self.touch = contact_kernel_in_rows(name, stop, Data, surface.inside, rule)
            self.sums = [sum_kernel_in_rows(name)]
        else:
            self.touch, self.sums = contact_kernel(name, stop, Data), sum_kernels(name)
        load([self.springs.pull, self.springs.adjoint, self.touch, *(self.sums if surface.moves else [])], device)
        self.moves = surface.moves
        self.surface = surface.data(name)
        self.no_adjoint = type(self.surface)()  # Warp wants a place for it
        self.launches = Launches(device, programs=True)
        self.network = _network(sheet, self.springs.Network, self.types, device, in_rows=self.in_rows)
        self.held: Any = wp.array(np.isin(np.arange(len(sheet.x)), sheet.held), dtype=wp.bool, device=device)
        self._allocate(capacity)

    def run(self, velocity: torch.Tensor, stiffness: torch.Tensor, poses: torch.Tensor | None = None) -> torch.Tensor:
        """Return where vertices are after each step [m], shape (step + 1, batch, vertex, 3).

        All but held vertices start at `velocity` [m/s], shape (batch, 3); `stiffness` [N/m] has shape (batch, vertex);
        `poses` of the surface have shape (batch, step + 1, 3), and are zeros unless given.
        """
        batch = len(velocity)
        to_torch(self.x[0])[:batch] = torch.from_numpy(self.sheet.x).to(self.x_all)
        to_torch(self.v[0])[:batch] = (velocity[:, None] * self._free()).to(self.x_all)
        to_torch(self.stiffness)[:batch] = stiffness.to(self.x_all)
        if self.moves:
            to_torch(self.poses)[:, :batch] = 0.0 if poses is None else poses.transpose(0, 1).to(self.x_all)
        for first in range(0, self.steps, STRETCH):
            self._run("forward", first, batch, self._step)
        return self.x_all[:, :batch]

    def gradient(self, adj_x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the adjoints of `run`'s velocity, stiffness and poses from that of the last positions."""
        batch = len(adj_x)
        for array in (self.adj_v, self.adj_stiffness, self.adj_poses):
            array.zero_()
        to_torch(self.adj_x)[:batch] = adj_x.to(self.x_all)
        for first in reversed(range(0, self.steps, STRETCH)):
            self._run("backward", first, batch, self._step_back)
        start = to_torch(self.adj_v)[:batch].cpu() * self._free().to(self.x_all.dtype)
        velocity = torch.stack([row.sum(dim=0) for row in start])  # by row: batched sums round as the batch is split
        return velocity, to_torch(self.adj_stiffness)[:batch].cpu().clone(), self._read_adj_poses(batch)

    def _read_adj_poses(self, batch: int) -> torch.Tensor:
        """Return the adjoint of poses, shape (batch, step + 1, 3): zeros where the surface does not move."""
        adjoint = to_torch(self.adj_poses)
        if not self.moves:
            return torch.zeros(1, dtype=adjoint.dtype).expand(batch, len(adjoint), 3)
        return adjoint[:, :batch].cpu().transpose(0, 1).clone()

    def _allocate(self, capacity: int) -> None:
        count, frames = len(self.sheet.x), self.steps + 1
        vec3 = {"dtype": self.types.vec3, "device": self.device}
        states = [wp.zeros((frames, capacity, count), **vec3) for _ in range(3)]
        self.x_all = to_torch(states[0])
        self.x, self.v, self.pulled = ([array[step] for step in range(frames)] for array in states)
        self.poses, self.adj_poses = (wp.zeros((frames, capacity), **vec3) for _ in range(2))
        self.pose = [self._of_every_vertex(pose) for pose in to_torch(self.poses)]
        self.adj_pose = [wp.zeros((capacity, count), **vec3) if self.moves else None for _ in range(2)]
        self.adj_parts = wp.zeros((capacity, math.isqrt(count)), **vec3)
        self.adj_x, self.adj_v, self.adj_here, self.adj_pulled = (wp.zeros((capacity, count), **vec3) for _ in range(4))
        self.work: list[Any] = []  # of kernels in rows: numbers of one row's vertices, and which of them are touched
        self.touched: list[Any] = []
        if self.in_rows:
            self.work = [wp.zeros(10 * (count + 3 * LANES), dtype=self.types.real, device=self.device)]
            self.touched = [wp.zeros((capacity, count + 1), dtype=int, device=self.device)]
        self.stiffness, self.adj_stiffness = (
            wp.zeros((capacity, count), dtype=self.types.real, device=self.device) for _ in range(2)
        )

    def _of_every_vertex(self, pose: torch.Tensor) -> Any:
        """Return poses of rows as an array [row, vertex] of the same memory."""
        return wp.from_torch(pose[:, None].expand(-1, len(self.sheet.x), 3), dtype=self.types.vec3)

    def _free(self) -> torch.Tensor:
        """Return 1 for vertices that can move and 0 for held ones, shape (vertex, 1)."""
        free = torch.ones(len(self.sheet.x), 1, dtype=torch.float64)
        free[list(self.sheet.held)] = 0.0
        return free

    def _run(self, way: str, first: int, batch: int, step: Callable[[int], None]) -> None:
        """Launch a stretch of steps, in their order or, backward, in the reverse of it."""
        if self.stop.is_set():
            raise InterruptedError("the simulation was stopped")

        def work() -> None:
            steps = range(first, min(first + STRETCH, self.steps))
            for number in steps if way == "forward" else reversed(steps):
                step(number)

        self.launches.run((way, first), batch, work, small=batch * len(self.sheet.x) <= SMALL)

    def _step(self, step: int) -> None:
        self._launch(self.springs.pull, [*self._pull_inputs(step), self.pulled[step], *self.work])
        self._launch(self.touch, [*self._touch_inputs(step), self.x[step + 1], self.v[step + 1], *self.touched])

    def _step_back(self, step: int) -> None:
        moved = [self.x[step + 1], self.v[step + 1], *self.touched]
        adjoints = [None, self.no_adjoint, None, *self.adj_pose, self.adj_here, self.adj_pulled, self.adj_x, self.adj_v]
        adjoints += [None for _ in self.touched]
        self._launch(self.touch, [*self._touch_inputs(step), *moved], adj_inputs=adjoints, adjoint=True)
        for frame, by_vertex in zip((step, step + 1), self.adj_pose, strict=True):
            if by_vertex is not None:
                self._add_to_pose(by_vertex, self.adj_poses[frame])
        changed = [self.adj_x, self.adj_v, self.adj_stiffness]
        self._launch(
            self.springs.adjoint, [*self._pull_inputs(step), self.adj_here, self.adj_pulled, *changed, *self.work]
        )

    def _add_to_pose(self, by_vertex: Any, by_row: Any) -> None:
        if self.in_rows:
            self._launch(self.sums[0], [by_vertex, by_row])
        else:
            self._launch(self.sums[0], [by_vertex, self.adj_parts], elements=self.adj_parts.shape[1])
            self._launch(self.sums[1], [self.adj_parts, by_row], elements=1)

    def _pull_inputs(self, step: int) -> list[Any]:
        return [self.network, self.dt, self.stiffness, self.x[step], self.v[step]]

    def _touch_inputs(self, step: int) -> list[Any]:
        poses = self.pose[step], self.pose[step + 1]
        return [self.dt, self.surface, self.held, *poses, self.x[step], self.pulled[step]]

    def _launch(self, kernel: Any, inputs: list[Any], *, elements: int | None = None, **how: Any) -> None:
        """Launch a kernel over rows and vertices, or so many other elements."""
        count = cpp.threads(kernel, len(self.sheet.x) if elements is None else elements)
        self.launches.launch(kernel, lambda batch: (batch, count), inputs, **how)


def _network(sheet: Sheet, Network: Any, types: Any, device: str, *, in_rows: bool) -> Any:
    """List every vertex's springs in the order of their other ends."""
    count, lists = (_slots if in_rows else _lists)(sheet)
    masses = torch.from_numpy(sheet.masses.copy()).to(types.torch)
    tensors = {"count": torch.from_numpy(count).int(), "mass": masses, "inverse_mass": 1.0 / masses}
    for name, values in lists.items():
        tensors[name] = torch.from_numpy(values).to(torch.int32 if name == "neighbor" else types.torch).flatten()
    arrays = {name: wp.from_torch(values.to(device)) for name, values in tensors.items()}
    return fill_struct(Network, arrays | {name: getattr(sheet, name) for name in ("damping", "drag", "gravity")})


def _ends(sheet: Sheet) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return both ends of every spring, seen from each, and what it is, in their order."""
    ends = np.concatenate([sheet.pairs, sheet.pairs[:, ::-1]])
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    values = {"rest": sheet.rest, "weight": sheet.weight, "plates": sheet.plates}
    return *ends[order].T, {name: np.tile(value, 2)[order] for name, value in values.items()}


def _lists(sheet: Sheet) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return how many springs a vertex has, and lists [number, vertex]: what threads read at once lies side by side."""
    here, there, values = _ends(sheet)
    count = np.bincount(here, minlength=len(sheet.x))
    number = np.arange(len(here)) - np.repeat(np.cumsum(count) - count, count)
    lists = {name: np.zeros((int(count.max(initial=1)), len(count))) for name in ("neighbor", *values)}
    for name, value in {"neighbor": there, **values}.items():
        lists[name][number, here] = value
    return count, lists


def _slots(sheet: Sheet) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return how many slots each eight vertices have, and lists [slot, vertex of the eight].

    In a slot are their springs to the vertices that are as much further in number, which is its `neighbor`, and where
    there is none a rest length of minus infinity. A vertex's other ends rise from slot to slot.
    """
    here, there, values = _ends(sheet)
    pair = here * len(sheet.x) + there
    nth = np.arange(len(pair)) - np.searchsorted(pair, pair)  # of those that join the same two
    found, slot = np.unique(np.stack([here // LANES, there - here, nth], axis=1), axis=0, return_inverse=True)
    lists = {name: np.full((len(found), LANES), -np.inf if name == "rest" else 0.0) for name in values}
    for name, value in values.items():
        lists[name][slot.ravel(), here % LANES] = value
    count = np.bincount(found[:, 0], minlength=-(-len(sheet.x) // LANES))
    return count, {"neighbor": found[:, 1], **lists}


@cache
@no_type_check
def spring_kernels(name: str) -> SimpleNamespace:
    """Return the kernel `pull` of forces on velocities, its `adjoint`, and the struct `Network` of one precision."""
    types = precision(name)
    real, vec3, (Reals, Vectors, _, _) = types.real, types.vec3, types.rows
    module = cpp.module(f"gradscape.springs.{name}")

    @partial(wp.struct, module=module)
    class Network:
        """Springs by vertex, as `_lists` returns them or for kernels in rows `_slots`, and the scalars of Sheet."""

        count: wp.array[int]
        neighbor: wp.array[int]
        rest: wp.array[real]
        weight: wp.array[real]
        plates: wp.array[real]
        mass: wp.array[real]
        inverse_mass: wp.array[real]
        damping: real
        drag: real
        gravity: real

    # Warp looks of every index whether it counts from the end, and multiplies it by a stride in 64 bits. These arrays
    # are read twelve times a vertex.
    @cpp.func_native(called="read_flat")
    def real_at(values: wp.array[real], i: int) -> real: ...

    @cpp.func_native(called="read_flat")
    def number_at(values: wp.array[int], i: int) -> int: ...

    @cpp.func_native(called="read_flat")
    def stiffness_at(values: Reals, i: int) -> real: ...

    @cpp.func_native(called="read_flat")
    def vector_at(values: Vectors, i: int) -> vec3: ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def pull(network: Network, dt: real, stiffness: Reals, x: Vectors, v: Vectors, pulled: Vectors):
        row, i = wp.tid()
        first = row * x.shape[1]
        x_i, v_i = vector_at(x, first + i), vector_at(v, first + i)
        s_i = stiffness_at(stiffness, first + i)
        f = vec3()
        for k in range(network.count[i]):
            at = k * x.shape[1] + i
            j = first + number_at(network.neighbor, at)
            d = vector_at(x, j) - x_i
            w = vector_at(v, j) - v_i
            both = s_i + stiffness_at(stiffness, j)
            weight, rest = real_at(network.weight, at), real_at(network.rest, at)
            f += real_at(network.plates, at) * d
            length = wp.length(d)
            n = wp.where(length > real(0.0), real(1.0) / length, real(0.0)) * d  # ends that coincide have no direction
            tension = (real(0.5) * both) * (length - rest) + network.damping * wp.dot(w, n)
            f += (weight * tension) * n
        a = f / network.mass[i] - network.drag * v_i - vec3(real(0.0), network.gravity, real(0.0))
        pulled[row, i] = v_i + dt * a

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def adjoint(
        network: Network,
        dt: real,
        stiffness: Reals,
        x: Vectors,
        v: Vectors,
        adj_here: Vectors,
        adj_pulled: Vectors,
        adj_x: Vectors,
        adj_v: Vectors,
        adj_stiffness: Reals,
    ):
        row, i = wp.tid()
        first = row * x.shape[1]
        x_i, v_i = vector_at(x, first + i), vector_at(v, first + i)
        s_i, adj_i = stiffness_at(stiffness, first + i), vector_at(adj_pulled, first + i)
        mu_i = network.inverse_mass[i] * adj_i
        gx = vec3()
        gv = vec3()
        gs = real(0.0)
        for k in range(network.count[i]):
            at = k * x.shape[1] + i
            neighbor = number_at(network.neighbor, at)
            j = first + neighbor
            d = vector_at(x, j) - x_i
            w = vector_at(v, j) - v_i
            difference = real_at(network.inverse_mass, neighbor) * vector_at(adj_pulled, j) - mu_i
            both = s_i + stiffness_at(stiffness, j)
            weight, rest = real_at(network.weight, at), real_at(network.rest, at)
            gx += real_at(network.plates, at) * difference
            length = wp.length(d)
            inverse = wp.where(length > real(0.0), real(1.0) / length, real(0.0))
            n = inverse * d
            mu = weight * difference
            s = real(0.5) * both
            along, rate = wp.dot(mu, n), wp.dot(w, n)
            across = mu - along * n
            tension = s * (length - rest) + network.damping * rate
            gx += (s * along) * n + (tension * inverse) * across
            gx += (network.damping * along * inverse) * (w - rate * n)
            gv += (network.damping * along) * n
            gs -= real(0.5) * along * (length - rest)
        adj_x[row, i] = adj_here[row, i] + dt * gx
        adj_v[row, i] = (real(1.0) - dt * network.drag) * adj_i + dt * gv
        adj_stiffness[row, i] += dt * gs

    return SimpleNamespace(pull=pull, adjoint=adjoint, Network=Network)


@cache
@no_type_check
def spring_kernels_in_rows(name: str) -> SimpleNamespace:
    """Return the same kernels for a CPU, in C++, which take eight vertices at a time (`native/springs.h`)."""
    real, (Reals, Vectors, _, _), Network = precision(name).real, precision(name).rows, spring_kernels(name).Network
    declare, work = partial(cpp.kernel_in_rows, f"gradscape.springs.{name}.rows"), wp.array[real]
    given = {"network": Network, "dt": real, "stiffness": Reals, "x": Vectors, "v": Vectors}
    adjoints = {"adj_here": Vectors, "adj_pulled": Vectors, "adj_x": Vectors, "adj_v": Vectors, "adj_stiffness": Reals}
    pull = declare("pull", **given, pulled=Vectors, work=work)
    adjoint = declare("adjoint_pull", **given, **adjoints, work=work)
    return SimpleNamespace(pull=pull, adjoint=adjoint, Network=Network)
