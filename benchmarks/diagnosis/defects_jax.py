"""Defects as people write them in JAX."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import gradscape as gs

from .cases import Case
from .systems import CART, CHAIN, SPRINGS, cart, chain, springs

BOX = partial(gs.ParameterSpace.box, lower=-1, upper=1)
FALL = gs.ParameterSpace({"height": (0.8, 1.2, "m"), "speed": (-0.5, 0.5, "m/s")})
SWING = gs.ParameterSpace({"length": (0.5, 1.5, "m"), "damping": (0, 1, "1/s")})
stop = jax.lax.stop_gradient


def case(
    kind: str, dim: int, fn: Callable[..., Any], space: gs.ParameterSpace, causes: tuple[str, ...], **how: Any
) -> Case:
    """Return a case of a function of JAX; `how` are fields of `Case`, and `said` keywords of `from_jax`."""
    said = how.pop("said", {})
    name = f"{kind.replace(' ', '-')}-jax-{fn.__name__.replace('_', '-')}-{dim}"
    return Case(name, kind, "jax", dim, lambda: gs.from_jax(fn, space, name=name, **said), causes, **how)


# ---- NaN beside a finite loss.


def length(p: Any) -> Any:
    """Squared distance from a target at the origin, by way of a norm."""
    return jnp.linalg.norm(p) ** 2


def spring_pair(p: Any) -> Any:
    """Energy of a spring between two particles: no derivative where they coincide."""
    return (jnp.linalg.norm(p[:2] - p[2:]) - 0.7) ** 2


def aligned(p: Any) -> Any:
    """Squared angle between two directions, by the arc cosine of their product."""
    return jnp.arccos(jnp.cos(p[0]) * jnp.cos(p[1]) + jnp.sin(p[0]) * jnp.sin(p[1])) ** 2


def pairs(p: Any) -> Any:
    """Energy of five particles: distances of all pairs, those of a particle to itself masked afterwards."""
    at = p.reshape(5, 2)
    apart = jnp.sqrt(((at[:, None] - at[None]) ** 2).sum(-1))
    return jnp.where(jnp.eye(5, dtype=bool), 0.0, (apart - 0.5) ** 2).sum()


def tension(p: Any) -> Any:
    """A tendon that pulls with the root of its stretch, and not when it is slack."""
    return (jnp.where(p[0] > 0.2, jnp.sqrt(p[0] - 0.2), 0.0) - 0.5) ** 2 + p[1] ** 2


def friction(p: Any) -> Any:
    """Losses in ten pipes, one with v^1.75 where it flows forwards."""
    loss = jnp.where(p[4] > 0, p[4] ** 1.75, 0.0)
    return ((p - 0.4) ** 2).sum() + (loss - 0.3) ** 2


def turning_point(p: Any) -> Any:
    """Kinetic energy of a bead that turns round at both ends of the box, by way of its speed."""
    speed = jnp.sqrt(1 - p[0] ** 2)
    return (speed**2 - 0.3) ** 2 + p[1] ** 2


def spread(p: Any) -> Any:
    """Variance of ten parameters, by way of their standard deviation, and their mean."""
    return jnp.std(p) ** 2 + (jnp.mean(p) - 0.3) ** 2


def heading(p: Any) -> Any:
    """Squared error of a heading, and a distance: no direction at the origin."""
    return 0.1 * jnp.sin(jnp.arctan2(p[1], p[0]) - 0.4) ** 2 * (p[0] ** 2 + p[1] ** 2) + (p[0] - 0.3) ** 2


def _nan() -> list[Case]:
    norm, where = ("norm at zero",), ("where over NaN",)
    particles = BOX([f"{axis}{k}" for k in range(5) for axis in "xy"])
    off = gs.ParameterSpace({"x": (-0.5, 2, "m"), "y": (-1, 0.25, "m")})
    return [
        case("nan", 2, length, off, norm, evidence="nan", place=(0.2, 0.8)),
        case("nan", 4, spring_pair, BOX(["x1", "y1", "x2", "y2"]), norm, evidence="nan", place=(0.3, 0.6, 0.3, 0.6)),
        case("nan", 2, aligned, BOX(["a", "b"], unit="rad"), (*norm, *where), evidence="nan", place=0.5),
        case("nan", 10, pairs, particles, (*where, *norm), evidence="nan"),
        case("nan", 2, tension, BOX(["stretch", "slip"]), where, edges={"stretch": (0.2,)},
             region=lambda x: x[:, 0] < 0.2, evidence="nan"),
        case("nan", 10, friction, BOX([f"flow {k}" for k in range(10)]), where, edges={"flow 4": (0.0,)},
             region=lambda x: x[:, 4] < 0, evidence="nan"),
        case("nan", 10, spread, BOX([f"x{k}" for k in range(10)]), norm, evidence="nan", place=0.5),
        case("nan", 2, heading, BOX(["x", "y"], unit="m"), norm, evidence="nan", place=0.5),
        case("nan", 2, turning_point, BOX(["place", "slip"]), norm, evidence="nan", place=(1.0, 0.5)),
    ]  # fmt: skip


# ---- Cut off: detached, truncated, snapped.


def chain_stopped(p: Any) -> Any:
    """A chain, one link of which is held by stop_gradient."""
    return chain(jnp, p.at[57].set(stop(p[57])))


def springs_stopped(p: Any) -> Any:
    """Springs, the first of which is held by stop_gradient."""
    return springs(jnp, jnp.stack([stop(p[0]), p[1]]))


def swing(p: Any, steps: int = 60) -> Any:
    """A pendulum differentiated through its last 15 steps only."""

    def step(state: Any, k: Any) -> Any:
        angle, rate = state
        cut = k == steps - 15
        angle, rate = jnp.where(cut, stop(angle), angle), jnp.where(cut, stop(rate), rate)
        rate = rate + 0.02 * (-9.81 / p[0] * jnp.sin(angle) - p[1] * rate)
        return (angle + 0.02 * rate, rate), None

    (angle, _), _ = jax.lax.scan(step, (1.0 + 0 * p[0], 0 * p[0]), jnp.arange(steps))
    return (angle - 0.3) ** 2


def drop(p: Any) -> Any:
    """Squared miss of a ball after a bounce [m²]: it turns round at the first step under the ground."""

    def step(state: Any, _: Any) -> Any:
        y, v = state
        v = v - 0.02 * 9.81
        y = y + 0.02 * v
        return (y, jnp.where((y < 0) & (v < 0), -0.8 * v, v)), None

    (y, _), _ = jax.lax.scan(step, (p[0], p[1]), None, length=32)
    return (y - 0.35) ** 2


def _cut() -> list[Case]:
    return [
        case("detached", 100, chain_stopped, CHAIN.space(100), ("detached parameter",), parameters=("angle 57",),
             reference=lambda x: chain(np, x)),
        case("detached", 2, springs_stopped, SPRINGS.space(2), ("detached parameter",), parameters=("stiffness 0",)),
        case("truncated", 2, swing, SWING, ("truncated loop",), said={"horizon": "steps"}),
        case("impact", 2, drop, FALL, ("snapped time of impact",), warns=True, evidence="wide"),
    ]  # fmt: skip


# ---- Solvers, steps and physics.


def relaxed(p: Any, iterations: int = 5) -> Any:
    """Squared error of springs at rest: an implicit derivative where the solver has not arrived."""
    rest = jax.lax.fori_loop(0, iterations, lambda _, z: z - 0.15 * (z + z**3 - p), 0 * p)
    rest = stop(rest)
    rest = rest + (p - stop(p)) / (1 + 3 * rest**2)
    return ((rest - 0.4) ** 2).sum()


@jax.custom_jvp
def _pull(angle: Any, late: Any) -> Any:
    return jnp.sin(angle)


@_pull.defjvp
def _pull_tangent(primals: Any, tangents: Any) -> Any:
    angle, late = primals
    return jnp.sin(angle), jnp.where(late, -0.5, 1.0) * jnp.cos(angle) * tangents[0]


def late(p: Any, steps: int = 60) -> Any:
    """A pendulum whose derivative is wrong after step 20."""

    def step(state: Any, k: Any) -> Any:
        angle, rate = state
        rate = rate - 0.02 * 9.81 * _pull(angle, (k >= 20).astype(angle.dtype))
        return (angle + 0.02 * rate, rate), None

    (angle, _), _ = jax.lax.scan(step, (p[0], p[1]), jnp.arange(steps))
    return (angle - 0.5) ** 2


def logistic(p: Any, steps: int = 60) -> Any:
    """A population after 60 generations, of its growth and its start: chaos."""
    z = jax.lax.fori_loop(0, steps, lambda _, z: p[0] * z * (1 - z), p[1])
    return (z - 0.5) ** 2


def stiff_ball(p: Any, dt: float = 0.01, steps: int = 100) -> Any:
    """Squared miss of a ball that slides into a stiff contact [m²], after 1 s."""

    def step(state: Any, _: Any) -> Any:
        y, v = state
        v = v + dt * (-9.81 + jnp.where(y < 0, -2e4 * y - 5 * v, 0.0))
        return (y + dt * v, v), None

    (y, _), _ = jax.lax.scan(step, (p[0], p[1]), None, length=steps)
    return (y - 0.5) ** 2


def looked_up(p: Any) -> Any:
    """A valve's characteristic, looked up in a table without interpolation."""
    flow = jnp.linspace(0, 1, 33)[jnp.clip((p[0] * 32).astype(int), 0, 32)] ** 2
    return (flow - 0.4) ** 2 + 0 * p.sum() + jnp.floor(20 * p[1]) / 20


def encoder(p: Any) -> Any:
    """A cart whose forces are read by an encoder of 16 steps a newton."""
    return cart(jnp, jnp.floor(p * 16) / 16)


def _others() -> list[Case]:
    start = gs.ParameterSpace({"angle": (-1.5, 1.5, "rad"), "rate": (-1, 1, "rad/s")})
    population = gs.ParameterSpace({"growth": (3.7, 4.0), "start": (0.1, 0.9)})
    forces = gs.ParameterSpace.box([f"force {k}" for k in range(10)], 0.5, 3, "N")
    steps = {"draft": {"dt": 0.01, "steps": 100}, "standard": {"dt": 0.005, "steps": 200},
             "reference": {"dt": 0.00025, "steps": 4000}}  # fmt: skip
    return [
        case("unconverged", 10, relaxed, forces, ("unconverged solver",)),
        case("late", 2, late, start, ("", "scaled", "sign", "truncated loop"), step=20, said={"horizon": "steps"}),
        case("chaos", 2, logistic, population, ("chaotic growth",), warns=True, evidence="growth",
             said={"horizon": "steps", "mode": "forward"}),
        case("physics", 2, stiff_ball, FALL, ("discretisation",), warns=True, evidence="finer",
             said={"fidelities": steps}),
        case("staircase", 2, looked_up, BOX(["valve", "lever"], lower=0), ("staircase",), warns=True, evidence="wide"),
        case("staircase", 10, encoder, CART.space(10), ("staircase",), warns=True, evidence="wide"),
    ]  # fmt: skip


def cases() -> list[Case]:
    """Return the cases of this file."""
    return [*_nan(), *_cut(), *_others()]
