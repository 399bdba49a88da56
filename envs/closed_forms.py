"""Positions of balls after one impact, in closed form: Newton's law and the time of touch, without a time step.

The tasks are those of Zhong, Han and Brikis 2022, "Differentiable Physics Simulations with Contacts: Do They Have
Correct Gradients w.r.t. Position, Velocity and Control?" (arXiv 2207.05060). Everything is differentiable in torch.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

Row = Float[Tensor, " batch"]
Pair = Float[Tensor, "batch 2"]

HELD = 1 / 480  # how long the first push of tasks 1 and 2 lasts [s]
GRAVITY = 9.8  # of task 2 [m/s^2]; the others have none
RADIUS, REACH = 0.1, 0.2  # of the ball of tasks 1 and 2, and of both of task 3 [m]
WALL = 1.75  # where the wall of task 2 stands [m]
LIVELY = 0.92  # restitution of task 2; that of the others is 1


def pushed(x: Tensor, v: Tensor, push: Tensor) -> tuple[Tensor, Tensor]:
    """Return position and velocity after the first push, an acceleration [m/s^2] of duration `HELD`."""
    return x + v * HELD + push * (HELD**2 / 2), v + push * HELD


def bounce_once(y: Row, v: Row, push: Row, time: float) -> Row:
    """Return the height [m] after some time without gravity: free flight, reflected by the elastic ground."""
    y, v = pushed(y, v, push)
    return RADIUS + (y + v * (time - HELD) - RADIUS).abs()


def ground_wall(x: Pair, v: Pair, push: Pair, time: float) -> Pair:
    """Return the position of a ball that hits the ground and the wall at most once each."""
    x, v = pushed(x, v, push - push.new_tensor([0.0, GRAVITY]))
    left = time - HELD
    ahead, face = x[:, 0] + v[:, 0] * left, WALL - RADIUS
    across = torch.where(ahead > face, face - LIVELY * (ahead - face), ahead)
    height, rise = x[:, 1] - RADIUS, v[:, 1]
    strike = (rise.square() + 2 * GRAVITY * height).sqrt()  # speed at which it meets the ground
    after = (left - (rise + strike) / GRAVITY).clamp(min=0.0)
    free = height + rise * left - GRAVITY / 2 * left**2
    bounced = LIVELY * strike * after - GRAVITY / 2 * after.square()
    return torch.stack([across, RADIUS + torch.where(after > 0, bounced, free)], dim=1)


def two_balls(x: Float[Tensor, "batch 2 2"], v: Float[Tensor, "batch 2 2"], push: Pair, time: float) -> Pair:
    """Return the position of the second of two equal balls; the first has a constant push [m/s^2] and strikes it."""
    apart, speed = x[:, 1] - x[:, 0], v[:, 1] - v[:, 0]
    touch = time_of_touch(apart, speed, -push, 2 * REACH)
    met = touch < time
    touch = torch.where(met, touch, 0.0)[:, None]
    there, closing = apart + touch * speed - touch.square() / 2 * push, speed - touch * push
    normal = there / there.norm(dim=1, keepdim=True)
    kick = -(closing * normal).sum(dim=1, keepdim=True) * normal  # equal masses exchange what they have of it
    return x[:, 1] + v[:, 1] * time + torch.where(met[:, None], kick * (time - touch), 0.0)


def time_of_touch(apart: Pair, speed: Pair, push: Pair, reach: float) -> Row:
    """Return when |apart + t speed + t^2 push / 2| falls to `reach`: the first root of a quartic, or infinity."""
    a, b, c = apart.detach(), speed.detach(), push.detach() / 2
    quartic = [_dot(c, c), 2 * _dot(b, c), _dot(b, b) + 2 * _dot(a, c), 2 * _dot(a, b), _dot(a, a) - reach**2]
    monic = torch.stack(quartic[1:], dim=1) / quartic[0].clamp(min=1e-12)[:, None]
    companion = torch.diag_embed(torch.ones(len(a), 3, dtype=a.dtype), offset=-1)
    companion[:, 0] = -monic
    roots = torch.linalg.eigvals(companion)
    real = (roots.imag.abs() < 1e-7) & (roots.real > 0)
    first = torch.where(real, roots.real, torch.inf).amin(dim=1)
    there = first.isfinite()
    t = torch.where(there, first, 0.0)[:, None]
    at, rate = apart + t * speed + t.square() / 2 * push, (speed + t * push).detach()
    late = (at.square().sum(dim=1) - reach**2) / torch.where(there, 2 * _dot(at.detach(), rate), 1.0)
    return torch.where(there, t[:, 0] - late, torch.inf)


def _dot(one: Pair, two: Pair) -> Row:
    return (one * two).sum(dim=1)
