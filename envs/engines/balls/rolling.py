"""How a ball moves that a surface carries: along a face evenly accelerated, around a bar's end by Runge and Kutta.

On a face gravity and friction are constant until sliding turns into rolling, so that the path is a parabola's too. A
round end is a pendulum with friction, without a closed form: steps of ARC, whatever the scene's step, classical
Runge-Kutta.
"""

from functools import cache, partial
from typing import Any, NamedTuple, no_type_check

import warp as wp

from ..runtime import precision
from .board import FREE, surfaces

ARC = wp.constant(1 / 240)  # the step around a round end [s]


class Rolling(NamedTuple):
    """Warp functions and the struct `Turn`: where a ball is on a round end, how fast, and how much it spins."""

    Turn: Any
    regime: Any
    carry: Any
    start: Any
    advance: Any
    press: Any
    slip_rate: Any
    press_rate: Any
    grip: Any
    grip_rate: Any


@cache
@no_type_check
def rolling(name: str) -> Rolling:
    """Return the functions of one precision."""
    real = precision(name).real
    vec2 = wp.types.vector(2, real)
    module = f"gradscape.rolling.{name}"
    shared = surfaces(name)
    Data, outward, anchor = shared.Data, shared.outward, shared.anchor
    Reals = wp.array2d[real]

    @partial(wp.struct, module=module)
    class Turn:
        """The angle of the normal [rad], the speed along the surface [m/s], counterclockwise, and the spin [rad/s]."""

        phi: real
        s: real
        spin: real

    @wp.func(module=module)
    def regime(data: Data, slip: real, scale: real, along: real, press: real) -> real:
        """Return which way a carried ball slides, 1 or -1, or 0 where it rolls; `along` is gravity's part."""
        if wp.abs(slip) > data.graze * scale:
            return wp.sign(slip)
        if wp.abs(along) * data.inertia > data.friction * press * (real(1.0) + data.inertia):
            return wp.sign(along)
        return real(0.0)

    @wp.func(module=module)
    def rub(data: Data, mode: real, along: real, press: real) -> real:
        if mode == real(0.0):
            return -along * data.inertia / (real(1.0) + data.inertia)
        return -mode * data.friction * press

    @wp.func(module=module)
    def carry(data: Data, support: int, angle: Reals, e: int, here: vec2, v: vec2, spin: real):
        """Return acceleration, that of spin, and when slip ends: of a ball that flies, or that a face carries."""
        if support == FREE:
            return vec2(real(0.0), -data.gravity), real(0.0), real(1e9)
        n = outward(data, support, angle, e, here)
        t = vec2(-n[1], n[0])
        along, press = -data.gravity * t[1], data.gravity * n[1]
        slip = wp.dot(v, t) - data.radius * spin
        mode = regime(data, slip, wp.length(v) + data.radius * wp.abs(spin), along, press)
        push = rub(data, mode, along, press)
        rate = along + push * (real(1.0) + data.inertia) / data.inertia
        last = real(1e9)
        if mode * slip > real(0.0) and mode * rate < real(0.0):
            last = -slip / rate
        return (along + push) * t, -push / (data.inertia * data.radius), last

    @wp.func(module=module)
    def start(data: Data, support: int, angle: Reals, e: int, here: vec2, v: vec2, spin: real) -> Turn:
        n = here - anchor(data, support, angle, e)
        turn = Turn()
        turn.phi = wp.atan2(n[1], n[0])
        turn.s = wp.dot(v, vec2(-n[1], n[0])) / wp.length(n)
        turn.spin = spin
        return turn

    @wp.func(module=module)
    def press(data: Data, turn: Turn) -> real:
        """Return the force of a round end by mass, below 0 where the ball leaves it."""
        return data.gravity * wp.sin(turn.phi) - turn.s * turn.s / data.reach

    @wp.func(module=module)
    def rate(data: Data, mode: real, turn: Turn) -> Turn:
        """Return what changes; past lift-off, which ends this motion, friction goes on smoothly below 0."""
        along = -data.gravity * wp.cos(turn.phi)
        push = rub(data, mode, along, press(data, turn))
        found = Turn()
        found.phi = turn.s / data.reach
        found.s = along + push
        found.spin = -push / (data.inertia * data.radius)
        return found

    @wp.func(module=module)
    def slip_rate(data: Data, mode: real, turn: Turn) -> real:
        found = rate(data, mode, turn)
        return found.s - data.radius * found.spin

    @wp.func(module=module)
    def press_rate(data: Data, mode: real, turn: Turn) -> real:
        found = rate(data, mode, turn)
        return (data.gravity * wp.cos(turn.phi) - real(2.0) * found.s) * turn.s / data.reach

    @wp.func(module=module)
    def grip(data: Data, turn: Turn) -> real:
        """Return by how much friction exceeds what rolling takes, below 0 where it does not hold."""
        taken = data.gravity * wp.abs(wp.cos(turn.phi)) * data.inertia
        return data.friction * press(data, turn) * (real(1.0) + data.inertia) - taken

    @wp.func(module=module)
    def grip_rate(data: Data, mode: real, turn: Turn) -> real:
        taken = -data.gravity * wp.sign(wp.cos(turn.phi)) * wp.sin(turn.phi) * turn.s / data.reach * data.inertia
        return data.friction * press_rate(data, mode, turn) * (real(1.0) + data.inertia) - taken

    @wp.func(module=module)
    def moved(turn: Turn, t: real, by: Turn) -> Turn:
        found = Turn()
        found.phi = turn.phi + t * by.phi
        found.s = turn.s + t * by.s
        found.spin = turn.spin + t * by.spin
        return found

    @wp.func(module=module)
    def advance(data: Data, mode: real, turn: Turn, t: real) -> Turn:
        half = real(0.5) * t
        k1 = rate(data, mode, turn)
        k2 = rate(data, mode, moved(turn, half, k1))
        k3 = rate(data, mode, moved(turn, half, k2))
        k4 = rate(data, mode, moved(turn, t, k3))
        ends = moved(moved(turn, t / real(6.0), k1), t / real(6.0), k4)
        return moved(moved(ends, t / real(3.0), k2), t / real(3.0), k3)

    return Rolling(Turn, regime, carry, start, advance, press, slip_rate, press_rate, grip, grip_rate)
