"""One ball among walls and bars in a plane: exact times of impact along chords.

Within a time step the ball flies a parabola; its chord is followed instead. Gravity bends a parabola towards itself, so
that a chord never lies above it: energy never grows, nothing is tunnelled through, and steps end on the true parabola.
One iteration takes a row to its next impact, or to the end of its step: `find` says what the chord meets first, `move`
goes there. Only `move` is differentiated, its adjoint running through the iterations in reverse; since it computes the
time of impact, gradients contain it.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, no_type_check

import torch
import warp as wp

from ..runtime import load, precision, to_torch
from .board import DONE, FREE, Board, Kernels, constants, surfaces
from .overlaps import step_kernels

JAM = wp.constant(8)  # impacts in one step after which its rest is dropped: the ball is stuck between surfaces
ASK = 32  # iterations between two questions whether all rows are done


@dataclass(frozen=True, eq=False)
class Slopes:
    """Hold derivatives by `angle`, shape (batch, bar), `start` and `velocity`, (batch, 2), and `spin`, (batch,)."""

    angle: torch.Tensor
    start: torch.Tensor
    velocity: torch.Tensor
    spin: torch.Tensor


class Flight:
    """Hold the state at the start of every iteration, arrays of shape (iteration, row).

    Position `x`, velocity `v`, `spin` (counterclockwise) and the time `rest` left in the step are differentiable;
    `step`, `impacts` in the step, `support` (surface that carries the ball, or FREE), `pick` (surface that is met, FREE
    or DONE) and `hits` (impacts faster than crawling) are whole numbers.
    """

    NUMBERS = ("x", "v", "spin", "rest")
    COUNTS = ("step", "impacts", "support", "pick", "hits")

    def __init__(self, length: int, capacity: int, name: str, device: str, *, counts: bool = True) -> None:
        real = precision(name).real
        vec2 = wp.types.vector(2, real)
        self.length = length
        kinds = dict(zip(self.NUMBERS, (vec2, vec2, real, real), strict=True))
        kinds |= dict.fromkeys(self.COUNTS if counts else (), wp.int32)
        for field, kind in kinds.items():
            setattr(self, field, wp.zeros((length, capacity), dtype=kind, device=device))

    def tensor(self, field: str) -> torch.Tensor:
        """View one field as a tensor."""
        return to_torch(getattr(self, field))

    def arrays(self) -> list[Any]:
        """Return the arrays in the order kernels take them."""
        return [getattr(self, field) for field in (*self.NUMBERS, *self.COUNTS) if hasattr(self, field)]


class Solver:
    """Follow up to `capacity` balls for `steps` steps of `dt` [s], and differentiate where they end.

    `contacts` is impact, as above, or step, as in `overlaps`. Every iteration is kept: it is only a few numbers.
    """

    def __init__(
        self, board: Board, *, dt: float, steps: int, name: str, capacity: int, device: str, contacts: str = "impact"
    ) -> None:
        self.steps, self.dt, self.name, self.capacity, self.device = steps, dt, name, capacity, device
        self.types = precision(name)
        self.kernels = {"impact": impact_kernels, "step": step_kernels}[contacts](name)
        load(self.kernels, device)
        self.data = constants(board, dt=dt, steps=steps, name=name, device=device)
        self.angle, self.adj_angle = (
            wp.zeros((capacity, len(board.pivots)), dtype=self.types.real, device=device) for _ in range(2)
        )
        self.flight = Flight(2 * steps + ASK, capacity, name, device)
        self.adjoint: Flight | None = None

    def run(
        self,
        angle: torch.Tensor,
        start: torch.Tensor,
        velocity: torch.Tensor | float = 0.0,
        spin: torch.Tensor | float = 0.0,
    ) -> torch.Tensor:
        """Return where balls are at the end [m], shape (batch, 2).

        `angle` [rad], shape (batch, bar); `start` [m] and `velocity` [m/s], shape (2,) or (batch, 2), and `spin`
        [rad/s], shape (batch,), are those of the beginning, at rest unless given.
        """
        batch = len(angle)
        to_torch(self.angle)[:batch] = angle.to(self.types.torch)
        first = {"x": start, "v": velocity, "spin": spin, "rest": self.dt, "support": FREE}
        for field in (*Flight.NUMBERS, *Flight.COUNTS):
            row = self.flight.tensor(field)[0, :batch]
            row[:] = torch.as_tensor(first.get(field, 0), dtype=torch.float64).to(row)
        self.taken = self._advance(batch)
        return self.at_end("x")

    def gradient(self, adj_x: torch.Tensor) -> Slopes:
        """Return what the adjoint of the last positions, shape (batch, 2), is for the beginning of the latest run."""
        batch = len(adj_x)
        adjoint = self._clear_adjoint()
        adjoint.tensor("x")[self.taken, self._rows()] = adj_x.to(adjoint.tensor("x"))
        settings: dict[str, Any] = {"device": self.device, "adjoint": True, "record_tape": False}
        nothing = [None] * len(Flight.COUNTS)
        settings["adj_inputs"] = [None, type(self.data)(), self.adj_angle, *adjoint.arrays(), *nothing]
        for i in reversed(range(int(self.taken.max()))):
            wp.launch(self.kernels.move, batch, self._inputs(i), **settings)
        first = {name: adjoint.tensor(field)[0, :batch].clone() for name, field in _SLOPES.items()}
        return Slopes(to_torch(self.adj_angle)[:batch].clone(), **first)

    def at_end(self, field: str) -> torch.Tensor:
        """Return one field of the latest run's last states, shape (batch, ...)."""
        return self.flight.tensor(field)[self.taken, self._rows()]

    def at_steps(self, field: str, row: int) -> torch.Tensor:
        """Return one field of a row of the latest run at the ends of steps, shape (step + 1, ...)."""
        last = int(self.taken[row])
        step = self.flight.tensor("step")[: last + 1, row]
        ends = torch.cat([step.new_ones(1), step.diff()]) > 0
        return self.flight.tensor(field)[: last + 1, row][ends]

    def _advance(self, batch: int) -> torch.Tensor:
        """Iterate until all rows are done; return how many iterations each took."""
        i = 0
        while bool((self.flight.tensor("step")[i, :batch] < self.steps).any()):
            if i + ASK >= self.flight.length:
                self._double_length()
            for k in range(i, i + ASK):
                for kernel in self.kernels:
                    wp.launch(kernel, batch, self._inputs(k), device=self.device, record_tape=False)
            i += ASK
        taken: torch.Tensor = (self.flight.tensor("pick")[:i, :batch] != DONE).sum(dim=0)
        return taken

    def _double_length(self) -> None:
        old, self.flight = self.flight, Flight(2 * self.flight.length, self.capacity, self.name, self.device)
        for field in (*Flight.NUMBERS, *Flight.COUNTS):
            self.flight.tensor(field)[: old.length] = old.tensor(field)

    def _clear_adjoint(self) -> Flight:
        if self.adjoint is None or self.adjoint.length != self.flight.length:
            self.adjoint = Flight(self.flight.length, self.capacity, self.name, self.device, counts=False)
        used = int(self.taken.max()) + 1
        for field in Flight.NUMBERS:
            self.adjoint.tensor(field)[:used] = 0
        self.adj_angle.zero_()
        return self.adjoint

    def _inputs(self, i: int) -> list[Any]:
        return [i, self.data, self.angle, *self.flight.arrays()]

    def _rows(self) -> torch.Tensor:
        return torch.arange(len(self.taken), device=self.taken.device)


_SLOPES = {"start": "x", "velocity": "v", "spin": "spin"}


@cache
@no_type_check
def impact_kernels(name: str) -> Kernels:
    """Return the kernels of an iteration that ends at an impact or with the step."""
    real = precision(name).real
    vec2 = wp.types.vector(2, real)
    Reals, Vecs, Ints = wp.array2d[real], wp.array2d[vec2], wp.array2d[int]
    module = f"gradscape.impacts.{name}"
    Data, along, anchor, outward, distance, nearest, coulomb, rebound, deflect = surfaces(name)

    @wp.func(module=module)
    def kick(data: Data, support: int, angle: Reals, e: int, here: vec2, v: vec2, spin: real, rest: real):
        """Return what velocity and spin gain by the end of the step: by gravity, support and friction against slip."""
        fall = vec2(real(0.0), -data.gravity * rest)
        if support == FREE:
            return fall, real(0.0)
        n = outward(data, support, angle, e, here)
        t = vec2(-n[1], n[0])
        slip = wp.dot(v, t) - data.radius * spin
        free = slip + wp.dot(fall, t)
        goal = real(0.0)
        if slip * free < real(0.0):  # gravity turns the slip: friction must not do work on the way, so the mean is 0
            goal = -slip
            if wp.abs(free) < wp.abs(slip):
                goal = free
        stick = (goal - free) * data.inertia / (real(1.0) + data.inertia)
        rub = coulomb(stick, -data.friction * wp.dot(fall, n))
        return fall - wp.dot(fall, n) * n + rub * t, -rub / (data.inertia * data.radius)

    @wp.func(module=module)
    def time_to_end(data: Data, m: vec2, w: vec2) -> real:
        """Return when a point at m from a round end's centre is `reach` away, negative where it misses."""
        c = wp.dot(m, m) - data.reach * data.reach
        b = wp.dot(m, w)
        root = b * b - wp.dot(w, w) * c
        if b >= real(0.0) or root <= data.graze * b * b:
            return real(-1.0)
        return c / (wp.sqrt(root) - b)

    @wp.func(module=module)
    def hit_bar(data: Data, p: vec2, q: vec2, soonest: real):
        """Return when and where, before `soonest`, a chord from p along q enters a bar, in the bar's frame."""
        met = int(FREE)
        L, R = data.half_length, data.reach
        m = vec2(p[0] - wp.clamp(p[0], -L, L), p[1])
        if wp.dot(m, m) <= R * R:  # it touches, or rounding put it inside
            if wp.dot(m, q) < -data.graze * R * wp.length(q):
                soonest = real(0.0)
                met = nearest(data, p)
            return soonest, met
        if wp.abs(p[1]) > R and p[1] * q[1] < -data.graze * R * wp.length(q):
            t = (wp.abs(p[1]) - R) / wp.abs(q[1])
            if t < soonest and wp.abs(p[0] + t * q[0]) <= L:
                soonest = t
                met = wp.where(p[1] > real(0.0), 0, 1)
        t = time_to_end(data, p - vec2(L, real(0.0)), q)
        if t >= real(0.0) and t < soonest:
            soonest = t
            met = 2
        t = time_to_end(data, p + vec2(L, real(0.0)), q)
        if t >= real(0.0) and t < soonest:
            soonest = t
            met = 3
        return soonest, met

    @wp.kernel(module=module, enable_backward=False)
    def find(
        i: int,
        data: Data,
        angle: Reals,
        x: Vecs,
        v: Vecs,
        spin: Reals,
        rest: Reals,
        step: Ints,
        impacts: Ints,
        support: Ints,
        pick: Ints,
        hits: Ints,
    ):
        e = wp.tid()
        if step[i, e] >= data.steps:
            pick[i, e] = DONE
            return
        here, carrier, soonest = x[i, e], support[i, e], real(rest[i, e])
        pick[i, e] = FREE
        if soonest <= data.graze * data.dt:  # nothing but rounding is left of the step
            return
        gain, _ = kick(data, carrier, angle, e, here, v[i, e], spin[i, e], soonest)
        w = v[i, e] + real(0.5) * gain
        pace = wp.length(w)
        near = data.half_length + data.reach + soonest * pace
        bars = data.pivot.shape[0]
        first = int(FREE)
        for k in range(bars):
            to = here - data.pivot[k]
            if wp.dot(to, to) <= near * near and (carrier == FREE or carrier // 4 != k):
                axis = along(angle[e, k])
                across = vec2(-axis[1], axis[0])
                p = vec2(wp.dot(to, axis), wp.dot(to, across))
                t, met = hit_bar(data, p, vec2(wp.dot(w, axis), wp.dot(w, across)), soonest)
                if met != FREE:
                    first = 4 * k + met
                    soonest = t
        for wall in range(4 * bars, 4 * bars + 4):
            approach = -wp.dot(outward(data, wall, angle, e, here), w)
            if wall != carrier and approach > data.graze * pace:
                t = wp.max(distance(data, wall, angle, e, here), real(0.0)) / approach
                if t < soonest:
                    first = wall
                    soonest = t
        pick[i, e] = first

    @wp.func(module=module)
    def time_of_impact(data: Data, surface: int, angle: Reals, e: int, here: vec2, w: vec2) -> real:
        """Return when the chord from `here` along w meets a surface."""
        if surface // 4 < data.pivot.shape[0] and surface % 4 >= 2:
            return time_to_end(data, here - anchor(data, surface, angle, e), w)
        n = outward(data, surface, angle, e, here)
        return -distance(data, surface, angle, e, here) / wp.dot(n, w)

    @wp.func(module=module)
    def separate(data: Data, n: vec2, u: real, left: real):
        """Return the normal speed after a meeting at u, and whether the surface carries the ball from there on."""
        pull = -data.gravity * n[1]
        after = u  # where its parabola turned before the chord met: it leaves already
        if u < real(0.0):
            after = rebound(data, -u)
        if pull < real(0.0) and (u >= real(0.0) or after < real(-0.5) * pull * left):  # it would be back in this step
            return real(0.0), True
        return after, False

    @wp.kernel(module=module)
    def move(
        i: int,
        data: Data,
        angle: Reals,
        x: Vecs,
        v: Vecs,
        spin: Reals,
        rest: Reals,
        step: Ints,
        impacts: Ints,
        support: Ints,
        pick: Ints,
        hits: Ints,
    ):
        e = wp.tid()
        surface = pick[i, e]
        step[i + 1, e] = step[i, e]
        if surface == DONE:
            return
        here, speed, turn, span = x[i, e], v[i, e], spin[i, e], rest[i, e]
        gain, twist = kick(data, support[i, e], angle, e, here, speed, turn, span)
        w = speed + real(0.5) * gain
        hits[i + 1, e] = hits[i, e]
        impacts[i + 1, e] = 0
        support[i + 1, e] = FREE
        if surface == FREE:
            x[i + 1, e] = here + span * w
            v[i + 1, e] = speed + gain
            spin[i + 1, e] = turn + twist
            rest[i + 1, e] = data.dt
            step[i + 1, e] = step[i, e] + 1
            return
        t = wp.clamp(time_of_impact(data, surface, angle, e, here, w), real(0.0), span)
        there = here + t * w
        share = t / span
        arriving = speed + share * gain
        n = outward(data, surface, angle, e, there)
        u = wp.dot(arriving, n)
        if u < -data.crawl:
            hits[i + 1, e] = hits[i, e] + 1
        after, carried = separate(data, n, u, span - t)
        leaving, turning = deflect(data, n, arriving, turn + share * twist, after)
        x[i + 1, e] = there
        v[i + 1, e] = leaving
        spin[i + 1, e] = turning
        rest[i + 1, e] = data.dt
        if impacts[i, e] + 1 == JAM:
            step[i + 1, e] = step[i, e] + 1
            return
        rest[i + 1, e] = span - t
        impacts[i + 1, e] = impacts[i, e] + 1
        if carried:
            support[i + 1, e] = surface

    return Kernels(find, move)
