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
from .systems import CART, CHAIN, SPRINGS, cart, chain, numbered, springs

BOX = partial(gs.ParameterSpace.box, lower=-1, upper=1)
FALL = gs.ParameterSpace({"height": (0.8, 1.2, "m"), "speed": (-0.5, 0.5, "m/s")})
SWING = gs.ParameterSpace({"length": (0.5, 1.5, "m"), "damping": (0, 1, "1/s")})
stop = jax.lax.stop_gradient
case = partial(Case, "jax")


# ---- NaN beside a finite loss.


def pairs(p: Any) -> Any:
    """Energy of five particles: distances of all pairs, those of a particle to itself masked afterwards."""
    at = p.reshape(5, 2)
    apart = jnp.sqrt(((at[:, None] - at[None]) ** 2).sum(-1))
    return jnp.where(jnp.eye(5, dtype=bool), 0.0, (apart - 0.5) ** 2).sum()


norm, where = ("norm at zero",), ("where over NaN",)
nan = partial(case, "nan", evidence="nan")
off = gs.ParameterSpace({"x": (-0.5, 2, "m"), "y": (-1, 0.25, "m")})
two, angles, metres = BOX(["x1", "y1", "x2", "y2"]), BOX(["a", "b"], unit="rad"), BOX(["x", "y"], unit="m")
particles = BOX([f"{axis}{k}" for k in range(5) for axis in "xy"])
NAN = [
    # squared distance from a target at the origin, by way of a norm
    nan("length", lambda p: jnp.linalg.norm(p) ** 2, off, norm, place=(0.2, 0.8)),
    # energy of a spring between two particles: no derivative where they coincide
    nan("spring-pair", lambda p: (jnp.linalg.norm(p[:2] - p[2:]) - 0.7) ** 2, two, norm, place=(0.3, 0.6) * 2),
    # squared angle between two directions, by the arc cosine of their product
    nan("aligned", lambda p: jnp.arccos(jnp.cos(p[0]) * jnp.cos(p[1]) + jnp.sin(p[0]) * jnp.sin(p[1])) ** 2,
        angles, (*norm, *where), place=0.5),
    nan("pairs", pairs, particles, (*where, *norm)),
    # a tendon that pulls with the root of its stretch, and not when it is slack
    nan("tension", lambda p: (jnp.where(p[0] > 0.2, jnp.sqrt(p[0] - 0.2), 0.0) - 0.5) ** 2 + p[1] ** 2,
        BOX(["stretch", "slip"]), where, edges={"stretch": (0.2,)}, region=lambda x: x[:, 0] < 0.2),
    # losses in ten pipes, one with v^1.75 where it flows forwards
    nan("friction", lambda p: ((p - 0.4) ** 2).sum() + (jnp.where(p[4] > 0, p[4] ** 1.75, 0.0) - 0.3) ** 2,
        BOX(numbered("flow", 10)), where, edges={"flow 4": (0.0,)}, region=lambda x: x[:, 4] < 0),
    # variance of ten parameters, by way of their standard deviation, and their mean
    nan("spread", lambda p: jnp.std(p) ** 2 + (jnp.mean(p) - 0.3) ** 2, BOX([f"x{k}" for k in range(10)]), norm,
        place=0.5),
    # squared error of a heading, and a distance: no direction at the origin
    nan("heading", lambda p: 0.1 * jnp.sin(jnp.arctan2(p[1], p[0]) - 0.4) ** 2 * (p[0] ** 2 + p[1] ** 2)
        + (p[0] - 0.3) ** 2, metres, norm, place=0.5),
    # kinetic energy of a bead that turns round at both ends of the box, by way of its speed
    nan("turning-point", lambda p: (jnp.sqrt(1 - p[0] ** 2) ** 2 - 0.3) ** 2 + p[1] ** 2, BOX(["place", "slip"]),
        norm, place=(1.0, 0.5)),
]  # fmt: skip


# ---- Cut off: detached, truncated, snapped.


def pendulum(last: int | None = None) -> Callable[..., Any]:
    """Return a pendulum of a length and a damping that is differentiated through its last steps, or all."""

    def swing(p: Any, steps: int = 60) -> Any:
        def step(state: Any, k: Any) -> Any:
            angle, rate = state
            if last is not None:
                angle, rate = (jnp.where(k == steps - last, stop(one), one) for one in state)
            rate = rate + 0.02 * (-9.81 / p[0] * jnp.sin(angle) - p[1] * rate)
            return (angle + 0.02 * rate, rate), None

        (angle, _), _ = jax.lax.scan(step, (1.0 + 0 * p[0], 0 * p[0]), jnp.arange(steps))
        return (angle - 0.3) ** 2

    return swing


def drop(p: Any) -> Any:
    """Squared miss of a ball after a bounce [m²]: it turns round at the first step under the ground."""

    def step(state: Any, _: Any) -> Any:
        y, v = state
        v = v - 0.02 * 9.81
        y = y + 0.02 * v
        return (y, jnp.where((y < 0) & (v < 0), -0.8 * v, v)), None

    (y, _), _ = jax.lax.scan(step, (p[0], p[1]), None, length=32)
    return (y - 0.35) ** 2


detached = ("detached parameter",)
CUT = [
    case("detached", "chain-stopped", lambda p: chain(jnp, p.at[57].set(stop(p[57]))), CHAIN.space(100), detached,
         ("angle 57",), reference=partial(chain, np)),
    case("detached", "springs-stopped", lambda p: springs(jnp, jnp.stack([stop(p[0]), p[1]])), SPRINGS.space(2),
         detached, ("stiffness 0",)),
    case("truncated", "swing", pendulum(15), SWING, ("truncated loop",), said={"horizon": "steps"}),
    case("impact", "drop", drop, FALL, ("snapped time of impact",), warns=True, evidence="wide"),
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


start = gs.ParameterSpace({"angle": (-1.5, 1.5, "rad"), "rate": (-1, 1, "rad/s")})
population = gs.ParameterSpace({"growth": (3.7, 4.0), "start": (0.1, 0.9)})
forces, staircase = gs.ParameterSpace.box(numbered("force", 10), 0.5, 3, "N"), ("staircase",)
steps = {"draft": {"dt": 0.01, "steps": 100}, "standard": {"dt": 0.005, "steps": 200},
         "reference": {"dt": 0.00025, "steps": 4000}}  # fmt: skip
OTHERS = [
    case("unconverged", "relaxed", relaxed, forces, ("unconverged solver",)),
    case("late", "late", late, start, ("", "scaled", "sign", "truncated loop"), step=20,
         said={"horizon": "steps"}),
    case("chaos", "logistic", logistic, population, ("chaotic growth",), warns=True, evidence="growth",
         said={"horizon": "steps", "mode": "forward"}),
    case("physics", "stiff-ball", stiff_ball, FALL, ("discretisation",), warns=True, evidence="finer",
         said={"fidelities": steps}),
    case("staircase", "looked-up", looked_up, BOX(["valve", "lever"], lower=0), staircase, warns=True,
         evidence="wide"),
    # a cart whose forces are read by an encoder of 16 steps a newton
    case("staircase", "encoder", lambda p: cart(jnp, jnp.floor(p * 16) / 16), CART.space(10), staircase,
         warns=True, evidence="wide"),
]  # fmt: skip
CASES = [*NAN, *CUT, *OTHERS]
