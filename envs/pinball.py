"""The Pinball scenes: a ball falls through a grid of bars, and the angles of the bars lead it to a goal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize, pad

from ..landscapes.episode import Part, View
from ..landscapes.objective import Evaluation, Status
from ..landscapes.sampling.memory import Pool
from ..landscapes.space import ParameterSpace
from .base import Environment, Episode, Fidelity, MaterialRange, ModelPart, Work
from .engines.balls.impacts import INERTIA, RIGID, SPARE, Board, Solver
from .records import EpisodeOptions

WIDTH, HEIGHT = 8.0, 10.0  # the board [m]
BALL, BAR = 0.25, 0.1  # radius of the ball, half the thickness of a bar [m]
DURATION = 4.0  # [s]
SOLVER_BYTES = 1 << 28  # bytes a solver may take
VIEW = View((0.0, -0.8, -0.5), (WIDTH, HEIGHT, 0.5), eye=(0.08, 0.1, 1.0), ground=None)


@dataclass(frozen=True)
class PinballOptions(EpisodeOptions):
    """`contacts`: impact computes the time of each impact; step reflects in fixed steps, and its gradients are wrong.

    `restitution` and Coulomb's `friction` apply to walls and bars. Restitution fades to zero below `crawl` [m/s].
    `spin`: the ball is a solid sphere that spins, or else it cannot spin. The goal is at (`goal_x`, `goal_y`) [m].
    """

    contacts: Literal["impact", "step"] = "impact"
    restitution: float = 0.5
    friction: float = 0.2
    crawl: float = 0.1
    spin: bool = True
    goal_x: float = 7.0
    goal_y: float = 0.65


def angles(count: int) -> ParameterSpace:
    """Return the box of the angles of this many colliders."""
    return ParameterSpace.box([f"collider {k} angle" for k in range(count)], -1.0, 1.0, "rad")


class Pinball(Environment):
    """Model: a spinning solid sphere (0.25 m, 1 kg) on an upright board 8 m wide and 10 m high, with walls all round.

    It is dropped at rest onto a grid of bars, 0.2 m thick with round ends, each fixed at its angle on a pivot. With two
    bars it starts at (3.75, 9.5) m, above pivots at (2.2, 6) and (5.8, 6) m. With sixteen it starts at (3.5, 9.5) m,
    above rows at 8.1, 6.7, 5.3, 3.9 m with pivots at 0.97, 2.99, 5.01, 7.03 m. Impacts are instantaneous, with
    restitution 0.5 and Coulomb friction 0.2 (options). Restitution fades below 0.1 m/s, so that a ball comes to rest.
    Flights and slides along faces are parabolas with exact times of impact. Faces and walls have a closed form, round
    ends take a root of the quartic. Rolling around an end takes Runge-Kutta steps of 1/240 s. So the step only bounds
    how far ahead impacts are searched for. contacts=step reflects the velocity at the end of a step in which the ball
    overlaps something, as many simulators do. The ball can then pass through a bar, and its gradients lack the time of
    impact.
    Fidelity: on 100 random boards, with two bars and with sixteen, ends at steps of 1/15 and 1/240 s in float64 differ
    by less than 1e-6 m. What remains is rounding, which impacts amplify. Ends in float32 at 1/30 s are within 1e-3 m of
    float64 on 100 and 63 % of the boards, and within 0.1 m on 100 and 97 %.
    Parameters: angles of the bars [rad], row by row from the top, 0 horizontal, counterclockwise.
    Loss: distance of the ball's centre to the goal (7, 0.65) m at the end, after 4 s [m].
    Simplifications: bars do not move, because their angles are the parameters. There is no drag and no rolling
    resistance, because 4 s are short. A ball that would return to its surface within 1 ms stays on it. A ball jammed
    between surfaces (8 impacts at once) stays in place until the next step.
    Source: task Pinball of "Rethinking Optimization with Differentiable Simulation from a Global Perspective" (CoRL
    2022), appendix A.1.2; ball, bars, start, goal and duration are ours.
    """

    model_version = 1
    devices: ClassVar[tuple[str, ...]] = ("cpu", "cuda")
    beyond_box = True
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=1 / 30),
        "standard": Fidelity("standard", dt=1 / 30, precision="float64"),
        "reference": Fidelity("reference", dt=1 / 240, precision="float64"),
    }
    loss_unit = "m"
    model_parts: ClassVar[tuple[ModelPart, ...]] = (
        ModelPart("friction", {"friction": 0.0}, "smooth walls and bars"),
        ModelPart("spin", {"spin": False}, "a ball that cannot spin, which friction brakes"),
        ModelPart("fading restitution", {"crawl": 1e-3}, "restitution fades below 1 mm/s instead of 0.1 m/s"),
        ModelPart("time of impact", {"contacts": "step"}, "reflected in fixed steps"),
    )
    material_range: ClassVar[MaterialRange] = MaterialRange("restitution", 0.0, 1.0)
    Options: ClassVar[type[Any]] = PinballOptions
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"paper": {}}  # the scene as it is
    pivots: ClassVar[tuple[tuple[float, float], ...]]
    half_length: ClassVar[float]
    start: ClassVar[tuple[float, float]]
    _solvers: Pool[Solver]

    @property
    def steps(self) -> int:
        """Number of time steps of an episode."""
        steps: int = self.options.count_steps(round(DURATION / self.fidelity.dt))
        return steps

    @property
    def goal(self) -> Float[Tensor, " 2"]:
        """Position of the goal [m]."""
        return torch.tensor([self.options.goal_x, self.options.goal_y], dtype=torch.float64)

    def memory(self) -> int:
        """Estimate the bytes one episode takes while it runs."""
        iterations = 2 * self.steps + SPARE
        return iterations * ((2 * 6 + 1) * (8 if self.fidelity.precision == "float64" else 4) + 5 * 4)

    def work(self) -> Work:
        """Count steps of the ball."""
        return Work(self.steps, "body-step")

    def events(self, x: Float[Tensor, "batch dim"]) -> Mapping[str, Int[Tensor, " batch"]]:
        """Count the impacts of each episode that are faster than `crawl`."""
        counts = [torch.zeros(0, dtype=torch.int64)]
        for part in torch.split(self._check_points(x), self._capacity):
            with self._solvers.lend() as solver:
                solver.run(part, self._start)
                counts.append(solver.at_end("hits").cpu().long())
        return {"impacts": torch.cat(counts)}

    def replicas(self) -> Mapping[str, Environment]:
        """Return the fall in slightly shorter time steps: each step rounds, and impacts amplify the rounding."""
        return self._replicas_of(self._shorter_steps(round(DURATION / self.fidelity.dt)))

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return the ball at the ends of steps, and both ends of every bar."""
        (row,) = self._row(x)
        with self._solvers.lend() as solver:
            solver.run(row[None], self._start)
            flight = _embed(solver.at_steps("x", 0).double().cpu())
        time = self.fidelity.dt * torch.arange(self.steps + 1, dtype=torch.float64)
        along = self.half_length * torch.stack([row.cos(), row.sin()], dim=1)
        pivots = torch.tensor(self.pivots, dtype=torch.float64)
        bars = _embed(torch.stack([pivots - along, pivots + along], dim=1).view(-1, 2))
        points = {"ball": flight[:, None], "bars": bars.expand(len(time), -1, 3)}
        goal = _embed(self.goal).expand(len(time), 3)
        balls = (_draw_ball("rubber", flight[:, None]), Part("trail", "rubber", flight[:, None], (BALL / 8,)))
        rods = [Part("path", "steel", ends, (BAR,)) for ends in torch.split(points["bars"], 2, dim=1)]
        parts = (*_draw_case(len(time)), *balls, *rods, _draw_ball("target", goal[:, None]))
        return Episode(time, points, {"goal": goal}, parts, VIEW)

    def _setup(self) -> None:
        o = self.options
        self._start = torch.tensor(self.start, dtype=torch.float64)
        law: dict[str, Any] = {"crawl": o.crawl, "inertia": INERTIA if o.spin else RIGID}
        self.board = Board(WIDTH, HEIGHT, self.pivots, self.half_length, BAR, BALL, o.restitution, o.friction, **law)
        self._capacity = max(1, min(256 if self.device == "cpu" else 1 << 14, SOLVER_BYTES // self.memory()))
        settings: dict[str, Any] = {"dt": self.fidelity.dt, "steps": self.steps, "name": self.fidelity.precision}
        settings |= {"capacity": self._capacity, "device": self.device, "contacts": o.contacts}
        self._solvers = Pool(partial(Solver, self.board, **settings))

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        with self._solvers.lend() as solver:
            miss = solver.run(x, self._start).cpu().double() - self.goal
            loss = miss.norm(dim=1)
            slope = solver.gradient(normalize(miss)).angle if grad else None
        return Evaluation(loss, slope, torch.full((len(x),), Status.OK, dtype=torch.int8))


class Pinball2(Pinball):
    """Lead a falling ball to the goal by the angles of two bars, 3.4 m long.

    Where the left bar is steep, the ball falls between the bars without touching them: a flat region. The example `aim`
    of both scenes is among the best of 4096 random points at draft, chosen for its small loss at all fidelities.
    """

    name = "pinball-2"
    examples: ClassVar[dict[str, tuple[float, ...]]] = {"aim": (0.55, -0.22)}
    pivots = ((2.2, 6.0), (5.8, 6.0))
    half_length = 1.6
    start = (3.75, 9.5)
    space = angles(2)


class Pinball16(Pinball):
    """Lead a falling ball to the goal by the angles of four rows of four bars, 1.14 m long."""

    name = "pinball-16"
    examples: ClassVar[dict[str, tuple[float, ...]]] = {
        "aim": (0.77, -0.65, -0.35, -0.9, 0.37, -0.25, -0.25, -0.07,
                -0.96, -0.32, -0.54, 0.83, -0.48, -0.82, 0.22, -0.93)
    }  # fmt: skip
    pivots = tuple((x, y) for y in (8.1, 6.7, 5.3, 3.9) for x in (0.97, 2.99, 5.01, 7.03))
    half_length = 0.47
    start = (3.5, 9.5)
    space = angles(16)


def _draw_ball(material: Literal["rubber", "target"], at: Float[Tensor, "frame 1 3"]) -> Part:
    return Part("sphere", material, at, (BALL,))


def _draw_case(frames: int) -> list[Part]:
    """Return the board behind the ball, and the walls around it."""
    depth, wall = 2 * BALL, 0.2
    pieces = [
        ((WIDTH / 2, HEIGHT / 2, -BALL - wall / 2), (WIDTH + 2 * wall, HEIGHT + 2 * wall, wall), "board"),
        *(((x, HEIGHT / 2, 0.0), (wall, HEIGHT + 2 * wall, depth), "wood") for x in (-wall / 2, WIDTH + wall / 2)),
        *(((WIDTH / 2, y, 0.0), (WIDTH, wall, depth), "wood") for y in (-wall / 2, HEIGHT + wall / 2)),
    ]
    still = torch.zeros(frames, 1, 3, dtype=torch.float64)
    return [Part("box", material, still + still.new_tensor(at), size) for at, size, material in pieces]  # type: ignore[arg-type]


def _embed(p: Float[Tensor, "*frame 2"]) -> Float[Tensor, "*frame 3"]:
    return pad(p, (0, 1))
