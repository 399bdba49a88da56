"""Defects as people write them in torch."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch

import gradscape as gs

from .cases import Case
from .systems import (
    CART,
    CHAIN,
    PENDULUM,
    ROD,
    SPRINGS,
    THROW,
    cart,
    chain,
    numbered,
    rod,
    settle,
    springs,
    throw,
)

FALL = gs.ParameterSpace({"height": (0.8, 1.2, "m"), "speed": (-0.5, 0.5, "m/s")})
BOX = partial(gs.ParameterSpace.box, lower=-1, upper=1)


case = partial(Case, "torch")
fresh = partial(case, fresh=True)


# ---- NaN beside a finite loss.


def reach(x: Any) -> Any:
    """Time to fall from a height [s²], and 0 below the ground."""
    height, speed = x[:, 0], x[:, 1]
    fall = torch.where(height > 0, torch.sqrt(2 * height / 9.81), 0 * height)
    return (fall - 0.3) ** 2 + 0.1 * speed**2


def molecule(x: Any) -> Any:
    """Lennard-Jones energy of two particles, at most 1000, so that those in one place have a finite one."""
    r2 = (x[:, 0] - x[:, 2]) ** 2 + (x[:, 1] - x[:, 3]) ** 2
    s = r2**-3
    energy = 4 * s * (s - 1)
    return torch.where(energy < 1000, energy, torch.full_like(energy, 1000))


norm, where = ("norm at zero",), ("where over NaN",)
nan = partial(case, "nan", evidence="nan")
fall = gs.ParameterSpace({"height": (-1, 1, "m"), "speed": (-2, 2, "m/s")})
hundred = gs.ParameterSpace.box(numbered("gap", 100), -1, 2, "mm")
switch = gs.ParameterSpace({"switch": (-1.5, 1, "V"), "slip": (-1, 1, "m")})
NAN = [
    # squared length, by way of a length [m²]
    nan("distance", lambda x: ((x**2).sum(1)).sqrt() ** 2, BOX([f"x{k}" for k in range(10)]), norm, place=0.5),
    nan("reach", reach, fall, where, edges={"height": (0.0,)}, region=lambda x: x[:, 0] < 0),
    # Hertz contact at one of 100 gaps: a force with depth^1.5 where the gap is closed
    nan("gaps", lambda x: ((x - 0.3) ** 2).sum(1) / 10
        + (torch.where(x[:, 37] > 0, x[:, 37] ** 1.5, 0 * x[:, 37]) - 0.5) ** 2, hundred, where,
        edges={"gap 37": (0.0,)}, region=lambda x: x[:, 37] < 0),
    # squared angle of a rotation by its trace [rad²], which is 0 at no rotation
    nan("turn", lambda x: torch.acos((1 + 2 * torch.cos(torch.sqrt((x**2).sum(1))) - 1) / 2) ** 2,
        BOX(["roll", "pitch", "yaw"], unit="rad"), (*norm, *where), place=0.5),
    nan("molecule", molecule, BOX(["x1", "y1", "x2", "y2"], unit="nm"), (*where, *norm), place=(0.3, 0.6) * 2),
    # a steep switch, by a sigmoid whose exponential overflows
    nan("switched", lambda x: (1 / (1 + torch.exp(-800 * x[:, 0])) - 0.4) ** 2 + x[:, 1] ** 2, switch,
        (*where, ""), edges={"switch": (-0.887,)}, region=lambda x: x[:, 0] < -0.887),
]  # fmt: skip


# ---- Cut off: detached, truncated, snapped.


def pendulum_truncated(x: Any, window: int = 3) -> Any:
    """A pendulum whose state is cut from what came before the last three torques."""
    count, dt = x.shape[1], 1.5 / x.shape[1]
    angle, rate = 0.5 + 0 * x[:, 0], 0 * x[:, 0]
    for k in range(count):
        if k == count - window:
            angle, rate = angle.detach(), rate.detach()
        rate = rate + dt * (x[:, k] - 9.81 * torch.sin(angle) - 0.2 * rate)
        angle = angle + dt * rate
    return (angle - 1) ** 2 + 0.2 * rate**2


def swing_truncated(x: Any, steps: int = 60) -> Any:
    """A pendulum of an unknown length and damping, differentiated through its last 10 steps only."""
    angle, rate = 1 + 0 * x[:, 0], 0 * x[:, 0]
    for k in range(steps):
        if k == steps - 10:
            angle, rate = angle.detach(), rate.detach()
        rate = rate + 0.02 * (-9.81 / x[:, 0] * torch.sin(angle) - x[:, 1] * rate)
        angle = angle + 0.02 * rate
    return (angle - 0.3) ** 2


def collide(x: Any) -> Any:
    """Squared miss of a ball that another one hits [m²]: velocities are swapped at a time step."""
    place, other = x[:, 0], torch.full_like(x[:, 0], 0.6)
    speed, its = x[:, 1], torch.zeros_like(x[:, 0])
    for _ in range(60):
        touch = (other - place < 0.2) & (speed > its)
        speed, its = torch.where(touch, its, speed), torch.where(touch, speed, its)
        place, other = place + 0.02 * speed, other + 0.02 * its
    return (other - 1.2) ** 2


detached, truncated = ("detached parameter",), ("truncated loop",)
lengths = gs.ParameterSpace({"length": (0.5, 1.5, "m"), "damping": (0, 1, "1/s")})
balls = gs.ParameterSpace({"x1": (-0.1, 0.1, "m"), "v1": (0.6, 1.4, "m/s")})
CUT = [
    # a cart whose controller hands two of its forces over as numbers
    case("detached", "cart-detached", lambda x: cart(torch, torch.stack(
        [x[:, k].detach() if k in (2, 7) else x[:, k] for k in range(10)], 1)), CART.space(10), detached,
        ("force 2", "force 7"), reference=partial(cart, np)),
    # a throw whose speed goes through NumPy on its way to the loss
    case("detached", "measured", lambda x: throw(torch, torch.stack(
        [x[:, 0], torch.from_numpy(x[:, 1].detach().numpy().copy())], 1)), THROW.space(2), detached, ("speed",)),
    # a chain that is simulated in NumPy; its losses carry a gradient of zeros
    case("detached", "all-measured", lambda x: torch.from_numpy(chain(np, x.detach().numpy())) + 0 * x.sum(1),
         CHAIN.space(10), detached, CHAIN.space(10).names),
    case("truncated", "pendulum-truncated", pendulum_truncated, PENDULUM.space(10), (*truncated, *detached),
         tuple(numbered("torque", 7))),
    case("truncated", "swing-truncated", swing_truncated, lengths, truncated, said={"horizon": "steps"}),
    case("impact", "collide", collide, balls, ("snapped time of impact", *detached), ("x1",), warns=True,
         evidence="wide"),
]  # fmt: skip


# ---- Solvers, state and batches.


def settled(x: Any, iterations: int = 4) -> Any:
    """Squared error of springs at rest, of forces: an implicit derivative where the solver has not arrived."""
    with torch.no_grad():
        rest = settle(0 * x, x, 0.2, iterations)
    rest = rest + (x - x.detach()) / (1 + 3 * rest**2)
    return ((rest - 0.4) ** 2).sum(1)


class Smoothed:
    """Springs whose stiffnesses are taken relative to their running mean over calls."""

    def __init__(self) -> None:
        self.mean = 100.0

    def __call__(self, x: Any) -> Any:
        self.mean = 0.9 * self.mean + 0.1 * float(x.detach().mean())
        return springs(torch, x * (100 / self.mean))


class _Stale(torch.autograd.Function):
    """A spring network whose backward pass reads what the call before last left in a buffer."""

    @staticmethod
    def forward(ctx: Any, x: Any, keep: Any) -> Any:
        ctx.before = keep.get(x.shape, x.detach().flip(0) * 0.9)
        keep[x.shape] = x.detach().clone()
        return springs(torch, x)

    @staticmethod
    def backward(ctx: Any, slope: Any) -> Any:
        with torch.enable_grad():
            at = ctx.before.requires_grad_()
            (found,) = torch.autograd.grad(springs(torch, at).sum(), at)
        return slope[:, None] * found, None


class Buffered:
    """A spring network with a buffer for its adjoint."""

    def __init__(self) -> None:
        self.keep: dict[Any, Any] = {}

    def __call__(self, x: Any) -> Any:
        return _Stale.apply(x, self.keep)


class Growing:
    """A throw that keeps all its losses with what they were computed from, for a plot."""

    def __init__(self) -> None:
        self.history: list[Any] = []

    def __call__(self, x: Any) -> Any:
        work = throw(torch, x)[:, None] * torch.ones(1 + 65536 // len(x), dtype=x.dtype)
        self.history.append(work)
        return work[:, 0]


forces, hidden, leaking = gs.ParameterSpace.box(numbered("force", 2), 0.5, 3, "N"), "hidden state", "rows that leak"
STATEFUL = [
    case("unconverged", "settle", settled, forces, ("unconverged solver",)),
    fresh("hidden state", "smoothed", Smoothed, SPRINGS.space(10), (hidden, leaking), evidence="repeat"),
    fresh("stale", "buffered", Buffered, SPRINGS.space(10), ("stale buffer", hidden)),
    # angles of a chain in standard deviations of the batch
    case("rows leak", "normalised", lambda x: chain(torch, (x - x.mean(0)) / (x.std(0, unbiased=False) + 1.0)),
         CHAIN.space(10), (leaking,), evidence="rows"),
    # forces of a cart, a tenth of which are lost at random
    case("randomness", "dropped", lambda x: cart(torch, torch.nn.functional.dropout(x, 0.1)), CART.space(10),
         ("randomness",), evidence="repeat"),
    fresh("memory", "growing", Growing, THROW.space(2), ("memory growth",), warns=True, evidence="memory"),
]  # fmt: skip


# ---- Overwritten, otherwise with gradients, a missing term.


class _Step(torch.autograd.Function):
    """A step of a car with air drag that keeps its speed in a buffer which the next step writes to."""

    @staticmethod
    def forward(ctx: Any, speed: Any, force: Any, buffer: Any) -> Any:
        buffer.copy_(speed)
        ctx.buffer = buffer
        return speed + 0.2 * (force - speed * speed.abs())

    @staticmethod
    def backward(ctx: Any, slope: Any) -> Any:
        return slope * (1 - 0.4 * ctx.buffer.abs()), 0.2 * slope, None


def drive(x: Any) -> Any:
    """Squared miss of a car with forces in turn, over ten steps."""
    speed, buffer = 2 + 0 * x[:, 0], torch.empty_like(x[:, 0].detach())
    for k in range(10):
        speed = _Step.apply(speed, x[:, k * x.shape[1] // 10], buffer)
    return (speed - 1) ** 2


class _Limit(torch.autograd.Function):
    """A limit of 1 whose backward pass is that of the identity."""

    @staticmethod
    def forward(ctx: Any, x: Any) -> Any:
        return x.clamp(max=1.0)

    @staticmethod
    def backward(ctx: Any, slope: Any) -> Any:
        return slope


class _Effort(torch.autograd.Function):
    """The effort of forces, whose derivative nobody has written."""

    @staticmethod
    def forward(ctx: Any, x: Any) -> Any:
        return (x**2).sum(1)

    @staticmethod
    def backward(ctx: Any, slope: Any) -> Any:
        return torch.zeros(len(slope), 2, dtype=slope.dtype)


def late_sign(x: Any, steps: int = 40) -> Any:
    """A pendulum whose backward pass has the wrong sign of gravity after step 25, as after a contact."""
    angle, rate = x[:, 0], x[:, 1]
    for k in range(steps):
        pull = torch.sin(angle)
        if k >= 25:
            pull = 2 * pull.detach() - pull
        rate = rate - 0.02 * 9.81 * pull
        angle = angle + 0.02 * rate
    return (angle - 0.5) ** 2


def tumble(x: Any, steps: int = 60) -> Any:
    """A logistic map that is nudged at first by each parameter: chaos."""
    z = 0.3 + 0.01 * x.sum(1)
    for _ in range(steps):
        z = 3.95 * z * (1 - z)
    return (z - 0.5) ** 2


def penalty_ball(x: Any, dt: float = 0.02, steps: int = 50) -> Any:
    """Squared miss of a ball that bounces on a stiff spring [m²], after 1 s."""
    y, v = x[:, 0], x[:, 1]
    for _ in range(steps):
        v = v + dt * (-9.81 + 5e3 * torch.relu(-y))
        y = y + dt * v
    return (y - 0.5) ** 2


def softened(x: Any) -> Any:
    """A contact that is smoothed where somebody will ask for its gradient."""
    depth = torch.nn.functional.softplus(20 * x[:, 0]) / 20 if x.requires_grad else x[:, 0].relu()
    return (depth - 0.3) ** 2 + x[:, 1] ** 2


start = gs.ParameterSpace({"angle": (-1.5, 1.5, "rad"), "rate": (-1, 1, "rad/s")})
contact = gs.ParameterSpace({"depth": (-0.5, 1, "m"), "slip": (-1, 1, "m")})
overwritten, depends = ("tape overwritten",), ("loss depends on the gradient",)
steps = {"draft": {"dt": 0.02, "steps": 50}, "standard": {"dt": 0.01, "steps": 100},
         "reference": {"dt": 0.0005, "steps": 2000}}  # fmt: skip
OTHERS = [
    *(case("overwritten", "drive", drive, gs.ParameterSpace.box(numbered("force", dim), 0, 4, "N"), overwritten)
      for dim in (10, 2)),
    case("depends on grad", "softened", softened, contact, depends, evidence="losses"),
    # a rod that takes fewer sources into account where somebody will ask for its gradient
    case("depends on grad", "coarser", lambda x: rod(torch, 0.98 * x if x.requires_grad else x), ROD.space(10),
         depends, evidence="losses"),
    # a cart whose effort does not reach the gradient
    case("missing term", "effort", lambda x: cart(torch, x) + _Effort.apply(x), CART.space(2), ("",)),
    # a cart, one force of which is limited, with a gradient beyond the limit
    case("region", "straight-through", lambda x: cart(torch, torch.cat([_Limit.apply(x[:, :1]), x[:, 1:]], 1)),
         CART.space(10), ("",), edges={"force 0": (1.0,)}, region=lambda x: x[:, 0] > 1),
    case("late", "late-sign", late_sign, start, ("sign", "", "truncated loop"), step=25, said={"horizon": "steps"}),
    # a cart whose forces come in steps of 0.25 N
    case("staircase", "servo", lambda x: cart(torch, torch.round(4 * x) / 4), CART.space(10), ("staircase",),
         warns=True, evidence="wide"),
    case("chaos", "tumble", tumble, BOX(numbered("nudge", 10)), ("chaotic growth",), warns=True,
         evidence="growth", said={"horizon": "steps"}),
    case("physics", "penalty-ball", penalty_ball, FALL, ("discretisation",), warns=True, evidence="finer",
         said={"fidelities": steps}),
]  # fmt: skip
CASES = [*NAN, *CUT, *STATEFUL, *OTHERS]
