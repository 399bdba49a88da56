"""Functions with right gradients that are awkward to judge: none of them may fail."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch
import warp as wp

import gradscape as gs

from .cases import Case, Losses
from .defects_jax import SWING, logistic, pendulum
from .defects_warp import FORCES, empty, of_kernel
from .plant import right
from .systems import CART, CHAIN, GAS, NOZZLE, ROD, THROW, at_rest, cart, chain, gas, nozzle, numbered, rod, throw

PLANE = gs.ParameterSpace({"a": (-1, 1), "b": (-1, 1)})
UNIT = gs.ParameterSpace({"a": (0, 1), "b": (0, 1)})
TEN = gs.ParameterSpace.box([f"x{k}" for k in range(10)], -1, 1)


def case(
    framework: str, word: str, fn: Callable[..., Any], space: gs.ParameterSpace = PLANE, *,
    reference: Losses | None = None, place: float | tuple[float, ...] | None = None, **said: Any,
) -> Case:  # fmt: skip
    """Return the case of a healthy function; `said` are keywords of its `from_...`."""
    return Case(framework, "healthy", word, fn, space, reference=reference, place=place, said=said)


# ---- Polynomials, kinks, offsets and scales.


def hinge(x: Any) -> Any:
    """A spring that acts when it is compressed, with its own gradient."""
    depth = np.maximum(x[:, 0], 0)
    return depth**2 + 0.1 * np.abs(x[:, 1]), np.stack([2 * depth, 0.1 * np.sign(x[:, 1])], 1)


scales = gs.ParameterSpace({"small": (-1e-9, 1e-9, "m"), "large": (-1e9, 1e9, "Pa")})
far = gs.ParameterSpace({"x": (-1e6, 1e6, "m"), "y": (-1e6, 1e6, "m")})
rosen = lambda x: (100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1 - x[:, :-1]) ** 2).sum(1)  # noqa: E731
PLAIN = [
    case("torch", "drag", lambda x: (x * x.abs()).sum(1)),
    case("torch", "cubic", lambda x: (x**3).sum(1)),
    case("torch", "power-1.5", lambda x: x.abs().pow(1.5).sum(1)),
    case("torch", "maximum", lambda x: torch.maximum(x[:, 0], x[:, 1]) + 0.1 * (x**2).sum(1)),
    case("jax", "minimum", lambda p: jnp.min(p**2) + jnp.max(p), TEN),
    case("jax", "safe-norm", lambda p: jnp.sqrt(jnp.sum(p**2) + 1e-12)),
    case("torch", "offset-1e9", lambda x: 1e9 + (x**2).sum(1)),
    case("jax", "offset-1e8", lambda p: 1e8 + jnp.sum(jnp.sin(3 * p)), TEN),
    case("torch", "float32-inside", lambda x: ((x.float() - 0.3) ** 2).sum(1),
         reference=lambda x: ((x - 0.3) ** 2).sum(1)),
    case("torch", "float32-offset", lambda x: (1000 + torch.sin(2 * x[:, 0]) + x[:, 1] ** 2).float(),
         reference=lambda x: np.sin(2 * x[:, 0]) + x[:, 1] ** 2),
    case("jax", "float32-offset", lambda p: 1000 + jnp.sum((p - 0.3) ** 2), TEN, precision="float32",
         reference=lambda x: ((x - 0.3) ** 2).sum(1)),
    case("torch", "decades", lambda x: torch.exp(20 * x[:, 0]) + x[:, 1] ** 2),
    case("torch", "scales", lambda x: (1e9 * x[:, 0] - 0.3) ** 2 + (1e-9 * x[:, 1] + 0.2) ** 2, scales),
    case("torch", "tiny", lambda x: 1e-17 * ((x - 0.3) ** 2).sum(1)),
    case("jax", "huge", lambda p: 1e20 * jnp.sum((p - 0.3) ** 2), TEN),
    case("torch", "abs", lambda x: (x - 0.2).abs().sum(1)),
    case("numpy", "hinge", hinge),
    case("torch", "jump", lambda x: torch.where(x[:, 0] > 0.3, x[:, 0] + 1, x[:, 0]) + x[:, 1] ** 2),
    case("torch", "constant", lambda x: 3.0 + 0 * x.sum(1)),
    case("jax", "linear", lambda p: 2 * p[0] - 3 * p[1] + 0.5),
    case("torch", "one", lambda x: torch.sin(3 * x[:, 0]), gs.ParameterSpace({"a": (-2, 2)})),
    case("torch", "rosenbrock", rosen, TEN),
    case("torch", "far", lambda x: (1 + (x**2).sum(1)).sqrt() + 0.1 * x[:, 0], far),
    case("torch", "outside", lambda x: ((x - 1.5) ** 2).sum(1).sqrt()),
    case("torch", "maximized", lambda x: (x * (1 - x)).sum(1), UNIT, maximize=True),
]  # fmt: skip


# ---- Wells, plateaus, staircases, ripples, saturation.

SHAPES = np.random.default_rng(7)
W1, B1, W2 = SHAPES.normal(size=(24, 10)), SHAPES.normal(size=24), SHAPES.normal(size=24) / 5


def relu_network(x: Any) -> Any:
    """A network of 24 ReLU units."""
    hidden = torch.relu(x @ torch.from_numpy(W1.T) + torch.from_numpy(B1))
    return (hidden @ torch.from_numpy(W2) - 0.5) ** 2


def count_and_dose(x: Any) -> Any:
    """A whole number of doses, and their size."""
    count = np.floor(x[:, 0])
    miss = count * x[:, 1] - 2
    return miss**2, np.stack([0 * miss, 2 * miss * count], 1)


def barrier(x: Any) -> Any:
    """A log-barrier, infinite where it is violated."""
    slack = x[:, 0] + 0.4
    return torch.where(slack > 0, -0.1 * torch.log(slack.clamp(min=1e-9)), torch.inf) + (x**2).sum(1)


def fails(p: Any) -> Any:
    """A fit whose solver gives up in a corner of the box."""
    if p[0] + p[1] > 1.2:
        raise RuntimeError("the solver did not converge")
    return ((p - 0.4) ** 2).sum(), 2 * (p - 0.4)


HEIGHTS = SHAPES.normal(size=12)


def terrain(x: Any) -> Any:
    """Height of a terrain that is interpolated linearly between twelve posts."""
    at = (x[:, 0] + 1) * 5.5
    left = np.clip(np.floor(at).astype(int), 0, 10)
    rise = HEIGHTS[left + 1] - HEIGHTS[left]
    height = HEIGHTS[left] + (at - left) * rise
    return height + x[:, 1] ** 2, np.stack([5.5 * rise, 2 * x[:, 1]], 1)


def wiggle(p: Any) -> Any:
    """A cubic with ripples that get shorter towards zero."""
    safe = jnp.where(p[0] == 0, 1.0, p[0])
    return jnp.where(p[0] == 0, 0.0, safe**3 * jnp.sin(1 / safe)) + p[1] ** 2


late = gs.ParameterSpace({"time": (1e6, 1e6 + 1e-3, "s"), "x": (-1, 1)})
hundred = gs.ParameterSpace.box(numbered("gap", 100), -1, 1, "mm")
STEEP = [
    case("torch", "steep", lambda x: torch.tanh(1e3 * (x[:, 0] - 0.1)) + x[:, 1] ** 2),
    case("torch", "peak", lambda x: 1e-3 / (((x - 0.3) ** 2).sum(1) + 1e-6)),
    case("jax", "pole", lambda p: jnp.tan(2 * p[0]) + p[1] ** 2),
    case("jax", "sorted", lambda p: jnp.dot(jnp.sort(p), jnp.arange(10.0)) + jnp.median(p), TEN),
    case("torch", "sawtooth", lambda x: torch.remainder(x[:, 0], 0.3) + 0.2 * x[:, 1] ** 2),
    case("torch", "limited", lambda x: (x.clamp(-0.9, 0.6) - 0.2).pow(2).sum(1)),
    case("numpy", "terrain", terrain),
    case("torch", "contacts", lambda x: torch.relu(x - 0.3).sum(1) + 0.5 * torch.relu(-x - 0.2).sum(1), hundred),
    case("jax", "wiggle", wiggle),
    case("torch", "late", lambda x: torch.sin(3e3 * (x[:, 0] - 1e6)) + x[:, 1] ** 2, late),
    case("torch", "gas-float32", partial(gas, torch), GAS.space(2), precision="float32",
         reference=partial(gas, np)),
    case("jax", "nozzle-float32", partial(nozzle, jnp), NOZZLE.space(3), precision="float32",
         reference=partial(nozzle, np)),
    case("torch", "cart-float32", partial(cart, torch), CART.space(100), precision="float32",
         reference=partial(cart, np)),
    case("torch", "throw-float32", partial(throw, torch), THROW.space(2), precision="float32",
         reference=partial(throw, np)),
    case("torch", "log-loss", lambda x: torch.log10(1e-6 + ((x - 0.3) ** 2).sum(1))),
]  # fmt: skip


hundred = gs.ParameterSpace.box([f"x{k}" for k in range(100)], -1, 1)
three = gs.ParameterSpace.box([f"x{k}" for k in range(300)], -1, 1)
whole = gs.ParameterSpace({"n": (0, 9), "m": (0, 9)})
doses = gs.ParameterSpace({"count": (1, 9), "dose": (0.1, 1, "mg")})
decades = gs.ParameterSpace({"k": gs.log(1e-2, 1e6, "N/m"), "c": (0, 5, "N s/m")})
SHAPES = [
    case("torch", "well", lambda x: 1 - torch.exp(-200 * ((x - 0.6) ** 2).sum(1)), place=0.78),
    case("jax", "narrow-well", lambda p: -jnp.exp(-50 * jnp.sum((p - 0.2) ** 2)), TEN, place=0.62),
    case("torch", "plateau", lambda x: (torch.relu(x - 0.5) ** 2).sum(1), place=0.9),
    case("torch", "stairs", lambda x: ((x.round() - 3) ** 2).sum(1) + 0 * x.sum(1), whole, place=0.42),
    case("numpy", "count-and-dose", count_and_dose, doses, place=0.4),
    case("jax", "dead", lambda p: (p[0] - 0.3) ** 2 + 0 * p[1]),
    case("torch", "relu-network", relu_network, TEN),
    case("torch", "ripples-1e-3", lambda x: (x**2).sum(1) + 1e-3 * torch.sin(3e4 * x[:, 0])),
    case("jax", "ripples-1e-6", lambda p: jnp.sum(p**2) + 1e-6 * jnp.sin(1e6 * p[0])),
    case("jax", "softmax", lambda p: jnp.sum(jax.nn.softmax(60 * p) * jnp.arange(10.0)), TEN),
    case("torch", "saturated", lambda x: cart(torch, 2 * torch.tanh(8 * x)), TEN),
    case("torch", "barrier", barrier, place=0.6),
    case("numpy", "fails", fails, UNIT, vectorized=False, place=0.3),
    case("torch", "sparse", lambda x: (x[:, 13] - 0.3) ** 2 + x[:, 13] * x[:, 71] + torch.sin(2 * x[:, 71]), hundred),
    case("jax", "sparse", lambda p: jnp.sin(3 * p[5]) + p[5] * p[90], hundred),
    case("torch", "300", lambda x: torch.log1p((x**2).sum(1)) + 0.1 * torch.sin(3 * x).sum(1), three),
    case("jax", "periodic", lambda p: jnp.sum(jnp.cos(5 * jnp.pi * p)), TEN),
    case("numpy", "rastrigin", lambda x: ((x**2 - np.cos(9 * x)).sum(1), 2 * x + 9 * np.sin(9 * x)), TEN),
    case("torch", "log-scale", lambda x: (x[:, 1] / (2 * x[:, 0].sqrt()) - 1) ** 2, decades),
]


# ---- Simulations.


def double_pendulum(p: Any, steps: int = 300) -> Any:
    """A double pendulum of equal rods, let go at two angles."""

    def step(state: Any, _: Any) -> Any:
        a, b, v, w = state
        c, s = jnp.cos(a - b), jnp.sin(a - b)
        low = 2 - c**2
        dv = (-s * (w**2 + v**2 * c) - 9.81 * (2 * jnp.sin(a) - jnp.sin(b) * c)) / low
        dw = (s * (2 * v**2 + w**2 * c) + 9.81 * 2 * (jnp.sin(a) * c - jnp.sin(b))) / low
        v, w = v + 0.01 * dv, w + 0.01 * dw
        return (a + 0.01 * v, b + 0.01 * w, v, w), None

    (a, b, _, _), _ = jax.lax.scan(step, (p[0], p[1], 0 * p[0], 0 * p[1]), None, length=steps)
    return jnp.sin(a) ** 2 + jnp.cos(b)


def soft_contact(x: Any) -> Any:
    """A ball on a damped penalty ground, with 8 substeps a step."""
    y, v = x[:, 0], x[:, 1]
    for _ in range(40):
        for _ in range(8):
            v = v + 0.0025 * (-9.81 + torch.relu(-y) * (800 - 20 * v))
            y = y + 0.0025 * v
    return (y - 0.3) ** 2


def exact_bounce(x: Any) -> Any:
    """A ball whose time of impact is solved for: right through the bounce."""
    y, v, g = x[:, 0], x[:, 1], 9.81
    hit = (v + torch.sqrt(v**2 + 2 * g * y)) / g
    up, left = 0.8 * (g * hit - v), 0.7 - hit
    return (up * left - 0.5 * g * left**2 - 0.2) ** 2


def stiff(x: Any) -> Any:
    """A stiff spring and a soft one, explicitly and below the limit of stability."""
    y, v, z, w = x[:, 0], 0 * x[:, 0], x[:, 1], 0 * x[:, 1]
    for _ in range(100):
        v, w = v - 1e-3 * (1e6 * y + 20 * v), w - 1e-3 * 40 * z
        y, z = y + 1e-3 * v, z + 1e-3 * w
    return (y - 0.1) ** 2 + (z - 0.4) ** 2


def implicit(x: Any) -> Any:
    """Springs at rest up to 1e-8, and their implicit derivative."""
    rest = 0 * x
    for _ in range(200):
        residual = rest + rest**3 - x
        if np.abs(residual).max() < 1e-8:
            break
        rest = rest - residual / (1 + 3 * rest**2)
    return at_rest(rest)


def unrolled(p: Any) -> Any:
    """Springs at rest by 12 steps of Newton's method, differentiated through all of them."""
    z = 0.5 * p
    for _ in range(12):
        z = z - (z + z**3 - p) / (1 + 3 * z**2)
    return jnp.sum((z - 0.4) ** 2)


def seeded(p: Any, key: Any = None) -> Any:
    """A miss with a disturbance that each seed draws."""
    return jnp.sum((p + 0.2 * jax.random.normal(key, p.shape)) ** 2) + jnp.sin(3 * p[0])


def seeded_array(x: Any, seed: int = 0) -> Any:
    """A miss with a disturbance that each seed draws, with its own gradient."""
    off = 0.3 * np.random.default_rng(seed).standard_normal(x.shape[1])
    return ((x + off) ** 2).sum(1) + np.cos(2 * x).sum(1), 2 * (x + off) - 2 * np.sin(2 * x)


def one_point(p: Any) -> Any:
    """A function of some microseconds, of one point."""
    a, b = float(p[0]), float(p[1])
    return a * a + math.sin(b), np.array([2 * a, math.cos(b)])


def rotated(x: Any) -> Any:
    """Squared distance of a rotated arrow from another one, by a unit quaternion."""
    q = torch.nn.functional.normalize(torch.cat([1 + 0 * x[:, :1], x], 1), dim=1)
    w, a, b, c = q.unbind(1)
    return (2 * (a * b - w * c) - 0.5) ** 2 + (2 * (a * c + w * b) + 0.3) ** 2


growth = gs.ParameterSpace({"growth": (3.6, 3.9), "start": (0.2, 0.8)})
angles = gs.ParameterSpace({"a": (-2.5, 2.5, "rad"), "b": (-2.5, 2.5, "rad")})
fall = gs.ParameterSpace({"height": (0.6, 1.0, "m"), "speed": (-0.5, 0.5, "m/s")})
forces = gs.ParameterSpace.box(numbered("force", 10), 0.5, 3, "N")
springs = gs.ParameterSpace({"stiff": (-1, 1, "mm"), "soft": (-1, 1, "m")})
SIMULATIONS = [
    case("jax", "logistic-30", partial(logistic, steps=30), growth),
    case("jax", "logistic-60", partial(logistic, steps=60), growth, mode="forward", place=(0.785, 0.4)),
    case("jax", "double-pendulum", double_pendulum, angles),
    case("torch", "soft-contact", soft_contact, fall),
    case("torch", "exact-bounce", exact_bounce, fall),
    case("torch", "stiff", stiff, springs),
    case("numpy", "implicit", implicit, forces),
    case("jax", "unrolled", unrolled, forces),
    case("jax", "seeded", seeded),
    case("jax", "mean-of-seeds", seeded, TEN, seeds=4),
    case("numpy", "mean-of-seeds", seeded_array, TEN, seeds=4),
    case("jax", "horizon", pendulum(), SWING, horizon="steps"),
    case("numpy", "microseconds", one_point, vectorized=False),
    case("torch", "rotated", rotated, gs.ParameterSpace.box(["a", "b", "c"], -1, 1)),
    case("numpy", "differences", partial(nozzle, np), NOZZLE.space(3), differences=1e-5),
    case("numpy", "differences", partial(cart, np), CART.space(10), differences=1e-5),
    case("torch", "gas", partial(gas, torch), GAS.space(2)),
    case("jax", "throw", partial(throw, jnp), THROW.space(2)),
    case("torch", "rod", partial(rod, torch), ROD.space(100)),
    case("jax", "chain", partial(chain, jnp), CHAIN.space(100), precision="float32",
         reference=partial(chain, np)),
    case("numpy", "chain", partial(right, CHAIN), CHAIN.space(100)),
]  # fmt: skip


# ---- Warp.


@wp.kernel
def _wave_kernel(x: wp.array2d(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    loss[i] = wp.sin(3.0 * x[i, 0]) + x[i, 1] * x[i, 1] + 100.0


@wp.kernel
def _drag_kernel(x: wp.array2d(dtype=float), k: int, speed: wp.array(dtype=float), after: wp.array(dtype=float)):
    i = wp.tid()
    after[i] = speed[i] + 0.2 * (x[i, k] - speed[i] * wp.abs(speed[i]))


@wp.kernel
def _miss_kernel(speed: wp.array(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    loss[i] = (speed[i] - 1.0) * (speed[i] - 1.0)


@wp.kernel
def _throw_kernel(x: wp.array2d(dtype=wp.float64), loss: wp.array(dtype=wp.float64)):
    i = wp.tid()
    range = x[i, 1] * x[i, 1] * wp.sin(wp.float64(2.0) * x[i, 0]) / wp.float64(9.81)
    loss[i] = (range - wp.float64(8.0)) * (range - wp.float64(8.0))


def throw_double(x: Any) -> Any:
    """Throw in float64."""
    loss = wp.zeros(len(x), dtype=wp.float64, requires_grad=True)
    wp.launch(_throw_kernel, len(x), inputs=[x], outputs=[loss])
    return loss


def drive(x: Any) -> Any:
    """Drive a car with drag, each speed in an array of its own."""
    speed, loss = empty(x), empty(x)
    for k in range(10):
        after = empty(x)
        wp.launch(_drag_kernel, len(x), inputs=[x, k, speed], outputs=[after])
        speed = after
    wp.launch(_miss_kernel, len(x), inputs=[speed], outputs=[loss])
    return loss


def drive_exactly(x: Any) -> Any:
    """Drive the same car in float64."""
    speed = 0 * x[:, 0]
    for force in x.T:
        speed = speed + 0.2 * (force - speed * np.abs(speed))
    return (speed - 1) ** 2


wave = lambda x: np.sin(3 * x[:, 0]) + x[:, 1] ** 2  # noqa: E731
WARP = [
    case("warp", "throw", throw_double, THROW.space(2), precision="float64"),
    case("warp", "drive", drive, FORCES, reference=drive_exactly),
    case("warp", "offset", of_kernel(_wave_kernel), reference=wave),
]
CASES = [*PLAIN, *STEEP, *SHAPES, *SIMULATIONS, *WARP]
