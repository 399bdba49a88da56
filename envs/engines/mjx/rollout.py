"""Episodes of MuJoCo models in JAX: parameters in, the last state out, differentiable."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from ..jax_functions import JaxFunction, compiled, computing_in
from ..jax_programs import traced
from .model import AT_FIRST, CONTROL, Course, Model, Place, no_numbers

STAGES = np.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]])  # of Runge and Kutta: part, share


class Rollout:
    """Hold a model that is ready to be simulated."""

    def __init__(self, model: Model, course: Course) -> None:
        """Give a model to MJX, also while JAX traces.

        Raises ValueError where MJX cannot simulate it, or has no such field to vary.
        """
        self.course, self.controls = course, model.host.nu
        try:
            with computing_in(model.precision), jax.ensure_compile_time_eval():
                self.model = mjx.put_model(model.host)
                self.start = mjx.make_data(model.host)
        except NotImplementedError as error:
            raise ValueError(f"MJX cannot simulate the model {model.name}: {error}") from error
        for place, _ in course.places:
            if place not in (*AT_FIRST, CONTROL) and not hasattr(self.model, place):
                raise no_numbers(model.name, place)

    def end(self, x: Any) -> Any:
        """Return the last state of one parameter vector's episode, with bodies and geoms where they are then."""
        model, state, _ = self._walk(x, lambda model, state: None)
        return mjx.kinematics(model, state)

    def frames(self, x: Any) -> tuple[Any, Any]:
        """Return where geoms are [m] and how they are turned before each step and at the end.

        Shapes (frame, geom, 3) and (frame, geom, 3, 3).
        """

        def look(model: Any, state: Any) -> Any:
            seen = mjx.kinematics(model, state)
            return seen.geom_xpos, seen.geom_xmat

        model, state, seen = self._walk(x, look)
        last = look(model, state)
        at, turn = (
            jnp.concatenate([of.reshape(-1, *of.shape[2:]), one[None]]) for of, one in zip(seen, last, strict=True)
        )
        return at, turn

    def _walk(self, x: Any, look: Callable[[Any, Any], Any]) -> tuple[Any, Any, Any]:
        """Return the model, its last state, and what `look` sees before each step, shape (segment, step, ...)."""
        course = self.course
        model, start = self._begin(x, course.places)

        def hold(state: Any, control: Any) -> Any:
            state = course.act(model, state, control)
            return jax.lax.scan(lambda now, _: (step(model, now), look(model, now)), state, length=course.steps)

        state, seen = jax.lax.scan(hold, start, self._controls(x))
        return model, state, seen

    def _begin(self, x: Any, places: Sequence[Place]) -> tuple[Any, Any]:
        """Return the model and the state that parameters ask for, before the first step."""
        own = [place for place in places if place[0] != CONTROL]
        of_state, of_model = dict[str, Any](), dict[str, Any]()
        for number, (name, at) in enumerate(own):
            home, source = (of_state, self.start) if name in AT_FIRST else (of_model, self.model)
            home[name] = home.get(name, getattr(source, name)).at[at].set(x[number])
        model = self.model.replace(**of_model) if of_model else self.model
        return model, _on_parameters(self.start.replace(**of_state), x)

    def _controls(self, x: Any) -> Any:
        """Return the controls of every segment, shape (segment, actuator); those that no parameter sets are zero."""
        course = self.course
        own = [at[0] for name, at in course.places if name == CONTROL]
        whole = jnp.zeros((course.held, self.controls), dtype=x.dtype)
        if not own:
            return whole
        given = x[len(course.places) - len(own) :].reshape(course.segments, len(own))[: course.held]
        return whole.at[: len(given), jnp.array(own)].set(given)


@dataclass(eq=False)
class LossAtEnd(JaxFunction):
    """A loss of an episode's last state, `fn`, differentiated forward: the episode is kept, and the loss is not.

    The `key` says all that the episode comes from. What the loss reads nobody knows, and it is traced in each process.
    """

    rollout: Rollout = field(kw_only=True)

    def _compile(self, grad: bool, shape: tuple[int, int]) -> Callable[[Any], Any]:
        episode, loss = (self._push_end, self._push_loss) if grad else (self._end, self._loss)

        def whole(x: Any) -> Any:
            return jax.vmap(loss)(*traced(jax.vmap(episode), shape, self.precision, f"{self.key} {grad}")(x))

        return compiled(whole, shape, self.precision)

    def _end(self, x: Any) -> tuple[Any, ...]:
        """Return the last state: its real numbers, then its other ones."""
        real, other = self._split(self.rollout.end(x))
        return (*real, *other)

    def _push_end(self, x: Any) -> tuple[Any, ...]:
        """Return the real numbers of the last state, their tangents along each parameter, then its other numbers."""

        def along(direction: Any) -> Any:
            return jax.jvp(lambda x: self._split(self.rollout.end(x)), (x,), (direction,), has_aux=True)

        real, tangents, other = jax.vmap(along, out_axes=(None, 0, None))(jnp.eye(len(x), dtype=x.dtype))
        return (*real, *tangents, *other)

    def _loss(self, *numbers: Any) -> Any:
        count = sum(self._is_real)
        return self._one(self._join(numbers[:count], numbers[count:]))

    def _push_loss(self, *numbers: Any) -> Any:
        count = sum(self._is_real)
        real, tangents, other = numbers[:count], numbers[count : 2 * count], numbers[2 * count :]

        def along(direction: Any) -> Any:
            return jax.jvp(lambda real: self._one(self._join(real, other)), (real,), (direction,))

        return jax.vmap(along, out_axes=(None, 0))(tangents)

    def _split(self, state: Any) -> tuple[list[Any], list[Any]]:
        numbers = list(zip(jax.tree.leaves(state), self._is_real, strict=True))
        return [one for one, real in numbers if real], [one for one, real in numbers if not real]

    def _join(self, real: Iterable[Any], other: Iterable[Any]) -> Any:
        """Return the state with these numbers."""
        these, those = iter(real), iter(other)
        numbers = [next(these if real else those) for real in self._is_real]
        return jax.tree.unflatten(jax.tree.structure(self.rollout.start), numbers)

    @property
    def _is_real(self) -> list[bool]:
        return [bool(jnp.issubdtype(one.dtype, jnp.floating)) for one in jax.tree.leaves(self.rollout.start)]


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
