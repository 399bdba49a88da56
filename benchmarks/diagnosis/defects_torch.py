"""Defects as people write them in torch."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch

import gradscape as gs

from .cases import Case
from .systems import CART, CHAIN, PENDULUM, ROD, SPRINGS, THROW, cart, chain, rod, springs, throw

PLANE = gs.ParameterSpace({"x": (-1, 1, "m"), "y": (-1, 1, "m")})
FALL = gs.ParameterSpace({"height": (0.8, 1.2, "m"), "speed": (-0.5, 0.5, "m/s")})
BOX = partial(gs.ParameterSpace.box, lower=-1, upper=1)


def case(
    kind: str, dim: int, fn: Callable[..., Any], space: gs.ParameterSpace, causes: tuple[str, ...], **how: Any
) -> Case:
    """Return a case of a function of torch; `how` are fields of `Case`, and `said` keywords of `from_torch`."""
    said = how.pop("said", {})
    name = f"{kind.replace(' ', '-')}-torch-{fn.__name__.strip('_').replace('_', '-')}-{dim}"
    return Case(name, kind, "torch", dim, lambda: gs.from_torch(fn, space, name=name, **said), causes, **how)


def fresh(kind: str, dim: int, make: type, space: gs.ParameterSpace, causes: tuple[str, ...], **how: Any) -> Case:
    """Return a case of an object that keeps something from call to call: each objective has its own."""
    name = f"{kind.replace(' ', '-')}-torch-{make.__name__.lower()}-{dim}"
    return Case(name, kind, "torch", dim, lambda: gs.from_torch(make(), space, name=name), causes, **how)


# ---- NaN beside a finite loss.


def distance(x: Any) -> Any:
    """Squared length, by way of a length [m²]."""
    return ((x**2).sum(1)).sqrt() ** 2


def reach(x: Any) -> Any:
    """Time to fall from a height [s²], and 0 below the ground."""
    height, speed = x[:, 0], x[:, 1]
    fall = torch.where(height > 0, torch.sqrt(2 * height / 9.81), 0 * height)
    return (fall - 0.3) ** 2 + 0.1 * speed**2


def gaps(x: Any) -> Any:
    """Hertz contact at one of 100 gaps: a force with depth^1.5 where the gap is closed."""
    closed = torch.where(x[:, 37] > 0, x[:, 37] ** 1.5, 0 * x[:, 37])
    return ((x - 0.3) ** 2).sum(1) / 10 + (closed - 0.5) ** 2


def turn(x: Any) -> Any:
    """Squared angle of a rotation by its trace [rad²], which is 0 at no rotation."""
    trace = 1 + 2 * torch.cos(torch.sqrt((x**2).sum(1)))
    return torch.acos((trace - 1) / 2) ** 2


def molecule(x: Any) -> Any:
    """Lennard-Jones energy of two particles, at most 1000, so that those in one place have a finite one."""
    r2 = (x[:, 0] - x[:, 2]) ** 2 + (x[:, 1] - x[:, 3]) ** 2
    s = r2**-3
    energy = 4 * s * (s - 1)
    return torch.where(energy < 1000, energy, torch.full_like(energy, 1000))


def switched(x: Any) -> Any:
    """A steep switch, by a sigmoid whose exponential overflows."""
    return (1 / (1 + torch.exp(-800 * x[:, 0])) - 0.4) ** 2 + x[:, 1] ** 2


def _nan() -> list[Case]:
    above = {"height": (0.0,)}
    hundred = gs.ParameterSpace.box([f"gap {k}" for k in range(100)], -1, 2, "mm")
    return [
        case("nan", 10, distance, BOX([f"x{k}" for k in range(10)]), ("norm at zero",), evidence="nan", place=0.5),
        case("nan", 2, reach, gs.ParameterSpace({"height": (-1, 1, "m"), "speed": (-2, 2, "m/s")}), ("where over NaN",),
             edges=above, region=lambda x: x[:, 0] < 0, evidence="nan"),
        case("nan", 100, gaps, hundred, ("where over NaN",),
             edges={"gap 37": (0.0,)}, region=lambda x: x[:, 37] < 0, evidence="nan"),
        case("nan", 3, turn, BOX(["roll", "pitch", "yaw"], unit="rad"), ("norm at zero", "where over NaN"),
             evidence="nan", place=0.5),
        case("nan", 4, molecule, BOX(["x1", "y1", "x2", "y2"], unit="nm"), ("where over NaN", "norm at zero"),
             evidence="nan", place=(0.3, 0.6, 0.3, 0.6)),
        case("nan", 2, switched, gs.ParameterSpace({"switch": (-1.5, 1, "V"), "slip": (-1, 1, "m")}),
             ("where over NaN", ""), edges={"switch": (-0.887,)}, region=lambda x: x[:, 0] < -0.887, evidence="nan"),
    ]  # fmt: skip


# ---- Cut off: detached, truncated, snapped.


def cart_detached(x: Any) -> Any:
    """A cart whose controller hands two of its forces over as numbers."""
    columns = [x[:, k].detach() if k in (2, 7) else x[:, k] for k in range(x.shape[1])]
    return cart(torch, torch.stack(columns, 1))


def measured(x: Any) -> Any:
    """A throw whose speed goes through NumPy on its way to the loss."""
    speed = torch.from_numpy(x[:, 1].detach().numpy().copy())
    return throw(torch, torch.stack([x[:, 0], speed], 1))


def all_measured(x: Any) -> Any:
    """A chain that is simulated in NumPy; its losses carry a gradient of zeros."""
    return torch.from_numpy(chain(np, x.detach().numpy())) + 0 * x.sum(1)


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


def _cut() -> list[Case]:
    early = tuple(f"torque {k}" for k in range(7))
    return [
        case("detached", 10, cart_detached, CART.space(10), ("detached parameter",), parameters=("force 2", "force 7"),
             reference=lambda x: cart(np, x)),
        case("detached", 2, measured, THROW.space(2), ("detached parameter",), parameters=("speed",)),
        case("detached", 10, all_measured, CHAIN.space(10), ("detached parameter",),
             parameters=CHAIN.space(10).names),
        case("truncated", 10, pendulum_truncated, PENDULUM.space(10), ("truncated loop", "detached parameter"),
             parameters=early),
        case("truncated", 2, swing_truncated, gs.ParameterSpace({"length": (0.5, 1.5, "m"), "damping": (0, 1, "1/s")}),
             ("truncated loop",), said={"horizon": "steps"}),
        case("impact", 2, collide, gs.ParameterSpace({"x1": (-0.1, 0.1, "m"), "v1": (0.6, 1.4, "m/s")}),
             ("snapped time of impact", "detached parameter"), parameters=("x1",), warns=True, evidence="wide"),
    ]  # fmt: skip


# ---- Solvers, state and batches.


def settle(x: Any, iterations: int = 4) -> Any:
    """Squared error of springs at rest, of forces: an implicit derivative where the solver has not arrived."""
    with torch.no_grad():
        rest = 0 * x
        for _ in range(iterations):
            rest = rest - 0.2 * (rest + rest**3 - x)
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


def normalised(x: Any) -> Any:
    """Angles of a chain in standard deviations of the batch."""
    return chain(torch, (x - x.mean(0)) / (x.std(0, unbiased=False) + 1.0))


def dropped(x: Any) -> Any:
    """Forces of a cart, a tenth of which are lost at random."""
    return cart(torch, torch.nn.functional.dropout(x, 0.1))


class Growing:
    """A throw that keeps all its losses with what they were computed from, for a plot."""

    def __init__(self) -> None:
        self.history: list[Any] = []

    def __call__(self, x: Any) -> Any:
        work = throw(torch, x)[:, None] * torch.ones(1 + 65536 // len(x), dtype=x.dtype)
        self.history.append(work)
        return work[:, 0]


def _stateful() -> list[Case]:
    unconverged = ("unconverged solver",)
    forces = gs.ParameterSpace.box(["force 0", "force 1"], 0.5, 3, "N")
    return [
        case("unconverged", 2, settle, forces, unconverged),
        fresh("hidden state", 10, Smoothed, SPRINGS.space(10), ("hidden state", "rows that leak"), evidence="repeat"),
        fresh("stale", 10, Buffered, SPRINGS.space(10), ("stale buffer", "hidden state")),
        case("rows leak", 10, normalised, CHAIN.space(10), ("rows that leak",), evidence="rows"),
        case("randomness", 10, dropped, CART.space(10), ("randomness",), evidence="repeat"),
        fresh("memory", 2, Growing, THROW.space(2), ("memory growth",), warns=True, evidence="memory"),
    ]


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


def softened(x: Any) -> Any:
    """A contact that is smoothed where somebody will ask for its gradient."""
    depth = torch.nn.functional.softplus(20 * x[:, 0]) / 20 if x.requires_grad else x[:, 0].relu()
    return (depth - 0.3) ** 2 + x[:, 1] ** 2


def coarser(x: Any) -> Any:
    """A rod that takes fewer sources into account where somebody will ask for its gradient."""
    return rod(torch, x) if not x.requires_grad else rod(torch, 0.98 * x)


class _Limit(torch.autograd.Function):
    """A limit of 1 whose backward pass is that of the identity."""

    @staticmethod
    def forward(ctx: Any, x: Any) -> Any:
        return x.clamp(max=1.0)

    @staticmethod
    def backward(ctx: Any, slope: Any) -> Any:
        return slope


def straight_through(x: Any) -> Any:
    """A cart, one force of which is limited, with a gradient beyond the limit."""
    return cart(torch, torch.cat([_Limit.apply(x[:, :1]), x[:, 1:]], 1))


class _Effort(torch.autograd.Function):
    """The effort of forces, whose derivative nobody has written."""

    @staticmethod
    def forward(ctx: Any, x: Any) -> Any:
        return (x**2).sum(1)

    @staticmethod
    def backward(ctx: Any, slope: Any) -> Any:
        return torch.zeros(len(slope), 2, dtype=slope.dtype)


def effort(x: Any) -> Any:
    """A cart whose effort does not reach the gradient."""
    return cart(torch, x) + _Effort.apply(x)


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


def servo(x: Any) -> Any:
    """A cart whose forces come in steps of 0.25 N."""
    return cart(torch, torch.round(4 * x) / 4)


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


def _others() -> list[Case]:
    start = gs.ParameterSpace({"angle": (-1.5, 1.5, "rad"), "rate": (-1, 1, "rad/s")})
    contact = gs.ParameterSpace({"depth": (-0.5, 1, "m"), "slip": (-1, 1, "m")})
    steps = {"draft": {"dt": 0.02, "steps": 50}, "standard": {"dt": 0.01, "steps": 100},
             "reference": {"dt": 0.0005, "steps": 2000}}  # fmt: skip
    drives = {dim: gs.ParameterSpace.box([f"force {k}" for k in range(dim)], 0, 4, "N") for dim in (2, 10)}
    return [
        case("overwritten", 10, drive, drives[10], ("tape overwritten",)),
        case("overwritten", 2, drive, drives[2], ("tape overwritten",)),
        case("depends on grad", 2, softened, contact, ("loss depends on the gradient",), evidence="losses"),
        case("depends on grad", 10, coarser, ROD.space(10), ("loss depends on the gradient",), evidence="losses"),
        case("missing term", 2, effort, CART.space(2), ("",)),
        case("region", 10, straight_through, CART.space(10), ("",), edges={"force 0": (1.0,)},
             region=lambda x: x[:, 0] > 1),
        case("late", 2, late_sign, start, ("sign", "", "truncated loop"), step=25, said={"horizon": "steps"}),
        case("staircase", 10, servo, CART.space(10), ("staircase",), warns=True, evidence="wide"),
        case("chaos", 10, tumble, BOX([f"nudge {k}" for k in range(10)]), ("chaotic growth",), warns=True,
             evidence="growth", said={"horizon": "steps"}),
        case("physics", 2, penalty_ball, FALL, ("discretisation",), warns=True, evidence="finer",
             said={"fidelities": steps}),
    ]  # fmt: skip


def cases() -> list[Case]:
    """Return the cases of this file."""
    return [*_nan(), *_cut(), *_stateful(), *_others()]
