"""Defects as people write them in NumPy, with gradients of their own or by differences."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

import gradscape as gs

from .cases import Case
from .plant import right
from .systems import (
    CART,
    CHAIN,
    GAS,
    NOZZLE,
    PENDULUM,
    SPRINGS,
    THROW,
    System,
    at_rest,
    cart,
    gas,
    nozzle,
    numbered,
    settle,
    springs,
    throw,
)

DISC = gs.ParameterSpace({"x": (-1, 1, "m"), "y": (-1, 1, "m")})
FORCES = {dim: gs.ParameterSpace.box(numbered("force", dim), 0.5, 3, "N") for dim in (2, 10)}
case = partial(Case, "numpy")
fresh = partial(case, fresh=True)


def cone(x: Any) -> Any:
    """Distance from the origin, with the direction as its gradient: 0/0 at the origin."""
    r = np.sqrt((x**2).sum(1))
    with np.errstate(invalid="ignore"):
        return r, x / r[:, None]


# ---- What is kept from call to call.


class Previous:
    """A solver that hands out its gradient buffer before it is filled: it holds that of the call before."""

    def __init__(self, system: System) -> None:
        self.system, self.buffer = system, np.zeros(1)

    def __call__(self, x: Any) -> Any:
        loss, slope = right(self.system, x)
        given = np.resize(self.buffer, slope.shape)
        self.buffer = slope
        return loss, given


class Accumulating:
    """A leaf of torch whose gradient is never set to zero."""

    def __init__(self, system: System) -> None:
        self.system, self.total = system, np.zeros(1)

    def __call__(self, x: Any) -> Any:
        loss, slope = right(self.system, x)
        self.total = slope + (self.total if self.total.shape == slope.shape else self.total.sum() / slope.size)
        return loss, self.total.copy()


class WarmStart:
    """Springs at rest, by a few sweeps that start from where the call before has ended."""

    def __init__(self) -> None:
        self.rest = np.zeros(1)

    def __call__(self, x: Any) -> Any:
        rest = np.broadcast_to(self.rest, x.shape) if self.rest.shape == x.shape else 0 * x + self.rest.mean()
        self.rest = settle(rest, x, 0.2, 3)
        return at_rest(self.rest)


class Counting:
    """A throw in a wind that rises with each call."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, x: Any) -> Any:
        self.calls += 1
        loss, slope = right(THROW, x)
        return loss * (1 + 0.02 * self.calls), slope * (1 + 0.02 * self.calls)


class Noisy:
    """A system with measurement noise of a size that nobody has seeded."""

    def __init__(self, system: System, size: float) -> None:
        self.system, self.size, self.draw = system, size, np.random.default_rng()

    def __call__(self, x: Any) -> Any:
        loss, slope = right(self.system, x)
        return loss + self.size * self.draw.standard_normal(len(x)), slope


def ranked(x: Any) -> Any:
    """A loss relative to the greatest of the batch."""
    loss, slope = right(THROW, x)
    return loss / loss.max(), slope / loss.max()


stale, hidden, noise = ("stale buffer", "hidden state"), ("hidden state",), ("randomness",)
warm = (*hidden, "unconverged solver")
adds = partial(fresh, "accumulates", "accumulating", evidence="repeat")
noisy = partial(fresh, "randomness", "noisy", evidence="repeat")
STATEFUL = [
    case("nan", "cone", cone, DISC, ("norm at zero",), evidence="nan", place=0.5),
    fresh("stale", "previous", partial(Previous, SPRINGS), SPRINGS.space(2), stale),
    fresh("stale", "previous", partial(Previous, CART), CART.space(10), stale),
    adds(partial(Accumulating, THROW), THROW.space(2), stale),
    adds(partial(Accumulating, CHAIN), CHAIN.space(10), stale),
    adds(partial(Accumulating, SPRINGS), SPRINGS.space(100), stale),
    fresh("hidden state", "warmstart", WarmStart, FORCES[2], warm, evidence="repeat"),
    fresh("hidden state", "warmstart", WarmStart, FORCES[10], warm, evidence="repeat"),
    fresh("hidden state", "counting", Counting, THROW.space(2), hidden, evidence="repeat"),
    noisy(partial(Noisy, THROW, 0.1), THROW.space(2), noise),
    noisy(partial(Noisy, SPRINGS, 1e-4), SPRINGS.space(10), noise, warns=True),
    case("rows leak", "ranked", ranked, THROW.space(2), ("rows that leak",), evidence="rows"),
]


# ---- Differences, rounding.


def own_differences(x: Any) -> Any:
    """A cart with forward differences over 1e-13 of force."""
    loss = cart(np, x)
    steps = 1e-13 * np.eye(x.shape[1])
    return loss, np.stack([(cart(np, x + step) - loss) / 1e-13 for step in steps], 1)


def far_differences(x: Any) -> Any:
    """A throw by forward differences over a tenth of the box, as somebody took for noise."""
    loss, steps = throw(np, x), np.array([[0.11, 0], [0, 0.8]])
    return loss, np.stack([(throw(np, x + step) - loss) / step.max() for step in steps], 1)


bad = ("differences with a bad step",)
grain = partial(case, "grain", causes=("float32 grain", *bad), said={"differences": 1e-6})
energy = lambda x: 20 * gas(np, x)  # noqa: E731 -- of a tank [J]
ROUNDED = [
    grain("tank", lambda x: (1e6 + energy(x)).astype(np.float32), GAS.space(2), reference=energy),
    grain("meter", lambda x: (500 + 10 * nozzle(np, x)).astype(np.float32), NOZZLE.space(3),
          reference=lambda x: 10 * nozzle(np, x)),
    grain("scale", lambda x: springs(np, x).astype(np.float32), SPRINGS.space(10), reference=partial(springs, np)),
    # a surface with ten waves across the box
    case("differences", "waves", lambda x: np.sin(20 * x[:, 0]) + np.cos(15 * x[:, 1]) + (x**2).sum(1), DISC, bad,
         said={"differences": 0.1}),
    case("differences", "far-differences", far_differences, THROW.space(2), bad),
    case("differences", "own-differences", own_differences, CART.space(10), bad),
    case("differences", "vessel", lambda x: 1e6 + energy(x), GAS.space(2), bad, said={"differences": 1e-11},
         reference=energy),
]  # fmt: skip


# ---- Solvers and adjoints.


def tolerant(x: Any) -> Any:
    """Springs at rest up to a tolerance of 0.1, with the derivative that a converged solution has."""
    rest = 0 * x
    for _ in range(50):
        residual = rest + rest**3 - x
        rest = np.where(np.abs(residual) > 0.1, rest - 0.12 * residual, rest)
    return at_rest(rest)


def short_adjoint(x: Any) -> Any:
    """A cart of 100 forces whose adjoint goes back 40 steps only."""
    loss, slope = right(CART, x)
    slope[:, :60] = 0.1 * x[:, :60] / 100
    return loss, slope


def unpunished(x: Any) -> Any:
    """A pendulum with a penalty on its torques that the gradient lacks."""
    loss, slope = right(PENDULUM, x)
    return loss + 0.05 * (x**2).sum(1), slope


def drag(x: Any) -> Any:
    """Drag v|v| and a spring, differentiated as if drag were v²."""
    v, y = x[:, 0], x[:, 1]
    return v * np.abs(v) + 2 * v + y**2 + 3 * np.sin(y), np.stack([2 * v + 2, 2 * y + 3 * np.cos(y)], 1)


def by_decade(x: Any) -> Any:
    """A damping ratio's error, with the derivative by the decimal logarithm of the stiffness."""
    k, c = x[:, 0], x[:, 1]
    miss = c / (2 * np.sqrt(k)) - 1
    return miss**2, np.stack([-miss * c / (2 * np.sqrt(k)) * np.log(10), miss / np.sqrt(k)], 1)


def crooked(x: Any) -> Any:
    """Squared residual of a linear system, differentiated with A where its transpose belongs."""
    size = x.shape[1]
    A = np.eye(size) + np.triu(np.full((size, size), 0.6), 1)
    residual = x @ A.T - 0.5
    return (residual**2).sum(1), 2 * residual @ A.T


moving = gs.ParameterSpace({"speed": (-2, 1, "m/s"), "place": (-1, 1, "m")})
damped = gs.ParameterSpace({"k": gs.log(1, 1e4, "N/m"), "c": (0.5, 5, "N s/m")})
ADJOINTS = [
    case("unconverged", "tolerant", tolerant, FORCES[10], ("unconverged solver",)),
    case("truncated", "short-adjoint", short_adjoint, CART.space(100), ("truncated loop", "detached parameter"),
         tuple(numbered("force", 60))),
    case("missing term", "unpunished", unpunished, PENDULUM.space(10), ("",)),
    case("region", "drag", drag, moving, ("sign", ""), edges={"speed": (0.0,)}, region=lambda x: x[:, 0] < 0),
    case("units", "by-decade", by_decade, damped, ("units",), ("k",)),
    case("transposed", "crooked", crooked, DISC, ("transposed", "")),
]  # fmt: skip
CASES = [*STATEFUL, *ROUNDED, *ADJOINTS]
