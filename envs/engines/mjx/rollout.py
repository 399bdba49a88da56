"""Episodes of MuJoCo models in JAX: parameters in, the last state out, differentiable."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from numpy.typing import NDArray
from platformdirs import user_cache_dir

from ..jax_functions import JaxFunction as JaxFunction
from ..jax_functions import compiled, computing_in

if jax.config.values.get("jax_compilation_cache_dir") is None:  # a scene takes long to compile
    jax.config.update("jax_compilation_cache_dir", user_cache_dir("gradscape") + "/jax")

AT_FIRST = ("qpos", "qvel")  # fields of the state that parameters set before the first step
CONTROL = "ctrl"
# What the first axis of a field counts, and so whose names its rows go by.
NAMED = {"body": mujoco.mjtObj.mjOBJ_BODY, "geom": mujoco.mjtObj.mjOBJ_GEOM, "jnt": mujoco.mjtObj.mjOBJ_JOINT}
NAMED |= {"actuator": mujoco.mjtObj.mjOBJ_ACTUATOR, "ctrl": mujoco.mjtObj.mjOBJ_ACTUATOR}
JOINTED = {"qpos": "jnt_qposadr", "qvel": "jnt_dofadr", "dof": "jnt_dofadr"}  # rows of these go by the names of joints
SOLVERS = {"newton": mujoco.mjtSolver.mjSOL_NEWTON, "cg": mujoco.mjtSolver.mjSOL_CG}
STAGES = np.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]])  # of Runge and Kutta: part, share

Place = tuple[str, tuple[int, ...]]  # a field, and which of its numbers
Act = Callable[[Any, Any, Any], Any]  # act(model, state, controls): the state with these controls


@dataclass(frozen=True)
class Course:
    """Say what an episode is made of.

    `places` are what parameters set, those of controls last; controls are given for `segments` and held for `steps`
    each. The episode has `held` segments: beyond those that are given controls are zero.
    """

    places: tuple[Place, ...]
    segments: int
    held: int
    steps: int
    act: Act


@dataclass(frozen=True)
class Settings:
    """Say how a model is simulated: step [s], and the solver of its constraints with its iterations, 0 for its own."""

    dt: float
    solver: str
    iterations: int
    ls_iterations: int


class Rollout:
    """Hold a model that is ready to be simulated."""

    def __init__(self, mjcf: str, settings: Settings, precision: str, *, name: str) -> None:
        """Load a model from a file, or from the text of one.

        Raises ValueError where MuJoCo cannot read the model, or MJX cannot simulate it.
        """
        self.name, self.precision = name, precision
        self.host = load(mjcf, name)
        self.host.opt.timestep = settings.dt
        self.host.opt.solver = SOLVERS[settings.solver]
        self.host.opt.iterations = settings.iterations or self.host.opt.iterations
        self.host.opt.ls_iterations = settings.ls_iterations or self.host.opt.ls_iterations
        try:
            with computing_in(precision):
                self.model = mjx.put_model(self.host)
                self.start = mjx.make_data(self.host)
        except NotImplementedError as error:
            raise ValueError(f"{name} holds what MJX cannot simulate: {error}") from error

    def find(self, field: str, index: int | str | Sequence[int | str]) -> Place:
        """Return the place of a parameter, whose index may be a name.

        Raises ValueError where the model has no such field, no such name, or fewer numbers.
        """
        shape = self._shape(field)
        parts = (index,) if isinstance(index, int | str) else tuple(index)
        numbers = tuple(self._number(field, part) if isinstance(part, str) else part for part in parts)
        if len(numbers) != len(shape) or any(not 0 <= n < size for n, size in zip(numbers, shape, strict=True)):
            raise ValueError(f"{self.name} has {field} of shape {shape}; got index {', '.join(map(str, parts))}")
        return field, numbers

    def _shape(self, field: str) -> tuple[int, ...]:
        if field in (*AT_FIRST, CONTROL):
            return tuple(np.shape(getattr(self.start, field)))
        value: Any = getattr(self.model, field, None)
        if not hasattr(value, "shape") or not jnp.issubdtype(value.dtype, jnp.floating):
            raise ValueError(
                f"{self.name} has no numbers {field!r} to vary; MuJoCo's are qpos, qvel, ctrl, and of the model "
                "body_mass, geom_friction, dof_damping and others"
            )
        return tuple(value.shape)

    def _number(self, field: str, name: str) -> int:
        """Return the row of a field that belongs to a named body, geom, joint or actuator."""
        family = field.partition("_")[0]
        kind = mujoco.mjtObj.mjOBJ_JOINT if family in JOINTED else NAMED.get(family)
        found = -1 if kind is None else mujoco.mj_name2id(self.host, kind, name)
        if found < 0:
            what = f"no {kind.name[6:].lower()} {name!r}" if kind else "no names"
            raise ValueError(f"{self.name} has {what} to find {field} by; give a number, or a name that is there")
        return int(getattr(self.host, JOINTED[family])[found]) if family in JOINTED else found

    def end(self, x: Any, course: Course) -> Any:
        """Return the last state of one parameter vector's episode, with bodies and geoms where they are then."""
        model, state, _ = self._walk(x, course, lambda model, state: None)
        return mjx.kinematics(model, state)

    def frames(self, x: NDArray[np.float64], course: Course) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return where geoms are [m] and how they are turned before each step and at the end.

        Shapes (frame, geom, 3) and (frame, geom, 3, 3).
        """
        with computing_in(self.precision):
            frames = compiled(partial(self._frames, course=course), x.shape, self.precision)
            at, turn = frames(jnp.asarray(x, dtype=self.precision))
        return np.asarray(at, dtype=np.float64), np.asarray(turn, dtype=np.float64)

    def _frames(self, x: Any, course: Course) -> Any:
        def look(model: Any, state: Any) -> Any:
            seen = mjx.kinematics(model, state)
            return seen.geom_xpos, seen.geom_xmat

        model, state, seen = self._walk(x, course, look)
        last = look(model, state)
        return tuple(
            jnp.concatenate([of.reshape(-1, *of.shape[2:]), one[None]]) for of, one in zip(seen, last, strict=True)
        )

    def _walk(self, x: Any, course: Course, look: Callable[[Any, Any], Any]) -> tuple[Any, Any, Any]:
        """Return the model, its last state, and what `look` sees before each step, shape (segment, step, ...)."""
        model, start = self._begin(x, course.places)

        def hold(state: Any, control: Any) -> Any:
            state = course.act(model, state, control)
            return jax.lax.scan(lambda now, _: (step(model, now), look(model, now)), state, length=course.steps)

        state, seen = jax.lax.scan(hold, start, self._controls(x, course))
        return model, state, seen

    def _begin(self, x: Any, places: Sequence[Place]) -> tuple[Any, Any]:
        """Return the model and the state that parameters ask for, before the first step."""
        own = [place for place in places if place[0] != CONTROL]
        of_state, of_model = dict[str, Any](), dict[str, Any]()
        for number, (field, at) in enumerate(own):
            home, source = (of_state, self.start) if field in AT_FIRST else (of_model, self.model)
            home[field] = home.get(field, getattr(source, field)).at[at].set(x[number])
        model = self.model.replace(**of_model) if of_model else self.model
        return model, _on_parameters(self.start.replace(**of_state), x)

    def _controls(self, x: Any, course: Course) -> Any:
        """Return the controls of every segment, shape (segment, actuator); those that no parameter sets are zero."""
        own = [at[0] for field, at in course.places if field == CONTROL]
        whole = jnp.zeros((course.held, self.host.nu), dtype=x.dtype)
        if not own:
            return whole
        given = x[len(course.places) - len(own) :].reshape(course.segments, len(own))[: course.held]
        return whole.at[: len(given), jnp.array(own)].set(given)

    def geoms(self) -> list[Mapping[str, Any]]:
        """Return shape and size [m] of every geom."""
        kinds = [mujoco.mjtGeom(kind).name[7:].lower() for kind in self.host.geom_type]
        return [{"shape": kind, "size": tuple(size)} for kind, size in zip(kinds, self.host.geom_size, strict=True)]


def load(mjcf: str, name: str) -> Any:
    """Return MuJoCo's model of a file, or of the text of one. Raises ValueError where it cannot be read."""
    try:
        if "<" in mjcf:
            return mujoco.MjModel.from_xml_string(mjcf)
        if not Path(mjcf).is_file():
            raise ValueError(f"there is no file {mjcf}")
        return mujoco.MjModel.from_xml_path(mjcf)
    except ValueError as error:
        raise ValueError(f"{name} has a model that MuJoCo cannot read: {' '.join(str(error).split())}") from error


def step(model: Any, state: Any) -> Any:
    """Return the state a time step later, as `mjx.step` does.

    That writes Runge and Kutta's four calls of `mjx.forward` one after another, and each is traced and compiled for
    itself. Here they are one loop, where positions are numbers that velocities add to: without joints that turn about
    any axis, and without actuators that have a state of their own.
    """
    if model.opt.integrator == mjx.IntegratorType.RK4 and model.nq == model.nv and not model.na:
        return runge_kutta(model, state)
    return mjx.step(model, state)


def runge_kutta(model: Any, start: Any) -> Any:
    """Return the state a time step later, by the classical method of Runge and Kutta."""
    dt, none = model.opt.timestep, jnp.zeros_like(start.qvel)

    def stage(carry: Any, numbers: Any) -> Any:
        now, speed, push = carry
        part, share = numbers
        qpos, qvel = start.qpos + dt * (part * now.qvel), start.qvel + dt * (part * now.qacc)
        now = mjx.forward(model, now.replace(qpos=qpos, qvel=qvel, time=start.time + part * dt))
        return (now, speed + share * now.qvel, push + share * now.qacc), None

    (last, speed, push), _ = jax.lax.scan(stage, (start, none, none), STAGES)
    qpos, qvel = start.qpos + dt * speed, start.qvel + dt * push
    return last.replace(qpos=qpos, qvel=qvel, time=start.time + dt, qacc_warmstart=last.qacc)


def _on_parameters(state: Any, x: Any) -> Any:
    """Return the same numbers, as numbers that depend on parameters.

    Most come to depend on them in the course of an episode, and JAX traces each loop again until it knows which.
    """
    none = 0.0 * x[0]
    return jax.tree.map(lambda leaf: leaf + none if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, state)


def kick(model: Any, state: Any, dof: int, speed: Any) -> Any:
    """Return the state whose degree of freedom `dof` has a speed at once, as an impulse on it alone would make it."""
    state = mjx.crb(model, mjx.com_pos(model, mjx.kinematics(model, state)))  # all that masses depend on
    unit = jnp.zeros_like(state.qvel).at[dof].set(1.0)
    answer = jnp.linalg.solve(mjx.full_m(model, state), unit)
    return state.replace(qvel=state.qvel + answer * (speed - state.qvel[dof]) / answer[dof])
