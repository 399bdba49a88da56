"""One ball among walls and bars in a plane, from event to event, each at its exact time.

Between impacts the ball flies a parabola, and where a face carries it, its path is one too: `roots` says when it meets
what. A step only bounds how far one looks ahead. One iteration takes a row to its next event, or to the end of its
step: `find` says what comes first and when, `move` goes there. One launch takes every row through all its iterations.
Only `move` is differentiated, its adjoint running through them in reverse; it corrects the time by a step of Newton's,
whose derivative is the time's own.
"""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp

from ..runtime import load, precision, to_torch
from .board import FREE, Board, constants
from .episodes import path_struct
from .events import JAM as JAM
from .events import impact_kernels
from .overlaps import step_kernels

SPARE = 32  # iterations for which there is room at first, beyond two a step


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
    `step`, `impacts` (events at once), `support` (surface that carries the ball, or FREE), `pick` (surface that is met
    or another event, FREE or, of a row's last state, DONE) and `hits` (impacts faster than crawling) are whole numbers;
    `when` is the time of the event [s], as it was found.
    """

    NUMBERS = ("x", "v", "spin", "rest")
    COUNTS = ("step", "impacts", "support", "pick", "hits", "when")

    def __init__(self, length: int, capacity: int, name: str, device: str) -> None:
        real = precision(name).real
        vec2 = wp.types.vector(2, real)
        self.length, self.path = length, path_struct(name)()  # as kernels take it
        kinds = dict(zip(self.NUMBERS, (vec2, vec2, real, real), strict=True))
        kinds |= dict.fromkeys(self.COUNTS, wp.int32) | {"when": real}
        for field, kind in kinds.items():
            setattr(self.path, field, wp.zeros((length, capacity), dtype=kind, device=device))

    def tensor(self, field: str) -> torch.Tensor:
        """View one field as a tensor."""
        return to_torch(getattr(self.path, field))

    def adjoint(self, field: str) -> torch.Tensor:
        """View the adjoint of one field, zeros at first, as a tensor."""
        array = getattr(self.path, field)
        if array.grad is None:
            array.requires_grad = True
            setattr(self.path, field, array)  # now with what the adjoint kernel adds to
        return to_torch(array.grad)


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
        self.iterations = wp.zeros(capacity, dtype=wp.int32, device=device)  # that rows have taken
        self.flight = Flight(2 * steps + SPARE, capacity, name, device)

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
        self.taken = self._follow(batch)
        return self.at_end("x")

    def gradient(self, adj_x: torch.Tensor) -> Slopes:
        """Return what the adjoint of the last positions, shape (batch, 2), is for the beginning of the latest run."""
        batch = len(adj_x)
        used = int(self.taken.max()) + 1
        for field in Flight.NUMBERS:
            self.flight.adjoint(field)[:used, :batch] = 0
        self.adj_angle.zero_()
        adjoint = self.flight.adjoint("x")
        adjoint[self.taken, self._rows(batch)] = adj_x.to(adjoint)
        inputs = self._inputs()
        adjoints = [None, type(self.data)(), self.adj_angle, type(self.flight.path)()]
        settings: dict[str, Any] = {"device": self.device, "adjoint": True, "record_tape": False}
        wp.launch(self.kernels.retrace, batch, inputs, adj_inputs=adjoints, **settings)
        first = {name: self.flight.adjoint(field)[0, :batch].clone() for name, field in _SLOPES.items()}
        return Slopes(to_torch(self.adj_angle)[:batch].clone(), **first)

    def at_end(self, field: str) -> torch.Tensor:
        """Return one field of the latest run's last states, shape (batch, ...)."""
        return self.flight.tensor(field)[self.taken, self._rows(len(self.taken))]

    def at_steps(self, field: str, row: int) -> torch.Tensor:
        """Return one field of a row of the latest run at the ends of steps, shape (step + 1, ...)."""
        last = int(self.taken[row])
        step = self.flight.tensor("step")[: last + 1, row]
        ends = torch.cat([step.new_ones(1), step.diff()]) > 0
        return self.flight.tensor(field)[: last + 1, row][ends]

    def _follow(self, batch: int) -> torch.Tensor:
        """Launch until all rows are done, with more room where it has not been enough; return each row's iterations."""
        self.iterations.zero_()
        taken = to_torch(self.iterations)[:batch]
        while True:
            inputs = [self.flight.length - 1, *self._inputs()]
            wp.launch(self.kernels.follow, batch, inputs, device=self.device, record_tape=False)
            counts = taken.long()
            if bool((self.flight.tensor("step")[counts, self._rows(batch)] >= self.steps).all()):
                return counts
            self._double_length()

    def _double_length(self) -> None:
        old, self.flight = self.flight, Flight(2 * self.flight.length, self.capacity, self.name, self.device)
        for field in (*Flight.NUMBERS, *Flight.COUNTS):
            self.flight.tensor(field)[: old.length] = old.tensor(field)

    def _inputs(self) -> list[Any]:
        return [self.iterations, self.data, self.angle, self.flight.path]

    def _rows(self, batch: int) -> torch.Tensor:
        return torch.arange(batch, device=self.flight.tensor("step").device)


_SLOPES = {"start": "x", "velocity": "v", "spin": "spin"}
