"""A MuJoCo model as an environment: the choice of its parameters and of its loss."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes.episode import Part, View
from ...landscapes.objective import Evaluation
from ...landscapes.space import ParameterSpace
from ..base import Environment, Episode, Fidelity, OwnMethod, Work
from ..records import EpisodeOptions

ROWS = 16
FRAMES = 240  # of an episode that is drawn, at most
MATERIALS = ("wood", "rubber", "steel", "iron")  # of geoms, in turn
Mode = Literal["forward", "reverse"]


@dataclass(frozen=True)
class Parameter:
    """Say which number of a MuJoCo model a parameter is, and its bounds [`unit`].

    `field` is qpos or qvel (of the initial state), ctrl (constant over each segment of the episode), or a field of the
    model: body_mass, geom_friction, dof_damping and others. `index` selects one of its numbers: a row, or the name of
    the body, geom, joint or actuator it belongs to. In a field with columns it is a pair of row and column.
    """

    name: str
    field: str
    index: int | str | Sequence[int | str]
    lower: float
    upper: float
    unit: str = ""


@dataclass(frozen=True)
class MjxOptions(EpisodeOptions):
    """How gradients are computed, and how contacts are solved.

    `mode`: forward differentiates forward, which the solver's loops need. reverse is cheaper for many parameters; with
    contacts it works only with `iterations=1`. `solver` of the constraints, its `iterations`, and those of its line
    search, `ls_iterations`; 0 takes the model's own.
    """

    mode: Mode = "forward"
    solver: Literal["newton", "cg"] = "newton"
    iterations: int = 0
    ls_iterations: int = 0


class MjxScene(Environment):
    """A scene that MuJoCo simulates in JAX.

    A scene derives from this class and defines: `mjcf`, a MuJoCo file or its text; `parameters`, the numbers that vary;
    `duration` [s]; `segments`, the number of segments with constant controls; and `loss_of(state)`, the loss of the
    last state, a JAX number, from its `qpos`, `qvel`, `xpos` and others. A row that ends in numbers that are not finite
    has failed. Loss and gradient come from two programs, so losses are the same with and without gradients. JAX's trace
    of an episode is cached for other processes, unless a class has its own `act`. A user's `loss_of` can read anything,
    so each process traces it.
    """

    model_version = 1
    mjcf: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    duration: ClassVar[float]
    segments: ClassVar[int] = 1
    engines: ClassVar[tuple[str, ...]] = ("mjx",)
    whole_batches = own_programs = True  # one point costs as much as a batch
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=1 / 250, precision="float64"),
        "standard": Fidelity("standard", dt=1 / 500, precision="float64"),
        "reference": Fidelity("reference", dt=1 / 4000, precision="float64"),
    }
    Options: ClassVar[type[Any]] = MjxOptions

    @abc.abstractmethod
    def loss_of(self, state: Any) -> Any:
        """Return the loss of the last state, traced by JAX: `mujoco.mjx.Data` of one row."""

    @property
    def preferred_batch(self) -> int:  # type: ignore[override] # read only
        """Number of points worth evaluating at once."""
        return min(ROWS, self._max_rows)

    @property
    def steps(self) -> int:
        """Number of time steps of an episode."""
        count: int = self._course.held * self._course.steps
        return count

    @property
    def time(self) -> float:
        """Duration of an episode [s]."""
        return self.steps * self.fidelity.dt

    def work(self) -> Work:
        """Count steps of bodies."""
        return Work(self.steps * max(1, self._model.host.nbody - 1), "body-step")

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return the poses of geoms during the episode at one point."""
        at, turn = self._model.frames(lambda row: self._rollout.frames(row), self._row(x)[0].numpy(), self._key)
        rows = np.unique(np.linspace(0, len(at) - 1, FRAMES).round().astype(int))
        time = torch.from_numpy(rows * self.fidelity.dt)
        return draw(time, torch.from_numpy(at[rows]), torch.from_numpy(turn[rows]), self._model.geoms())

    def act(self, model: Any, state: Any, control: Any) -> Any:
        """Return the state at the start of a segment with its controls, shape (actuator,)."""
        return state.replace(ctrl=control)

    def _setup(self) -> None:
        o, solver = self.options, self._engine("model")
        settings = solver.Settings(self.fidelity.dt, o.solver, o.iterations, o.ls_iterations)
        self._model = solver.Model(self.mjcf, settings, self.fidelity.precision, name=self.name)
        first = [one for one in self.parameters if one.field != "ctrl"]
        held = [one for one in self.parameters if one.field == "ctrl"]
        turns = [f"t{k} " for k in range(self.segments)] if self.segments > 1 else [""]
        names = [one.name for one in first] + [f"{turn}{one.name}" for turn in turns for one in held]
        bounds = [(one.lower, one.upper, one.unit) for one in (*first, *(held * self.segments))]
        self.space = ParameterSpace(names, *zip(*bounds, strict=True))
        places = tuple(self._model.find(one.field, one.index) for one in (*first, *held))
        each = round(self.duration / self.segments / self.fidelity.dt)
        count, steps = (1, o.count_steps(each)) if self.segments == 1 else (o.count_steps(self.segments), each)
        self._course = solver.Course(places, self.segments, count, steps, OwnMethod(self.act))
        known = _of_package(self.act, self._setup)
        self._key = self._model.identify(self._course, self.act.__qualname__) if known else ""
        vars(self).pop("_rollout", None)
        self._function = self._bind(solver)

    def _bind(self, solver: Any) -> Any:
        """Return the loss as a JAX function, cached: whole for our scenes, the episode alone for a user's."""
        how = (self.space.dim, self.name, self.fidelity.precision, self.preferred_batch, self.options.mode)
        kinds = [kind for kind in type(self).__mro__ if issubclass(kind, MjxScene)]
        if _of_package(*kinds, self.loss_of, self.act, self._setup):
            key = self._key and repr((self._key, type(self), self.options, self.fidelity))
            return solver.JaxFunction(OwnMethod(self._loss), *how, key=key)
        rollout = self._rollout  # refuses here and now what MJX cannot simulate
        if self._key and self.options.mode == "forward":
            at_end = self._engine("rollout").LossAtEnd
            return at_end(OwnMethod(self.loss_of), *how, key=self._key, rollout=rollout)
        return solver.JaxFunction(OwnMethod(self._loss), *how)

    @cached_property
    def _rollout(self) -> Any:
        """The rollout that MJX simulates; only tracing needs it."""
        return self._engine("rollout").Rollout(self._model, self._course)

    def _loss(self, x: Any) -> Any:
        return self.loss_of(self._rollout.end(x))

    def _prepare(self) -> None:
        for grad in (False, True):
            self._evaluate(self.space.center[None], grad=grad)

    def engine_call(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Callable[[], object]:
        """Return what calls MJX's compiled program alone, on points that JAX holds already."""
        call: Callable[[], object] = self._function.engine_call(x, grad=grad)
        return call

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        """Evaluate batches of one size only: programs for other sizes round in another order."""
        whole = torch.cat([x, x[-1:].expand(-len(x) % self.preferred_batch, -1)])
        loss, _, _ = self._function(whole, False)
        slope = self._function(whole, True)[1][: len(x)] if grad else None
        return Evaluation.from_results(loss[: len(x)], slope)


def _of_package(*code: Any) -> bool:
    """Say whether all classes and functions are from this package, whose files are part of the cache key."""
    return all(one.__module__.startswith(__package__.rpartition(".")[0] + ".") for one in code)


def draw(
    time: Float[Tensor, " frame"],
    at: Float[Tensor, "frame geom 3"],
    turn: Float[Tensor, "frame geom 3 3"],
    geoms: Sequence[Mapping[str, Any]],
) -> Episode:
    """Return the episode of moving geoms; MuJoCo's z is upwards, ours is y."""
    up = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
    at, turn = at @ up.T, up @ turn @ up.T
    parts, points = list[Part](), dict[str, Tensor]()
    for number, geom in enumerate(geoms):
        place, size = at[:, number : number + 1], geom["size"]
        material: Any = MATERIALS[number % len(MATERIALS)]
        if geom["shape"] == "sphere":
            parts.append(Part("sphere", material, place, (size[0],), turn[:, number]))
        elif geom["shape"] == "box":
            parts.append(Part("box", material, place, (2 * size[0], 2 * size[2], 2 * size[1]), turn[:, number]))
        elif geom["shape"] in ("capsule", "cylinder"):
            half = size[1] * turn[:, number, :, 1][:, None]  # along the geom's own z, which is our y
            parts.append(Part("path", material, torch.cat([place - half, place + half], dim=1), (size[0],)))
        else:
            continue
        points[f"{geom['shape']} {number}"] = place
    ground = any(geom["shape"] == "plane" for geom in geoms)
    return Episode(time, points, {}, tuple(parts), _view(at, geoms, ground))


def _view(at: Tensor, geoms: Sequence[Mapping[str, Any]], ground: bool) -> View:
    """Return a view of everything that moves, with a margin."""
    moving = [number for number, geom in enumerate(geoms) if geom["shape"] != "plane"]
    room = max(max(geoms[number]["size"]) for number in moving) * 2
    lower, upper = at[:, moving].amin(dim=(0, 1)) - room, at[:, moving].amax(dim=(0, 1)) + room
    return View(tuple(lower.tolist()), tuple(upper.tolist()), ground=0.0 if ground else None)
