"""The systems that defects are planted in: small simulations, written once for torch, JAX and NumPy.

Each takes the library and points, shape (..., dim), and returns losses, shape (...).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gradscape as gs

GRAVITY = 9.81  # [m/s²]
GAS_CONSTANT = 287.0  # of air [J/(kg K)]


@dataclass(frozen=True)
class System:
    """A loss, and its box for a number of parameters."""

    loss: Callable[[Any, Any], Any]
    space: Callable[[int], gs.ParameterSpace]


def throw(xp: Any, x: Any) -> Any:
    """Squared miss [m²] of a ball thrown at a target 8 m away, of its angle and its speed."""
    return (x[..., 1] ** 2 * xp.sin(2 * x[..., 0]) / GRAVITY - 8.0) ** 2


def gas(xp: Any, x: Any) -> Any:
    """Squared relative error of a gas's density, of its pressure and its temperature."""
    return (x[..., 0] / (GAS_CONSTANT * x[..., 1]) / 1.6 - 1) ** 2 + (x[..., 1] / 290 - 1) ** 2


def nozzle(xp: Any, x: Any) -> Any:
    """Squared relative error of the flow through a nozzle, of pressure, temperature and an area of some mm²."""
    flow = x[..., 2] * x[..., 0] / xp.sqrt(GAS_CONSTANT * x[..., 1])
    return (flow / 1.4e-3 - 1) ** 2


def springs(xp: Any, k: Any) -> Any:
    """Squared errors of the frequencies of masses on springs, and of the springs' mean stiffness."""
    count = k.shape[-1]
    mass = xp.asarray([1 + i / count for i in range(count)], dtype=k.dtype)
    wanted = xp.asarray([9 + 2 * math.sin(i) for i in range(count)], dtype=k.dtype)
    return ((xp.sqrt(k / mass) - wanted) ** 2).sum(-1) + 1e-3 * (k.sum(-1) / count - 130) ** 2


def cart(xp: Any, u: Any) -> Any:
    """Squared error of a cart's place after 2 s, and its effort, of forces that are held in turn."""
    count = u.shape[-1]
    dt = 2.0 / count
    place = speed = 0.0 * u[..., 0]
    for k in range(count):
        speed = speed + dt * (u[..., k] - 0.5 * speed)
        place = place + dt * speed
    return 4 * (place - 1) ** 2 + 0.1 * speed**2 + 0.05 * (u**2).sum(-1) / count


def pendulum(xp: Any, u: Any) -> Any:
    """Squared error of a pendulum's angle and rate after 1.5 s, of torques that are held in turn."""
    count = u.shape[-1]
    dt = 1.5 / count / 3
    angle, rate = 0.5 + 0.0 * u[..., 0], 0.0 * u[..., 0]
    for k in range(3 * count):
        rate = rate + dt * (u[..., k // 3] - GRAVITY * xp.sin(angle) - 0.2 * rate)
        angle = angle + dt * rate
    return (angle - 1) ** 2 + 0.2 * rate**2


def rod(xp: Any, q: Any) -> Any:
    """Mean squared error of the temperatures of a ring after 20 steps of conduction, of its heat sources."""
    count = q.shape[-1]
    wanted = xp.asarray(
        [math.sin(6 * math.pi * i / count) + 0.3 * math.cos(5 * i) for i in range(count)], dtype=q.dtype
    )
    heat = 0.0 * q
    for _ in range(20):
        heat = heat + 0.2 * (xp.roll(heat, 1, -1) - 2 * heat + xp.roll(heat, -1, -1)) + 0.1 * q
    return ((heat - wanted) ** 2).sum(-1)


def chain(xp: Any, a: Any) -> Any:
    """Squared miss of the end of a chain, and its bending, of the angles of its links."""
    count = a.shape[-1]
    bend = xp.roll(a, 1, -1) - a
    across, down = xp.sin(a).sum(-1) / count, xp.cos(a).sum(-1) / count
    weights = xp.asarray([1 + 0.5 * math.cos(i) for i in range(count)], dtype=a.dtype)
    return 10 * ((across - 0.4) ** 2 + (down - 0.7) ** 2) + (weights * bend**2).sum(-1) / count


def settle(rest: Any, force: Any, gain: float, sweeps: int) -> Any:
    """Let springs, of force z + z³ at a stretch of z, come to rest under a force, by so many sweeps."""
    for _ in range(sweeps):
        rest = rest - gain * (rest + rest**3 - force)
    return rest


def at_rest(rest: Any) -> tuple[Any, Any]:
    """Return the squared error of springs at rest, arrays of NumPy, and its derivative by the forces on them."""
    return ((rest - 0.4) ** 2).sum(1), 2 * (rest - 0.4) / (1 + 3 * rest**2)


def plate(xp: Any, k: Any) -> Any:
    """Squared error of what a square matrix of stiffnesses makes of a load."""
    size = math.isqrt(k.shape[-1])
    load = xp.asarray([1 + 0.7 * i for i in range(size)], dtype=k.dtype)
    wanted = xp.asarray([3 + math.sin(3 * i) for i in range(size)], dtype=k.dtype)
    force = (k.reshape((*k.shape[:-1], size, size)) * load).sum(-1) / size
    return ((force - wanted) ** 2).sum(-1)


def numbered(word: str, count: int) -> list[str]:
    """Return names of so many parameters."""
    return [f"{word} {k}" for k in range(count)]


def _box(word: str, lower: float, upper: float, unit: str) -> Callable[[int], gs.ParameterSpace]:
    return lambda dim: gs.ParameterSpace.box(numbered(word, dim), lower, upper, unit)


THROW = System(throw, lambda _: gs.ParameterSpace({"angle": (0.2, 1.3, "rad"), "speed": (4, 12, "m/s")}))
GAS = System(gas, lambda _: gs.ParameterSpace({"pressure": (1e5, 2e5, "Pa"), "temperature": (280, 320, "K")}))
NOZZLE = System(
    nozzle,
    lambda _: gs.ParameterSpace(
        {"pressure": (1e5, 2e5, "Pa"), "temperature": (280, 320, "K"), "area": (1e-6, 3e-6, "m²")}
    ),
)
SPRINGS = System(springs, _box("stiffness", 50, 150, "N/m"))
CART = System(cart, _box("force", -2, 3, "N"))
PENDULUM = System(pendulum, _box("torque", -3, 3, "N m"))
ROD = System(rod, _box("source", -1, 2, "W"))
CHAIN = System(chain, _box("angle", -1, 1.5, "rad"))
PLATE = System(plate, _box("stiffness", 0, 4, "N/m"))
