"""The ball of `bounce` by another hand: analytic flight, and contact integrated by scipy between its own events."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from gradscape.envs.engines.balls.rigid import SMOOTHING, Ball

TIGHT = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-11}


@dataclass(frozen=True)
class Thrown:
    """Where a ball is and how fast, shape (3,) each, and what both become per vertical speed of the throw."""

    x: np.ndarray
    v: np.ndarray
    dx: np.ndarray
    dv: np.ndarray


def throw(ball: Ball, start, velocity, time: float, *, smooth: bool = False, touch_moves: bool = True) -> Thrown:
    """Follow a ball that does not spin, in still air, and its derivative by the vertical speed of the throw.

    The derivative obeys the variational equation. With `touch_moves` it contains that a touch comes earlier or later:
    there the force jumps from 0 to kd |v|, so that the derivative of the velocity jumps too; without, it does not.
    """
    x, v = np.array(start, dtype=float), np.array(velocity, dtype=float)
    dx, dv = np.zeros(3), np.array([0.0, 1.0, 0.0])
    g = np.array([0.0, -ball.gravity, 0.0])
    while True:
        fall = (v[1] + np.sqrt(v[1] ** 2 + 2 * ball.gravity * max(x[1] - ball.radius, 0.0))) / ball.gravity
        t = min(fall, time)
        x, v, dx = x + v * t + g * t**2 / 2, v + g * t, dx + dv * t
        time -= t
        if time <= 0:
            return Thrown(x, v, dx, dv)
        x[1] = ball.radius
        if touch_moves:
            dv = dv - force(ball, x, v, smooth) / ball.mass * (-dx[1] / v[1])
        x, v, dx, dv, lasting = touch(ball, (x, v, dx, dv), time, smooth=smooth)
        time -= lasting


def force(ball: Ball, x, v, smooth: bool) -> np.ndarray:
    """Return the ground's force on a ball [N], normal and frictional."""
    depth = ball.radius - x[1]
    damping = ball.kd * (depth / (SMOOTHING * ball.radius) if smooth else 1.0)
    f_n = ball.ke * depth - damping * min(v[1], 0.0)
    slip = np.array([v[0], 0.0, v[2]])
    speed = np.linalg.norm(slip)
    return np.array([0.0, f_n, 0.0]) - min(ball.kf, ball.mu * f_n / max(speed, 1e-300)) * slip


def touch(ball: Ball, state, time: float, *, smooth: bool):
    """Follow a contact until the ball leaves or the time is over; the force is differentiated by differences."""

    def rate(_, s):
        x, v, dx, dv = s.reshape(4, 3)
        h = 1e-7
        ahead, back = (force(ball, x + sign * h * dx, v + sign * h * dv, smooth) for sign in (1, -1))
        a = force(ball, x, v, smooth) / ball.mass + np.array([0.0, -ball.gravity, 0.0])
        return np.concatenate([v, a, dv, (ahead - back) / (2 * h * ball.mass)])

    def leaving(t, s):
        return s[1] - ball.radius if t > 0 else -1.0

    leaving.terminal, leaving.direction = True, 1
    found = solve_ivp(rate, (0.0, time), np.concatenate(state), events=leaving, max_step=5e-3, **TIGHT)
    return *found.y[:, -1].reshape(4, 3), float(found.t[-1])


def restitution(ball: Ball) -> float:
    """Return the speed after a contact by that before it, where gravity does nothing in between.

    Approaching is a quarter of a damped oscillation, departing a quarter of an undamped one.
    """
    zeta = ball.kd / (2 * math.sqrt(ball.ke * ball.mass))  # below 1 for a contact that swings
    root = math.sqrt(1 - zeta**2)
    return math.exp(-zeta / root * math.atan2(root, zeta))


def instant_flight(ball: Ball, y: float, v: float, time: float) -> float:
    """Return the height of a ball that leaves the ground at once, with the effective restitution."""
    while True:
        lasting = (v + math.sqrt(v**2 + 2 * ball.gravity * (y - ball.radius))) / ball.gravity
        if lasting >= time:
            return y + v * time - ball.gravity * time**2 / 2
        time, y, v = time - lasting, ball.radius, -restitution(ball) * (v - ball.gravity * lasting)
