"""Pinball by another hand: from impact to impact, times by numpy's roots of polynomials, one ball at a time."""

from __future__ import annotations

import numpy as np

from gradscape.envs.engines.balls.impacts import Board

SLOW = 0.2  # impacts slower than this [m/s] come close to resting, which is not modelled here


def end_of_flight(board: Board, angles, start, time: float) -> np.ndarray | None:
    """Return where a ball dropped at rest is after `time` [s], or None where it has met something slowly."""
    x, v, spin = np.array(start, dtype=float), np.zeros(2), 0.0
    g = np.array([0.0, -board.gravity])
    while True:
        t, n = first_impact(board, angles, x, v, g)
        if t >= time:
            return x + v * time + g * time**2 / 2
        time, x, v = time - t, x + v * t + g * t**2 / 2, v + g * t
        if -(v @ n) < SLOW:
            return None
        along = np.array([-n[1], n[0]])
        push = -(1 + board.restitution) * (v @ n)
        slip = v @ along - board.ball_radius * spin
        rub = -np.sign(slip) * min(abs(slip) * board.inertia / (1 + board.inertia), board.friction * push)
        v, spin = v + push * n + rub * along, spin - rub / (board.inertia * board.ball_radius)


def first_impact(board: Board, angles, x, v, g):
    """Return when and against which normal a parabola first enters anything."""
    r, reach = board.ball_radius, board.ball_radius + board.bar_radius
    corner, opposite = np.zeros(2), np.array([board.width, board.height])
    found = []
    for point, n in ((corner, (1, 0)), (corner, (0, 1)), (opposite, (-1, 0)), (opposite, (0, -1))):
        h = np.array(n, dtype=float)
        found += [(t, h) for t in entries([g @ h / 2, v @ h, (x - point) @ h - r])]
    for pivot, angle in zip(board.pivots, angles, strict=True):
        axis = np.array([np.cos(angle), np.sin(angle)])
        for side in (1.0, -1.0):
            n = side * np.array([-axis[1], axis[0]])
            for t in entries([g @ n / 2, v @ n, (x - pivot) @ n - reach]):
                if abs((x + v * t + g * t**2 / 2 - pivot) @ axis) <= board.half_length:
                    found.append((t, n))
            d = x - pivot - side * board.half_length * axis
            f = np.polyadd(np.polymul(*2 * [[g[0] / 2, v[0], d[0]]]), np.polymul(*2 * [[g[1] / 2, v[1], d[1]]]))
            found += [(t, (d + v * t + g * t**2 / 2) / reach) for t in entries(np.polyadd(f, [-(reach**2)]))]
    return min(found, key=lambda one: one[0])


def entries(f) -> list[float]:
    """Return the times after now at which a polynomial falls through 0; the one just left does not count."""
    slope = np.polyder(f)
    real = [root.real for root in np.roots(f) if abs(root.imag) < 1e-9]
    return [t for t in real if t > 1e-9 and np.polyval(slope, t) < 0]
