"""Discs in a plane with instantaneous impacts on walls and on each other, in torch: three ways to find touches.

Gradients are autograd's. Their quality depends on the time of touch. Whole steps do not differentiate it at all, a
correction of positions does half of it (Hu et al. 2020, DiffTaichi), and an event that is found and differentiated does
all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

Contacts = Literal["touch", "shift", "step"]
Axis = Float[Tensor, "batch 2"]
Places = Float[Tensor, "batch disc 2"]
Row = Float[Tensor, " batch"]

TOUCHES = 4  # of a segment, at most
HALVINGS = 50  # of the bracket of a touch
SLOWEST = 1e-3  # closing speed that a time of touch is divided by [m/s], as DiffTaichi's


@dataclass(frozen=True)
class Wall:
    """A half-plane that discs cannot enter: its normal, and its distance from the origin along the normal [m]."""

    normal: tuple[float, float]
    offset: float


@dataclass(frozen=True)
class Table:
    """Discs of one radius [m] and one mass between walls, without friction; `restitution` is that of every impact."""

    radius: float
    restitution: float
    walls: tuple[Wall, ...] = ()
    discs: int = 1


@dataclass(frozen=True)
class Contact:
    """The two bodies that touch: `disc`, and a `wall` or the disc `other`."""

    disc: int
    wall: Wall | None
    other: int = -1

    def gap(self, table: Table, x: Places) -> tuple[Row, Axis]:
        """Return how far the two are apart [m], and the direction in which the disc leaves the other."""
        if self.wall is not None:
            normal = x.new_tensor(self.wall.normal).expand(len(x), 2)
            return (x[:, self.disc] * normal).sum(dim=1) - self.wall.offset - table.radius, normal
        apart = x[:, self.disc] - x[:, self.other]
        distance = apart.square().sum(dim=1).clamp(min=1e-24).sqrt()
        return distance - 2 * table.radius, apart / distance[:, None]

    def closing(self, v: Places, normal: Axis) -> Row:
        """Return how fast the gap grows [m/s]; negative where the two approach."""
        relative = v[:, self.disc] if self.wall is not None else v[:, self.disc] - v[:, self.other]
        return (relative * normal).sum(dim=1)

    def spread(self, change: Axis, discs: int) -> Places:
        """Return what each disc gets of a change of the gap: all of it by a wall, half of it each by one another."""
        share = change if self.wall is not None else change / 2
        parts = [torch.zeros_like(share)] * discs
        parts[self.disc] = share
        if self.wall is None:
            parts[self.other] = -share
        return torch.stack(parts, dim=1)


def contacts_of(table: Table) -> list[Contact]:
    """Return all pairs that can touch."""
    walls = [Contact(disc, wall) for disc in range(table.discs) for wall in table.walls]
    return walls + [Contact(one, None, two) for one in range(table.discs) for two in range(one + 1, table.discs)]


def run(
    table: Table, x: Places, v: Places, pushes: list[tuple[Places, float]], dt: float, contacts: Contacts
) -> Places:
    """Return the positions of discs after each step, or of touch after each push, shape (frame, batch, disc, 2).

    `pushes` are accelerations [m/s^2], each with a duration [s].
    """
    frames = [x]
    for push, time in pushes:
        if contacts == "touch":
            x, v = fly(table, x, v, push, time, dt)
            frames.append(x)
            continue
        for _ in range(round(time / dt)):
            x, v = step(table, x, v, push, dt, shift=contacts == "shift")
            frames.append(x)
    return torch.stack(frames)


# ---- Steps of one length, semi-implicit Euler: a pair that would overlap at the end of a step is reflected in it.


def step(table: Table, x: Places, v: Places, push: Places, dt: float, *, shift: bool) -> tuple[Places, Places]:
    """Return positions and velocities a step later; `shift` corrects the positions by the time of touch."""
    ahead, kick, moved = x + dt * v, torch.zeros_like(v), torch.zeros_like(x)
    for one in contacts_of(table):
        gap, normal = one.gap(table, ahead)
        closing = one.closing(v, normal)
        met = (gap < 0) & (closing < 0)
        bounce = one.spread(-(1 + table.restitution) * closing[:, None] * normal, table.discs)
        bounce = torch.where(met[:, None, None], bounce, 0.0)
        kick = kick + bounce
        if shift:  # the touch was `gap / closing` before the step's end
            since = torch.where(met, gap, 0.0) / closing.clamp(max=-SLOWEST)
            moved = moved + (since - dt).clamp(max=0.0)[:, None, None] * bounce
    v = v + kick + dt * push
    return x + dt * v + moved, v


# ---- Flights from touch to touch: parabolas, whose times of touch are found and differentiated.


def fly(table: Table, x: Places, v: Places, push: Places, time: float, dt: float) -> tuple[Places, Places]:
    """Return positions and velocities after a time under one acceleration; touches are searched for every `dt`."""
    left, steps = x.new_full((len(x),), time), max(1, round(time / dt))
    pairs = contacts_of(table)
    for _ in range(TOUCHES):
        soonest, which = _first_touch(table, pairs, x.detach(), v.detach(), push.detach(), left.detach(), steps)
        if not bool((which >= 0).any()):
            break
        met = _refine(table, pairs, x, v, push, soonest, which)
        x, v = _drift(x, v, push, met)
        left = left - met
        for number, one in enumerate(pairs):
            _, normal = one.gap(table, x)
            change = one.spread(-(1 + table.restitution) * one.closing(v, normal)[:, None] * normal, table.discs)
            v = v + torch.where((which == number)[:, None, None], change, 0.0)
    return _drift(x, v, push, left)


def _drift(x: Places, v: Places, push: Places, time: Row) -> tuple[Places, Places]:
    t = time[:, None, None]
    return x + t * v + t * t / 2 * push, v + t * push


def _refine(
    table: Table, pairs: list[Contact], x: Places, v: Places, push: Places, soonest: Row, which: Int[Tensor, " batch"]
) -> Row:
    """Return times of touch that depend on the flight: one step of Newton's, whose derivative is the time's own."""
    there, speed = _drift(x, v, push, soonest)
    late = torch.zeros_like(soonest)
    for number, one in enumerate(pairs):
        gap, normal = one.gap(table, there)
        closing = torch.where(which == number, one.closing(speed, normal).detach(), -1.0)  # no row divides by 0
        late = torch.where(which == number, gap / closing, late)
    return soonest - late


@torch.no_grad()
def _first_touch(
    table: Table, pairs: list[Contact], x: Places, v: Places, push: Places, left: Row, steps: int
) -> tuple[Row, Int[Tensor, " batch"]]:
    """Return when each row's first touch is, and of which pair: the number of one that has none is -1."""
    soonest, which = left.clone(), torch.full((len(x),), -1)
    for number, one in enumerate(pairs):
        time, met = _crossing(table, one, (x, v, push), left, steps)
        first = met & (time < soonest)
        soonest, which = torch.where(first, time, soonest), torch.where(first, number, which)
    return torch.where(which >= 0, soonest, 0.0), which


def _crossing(
    table: Table, one: Contact, flight: tuple[Places, Places, Places], left: Row, steps: int
) -> tuple[Row, Bool[Tensor, " batch"]]:
    """Return when a gap first falls through 0 in the time that is left, by halving the step in which it does."""
    times = left[:, None] * torch.arange(steps + 1) / steps
    gap, closing = (of.view(times.shape) for of in _seen(table, one, flight, times))
    inside = (gap < 0) & (closing < 0)
    inside[:, 0] = False
    met, first = inside.any(dim=1), inside.int().argmax(dim=1, keepdim=True)
    high, low = times.gather(1, first)[:, 0], times.gather(1, (first - 1).clamp(min=0))[:, 0]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        under = _seen(table, one, flight, middle[:, None])[0] < 0
        low, high = torch.where(under, low, middle), torch.where(under, middle, high)
    return (low + high) / 2, met


def _seen(
    table: Table, one: Contact, flight: tuple[Places, Places, Places], times: Float[Tensor, "batch time"]
) -> tuple[Float[Tensor, " both"], Float[Tensor, " both"]]:
    """Return a gap and how fast it grows at times of each row's flight, the times of a row one after another."""
    x, v, push = (of.repeat_interleave(times.shape[1], dim=0) for of in flight)
    at, speed = _drift(x, v, push, times.flatten())
    gap, normal = one.gap(table, at)
    return gap, one.closing(speed, normal)
