"""Defects as people write them in Warp."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import warp as wp

import gradscape as gs

from .cases import Case
from .systems import THROW, numbered, throw

POINTS = gs.ParameterSpace({"x": (-1, 1, "m"), "y": (-1, 1, "m")})
FORCES = gs.ParameterSpace.box(numbered("force", 10), 0, 4, "N")


@wp.func
def half(x: float):
    """Return half a square; its adjoint below forgets the half."""
    return 0.5 * x * x


@wp.func_grad(half)
def _adj_half(x: float, adj_ret: float):
    wp.adjoint[x] += 2.0 * x * adj_ret


@wp.func
def cosine(x: float):
    """Return the cosine; its adjoint below forgets the sign."""
    return wp.cos(x)


@wp.func_grad(cosine)
def _adj_cosine(x: float, adj_ret: float):
    wp.adjoint[x] += wp.sin(x) * adj_ret


@wp.func
def cube(x: float):
    """Return the cube; its adjoint below is 3 % too long."""
    return x * x * x


@wp.func_grad(cube)
def _adj_cube(x: float, adj_ret: float):
    wp.adjoint[x] += 3.09 * x * x * adj_ret


@wp.func
def slab(x: float):
    """Return a square; its adjoint below has the wrong sign between 0.3 and 0.5."""
    return x * x


@wp.func_grad(slab)
def _adj_slab(x: float, adj_ret: float):
    sign = 1.0
    if x > 0.3 and x < 0.5:
        sign = -1.0
    wp.adjoint[x] += sign * 2.0 * x * adj_ret


@wp.kernel
def _length_kernel(x: wp.array2d(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    r = wp.sqrt(x[i, 0] * x[i, 0] + x[i, 1] * x[i, 1])
    loss[i] = r * r


@wp.kernel
def _root_kernel(x: wp.array2d(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    r = wp.where(x[i, 0] > 0.0, wp.sqrt(x[i, 0]), 0.0)
    loss[i] = (r - 0.5) * (r - 0.5) + x[i, 1] * x[i, 1]


@wp.kernel
def _half_kernel(x: wp.array2d(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    loss[i] = half(x[i, 0] - 0.2) + half(x[i, 1] + 0.4 * x[i, 0])


@wp.kernel
def _cosine_kernel(x: wp.array2d(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    loss[i] = 2.0 + cosine(x[i, 0] + 1.2 + 0.3 * x[i, 1])


@wp.kernel
def _one_sign_kernel(x: wp.array2d(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    total = 0.0
    for k in range(10):
        if k == 6:
            total += cosine(0.5 + 0.5 * x[i, k])
        else:
            total += wp.cos(0.5 + (0.3 + 0.05 * float(k)) * x[i, k])
    loss[i] = 0.3 * total


@wp.kernel
def _cube_kernel(x: wp.array2d(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    total = 0.0
    for k in range(10):
        total += cube(x[i, k] + 0.1 * float(k))
    loss[i] = 0.1 * total


@wp.kernel
def _slab_kernel(x: wp.array2d(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    loss[i] = slab(x[i, 0]) + (x[i, 1] - 0.2) * (x[i, 1] - 0.2)


@wp.kernel
def _throw_kernel(x: wp.array2d(dtype=float), speed: wp.array(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    miss = speed[i] * speed[i] * wp.sin(2.0 * x[i, 0]) / 9.81 - 8.0
    loss[i] = miss * miss


@wp.kernel
def _start_kernel(x: wp.array2d(dtype=float), speed: wp.array(dtype=float)):
    i = wp.tid()
    speed[i] = 2.0 + 0.0 * x[i, 0]


@wp.kernel
def _drag_kernel(x: wp.array2d(dtype=float), k: int, speed: wp.array(dtype=float)):
    i = wp.tid()
    v = speed[i]
    speed[i] = v + 0.2 * (x[i, k] - v * wp.abs(v))


@wp.kernel
def _miss_kernel(speed: wp.array(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    loss[i] = (speed[i] - 1.0) * (speed[i] - 1.0)


@wp.kernel
def _bounce_kernel(x: wp.array2d(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    y = x[i, 0]
    v = x[i, 1]
    for _ in range(16):  # unrolled: Warp does not keep what a longer loop overwrites
        v = v - 0.04 * 9.81
        y = y + 0.04 * v
        if y < 0.0 and v < 0.0:
            v = -0.8 * v
    loss[i] = (y - 0.35) * (y - 0.35)


@wp.kernel
def _loop_kernel(x: wp.array2d(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    v = x[i, 0]
    for _ in range(20):
        v = v + 0.1 * (2.0 + x[i, 1] - v * wp.abs(v))
    loss[i] = (v - 1.0) * (v - 1.0)


@wp.kernel
def _total_kernel(x: wp.array2d(dtype=float), total: wp.array(dtype=float)):
    i = wp.tid()
    wp.atomic_add(total, 0, x[i, 0] * x[i, 0] + x[i, 1])


@wp.kernel
def _share_kernel(x: wp.array2d(dtype=float), total: wp.array(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    loss[i] = (x[i, 0] - 0.2) * (x[i, 0] - 0.2) + x[i, 1] * x[i, 1] + 0.1 * total[0]


@wp.kernel
def _shaken_kernel(x: wp.array2d(dtype=float), seed: int, loss: wp.array(dtype=float)):
    i = wp.tid()
    state = wp.rand_init(seed, i)
    miss = x[i, 0] + 0.1 * wp.randn(state) - 0.3
    loss[i] = miss * miss + x[i, 1] * x[i, 1]


@wp.kernel
def _cells_kernel(x: wp.array2d(dtype=float), loss: wp.array(dtype=float)):
    i = wp.tid()
    a = wp.floor(x[i, 0] * 16.0) / 16.0
    b = wp.floor(x[i, 1] * 16.0) / 16.0
    loss[i] = (a - 0.2) * (a - 0.2) + (b + 0.3) * (b + 0.3)


@wp.kernel
def _soft_kernel(x: wp.array2d(dtype=float), width: float, loss: wp.array(dtype=float)):
    i = wp.tid()
    depth = 0.5 * (x[i, 0] + wp.sqrt(x[i, 0] * x[i, 0] + width * width))
    loss[i] = (depth - 0.3) * (depth - 0.3) + x[i, 1] * x[i, 1]


def empty(x: Any) -> Any:
    """Return an array for a number of each row."""
    return wp.zeros(len(x), dtype=float, requires_grad=True)


def of_kernel(kernel: Any, *inputs: Any) -> Callable[[Any], Any]:
    """Return the function that launches one kernel."""

    def fn(x: Any) -> Any:
        loss = empty(x)
        wp.launch(kernel, len(x), inputs=[x, *inputs], outputs=[loss])
        return loss

    return fn


def read_back(x: Any) -> Any:
    """Throw with a speed that goes through the host, and so past the tape."""
    loss, speed = empty(x), wp.array(x.numpy()[:, 1].copy(), dtype=float, requires_grad=True)
    wp.launch(_throw_kernel, len(x), inputs=[x, speed], outputs=[loss])
    return loss


def drive(x: Any) -> Any:
    """Drive a car with drag, whose speed is updated in place."""
    speed, loss = empty(x), empty(x)
    wp.launch(_start_kernel, len(x), inputs=[x], outputs=[speed])
    for k in range(10):
        wp.launch(_drag_kernel, len(x), inputs=[x, k], outputs=[speed])
    wp.launch(_miss_kernel, len(x), inputs=[speed], outputs=[loss])
    return loss


def shared(x: Any) -> Any:
    """Add the sum over all rows to each row's loss."""
    loss, total = empty(x), wp.zeros(1, dtype=float, requires_grad=True)
    wp.launch(_total_kernel, len(x), inputs=[x], outputs=[total])
    wp.launch(_share_kernel, len(x), inputs=[x, total], outputs=[loss])
    return loss


def softened(x: Any) -> Any:
    """Contact that is softer where somebody asks for its gradient."""
    return of_kernel(_soft_kernel, 0.3 if x.requires_grad else 0.02)(x)


class Shaken:
    """A target that shakes with another seed at each call."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, x: Any) -> Any:
        self.calls += 1
        return of_kernel(_shaken_kernel, self.calls)(x)


fall = gs.ParameterSpace({"height": (0.8, 1.2, "m"), "speed": (-0.5, 0.5, "m/s")})
ten = gs.ParameterSpace.box([f"x{k}" for k in range(10)], -1, 1)
case, sign, overwritten = partial(Case, "warp"), ("sign",), "tape overwritten"
root, bounce = of_kernel(_root_kernel), of_kernel(_bounce_kernel)
CASES = [
    case("nan", "length", of_kernel(_length_kernel), POINTS, ("norm at zero",), evidence="nan", place=0.5),
    case("nan", "root", root, POINTS, ("where over NaN",), edges={"x": (0.0,)}, region=lambda x: x[:, 0] < 0,
         evidence="nan"),
    case("factor 2", "half", of_kernel(_half_kernel), POINTS, ("factor 2",)),
    case("sign", "cosine", of_kernel(_cosine_kernel), POINTS, sign),
    case("sign of one", "cosine", of_kernel(_one_sign_kernel), ten, sign, ("x6",)),
    case("too long", "cube", of_kernel(_cube_kernel), ten, ("scaled",)),
    case("region", "slab", of_kernel(_slab_kernel), POINTS, sign, edges={"x": (0.3, 0.5)},
         region=lambda x: (x[:, 0] > 0.3) & (x[:, 0] < 0.5)),
    case("detached", "host", read_back, THROW.space(2), ("detached parameter",), ("speed",),
         reference=partial(throw, np)),
    case("overwritten", "drag", drive, FORCES, (overwritten,)),
    case("overwritten", "loop", of_kernel(_loop_kernel), POINTS, (overwritten, "truncated loop", "")),
    case("impact", "bounce", bounce, fall, ("snapped time of impact",), warns=True, evidence="wide"),
    case("rows leak", "total", shared, POINTS, ("rows that leak",), evidence="rows"),
    case("randomness", "shaken", Shaken, POINTS, ("randomness", "hidden state"), evidence="repeat", fresh=True),
    case("staircase", "cells", of_kernel(_cells_kernel), POINTS, ("staircase",), warns=True, evidence="wide"),
    case("depends on grad", "contact", softened, POINTS, ("loss depends on the gradient",), evidence="losses"),
]  # fmt: skip
