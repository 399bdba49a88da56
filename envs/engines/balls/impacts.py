"""One ball among walls and bars in a plane, from event to event, each at its exact time.

Between impacts the ball flies a parabola, and where a face carries it, its path is one too: `roots` says when it meets
what. A step only bounds how far one looks ahead. One iteration takes a row to its next event, or to the end of its
step: `find` says what comes first and when, `move` goes there. One launch takes every row through all its iterations.
Only `move` is differentiated, its adjoint running through them in reverse; it corrects the time by a step of Newton's,
whose derivative is the time's own.
"""

from dataclasses import dataclass
from functools import cache, partial
from typing import Any, no_type_check

import torch
import warp as wp

from ..runtime import load, precision, to_torch

# ---- When a point on a parabola enters what a ball may meet: a half-plane in closed form, a disc by safe steps.

NEVER = wp.constant(-1.0)
BEYOND = wp.constant(1e-3)  # below a plane by more than this [m], a point is on its other side, not touching
STEPS = wp.constant(200)  # towards a disc; ten are taken where the parabola does not graze it
ROUND = {"float32": 2e-5, "float64": 1e-12}  # squared distances, by that of touching, that rounding cannot tell from 0


@cache
@no_type_check
def roots(name: str) -> tuple[Any, Any]:
    """Return the functions of a plane and of a disc, in one precision: they give a time, or NEVER."""
    real, module = precision(name).real, f"gradscape.roots.{name}"
    vec2 = wp.types.vector(2, real)
    touching, straight = ROUND[name], -1e3 * ROUND[name]

    @wp.func(module=module)
    def plane(h: real, u: real, a: real, least: real) -> real:
        """Return when h + u t + a t^2 / 2 falls below 0, faster than `least`."""
        square = u * u - real(2.0) * a * h
        if a >= real(0.0) and (u >= real(0.0) or square <= least * least):
            return real(NEVER)
        if h < real(-BEYOND) and (u <= real(0.0) or square <= least * least):
            return real(NEVER)
        root = wp.sqrt(wp.max(square, real(0.0)))
        if u < real(0.0):
            return real(2.0) * wp.max(h, real(0.0)) / (root - u)
        return (u + root) / -a

    @wp.func(module=module)
    def again(m: vec2, v: vec2, a: vec2) -> real:
        """Return when a parabola that leaves a circle along its tangent is back: f / t^2 is quadratic."""
        c2 = wp.dot(v, v) + wp.dot(m, a)
        c3 = wp.dot(v, a)
        c4 = real(0.25) * wp.dot(a, a)
        if c2 < real(straight) * wp.dot(v, v):
            return real(0.0)
        square = c3 * c3 - real(4.0) * c2 * c4
        if c3 >= real(0.0) or square <= real(0.0):
            return real(NEVER)
        return real(2.0) * c2 / (wp.sqrt(square) - c3)

    @wp.func(module=module)
    def disc(m: vec2, v: vec2, a: vec2, reach: real, soonest: real, least: real) -> real:
        """Return when, before `soonest`, |m + v t + a t^2 / 2| falls below `reach`, faster than `least`.

        f = d.d - reach^2 is nowhere below its tangent less bend t^2 / 2, where `bend` bounds -f'': a step to the root
        of that never passes the first root of f, and ends like Newton's.
        """
        small = real(touching) * reach * reach
        far = wp.length(m) + soonest * (wp.length(v) + soonest * wp.length(a))
        bend = real(2.0) * far * wp.length(a) + small
        graze = real(2.0) * reach * least
        t = real(0.0)
        if wp.dot(m, m) - reach * reach < small and wp.abs(wp.dot(m, v)) <= least * reach:
            return again(m, v, a)
        for _ in range(STEPS):
            d = m + t * v + (real(0.5) * t * t) * a
            f = wp.dot(d, d) - reach * reach
            slope = real(2.0) * wp.dot(d, v + t * a)
            if f <= small and slope < graze:
                u = v + t * a
                falls = wp.dot(u, u) + wp.dot(d, a) < real(straight) * wp.dot(u, u)
                if slope < -graze or falls:
                    return t
                if slope < real(0.0):
                    return real(NEVER)
            root = wp.sqrt(slope * slope + real(2.0) * bend * wp.max(f, real(0.0)))
            ahead = (slope + root) / bend
            if slope < real(0.0):
                ahead = real(2.0) * f / (root - slope)
            if slope < -graze and t + ahead == t:  # as near as numbers come
                return t
            t += ahead
            if t >= soonest:
                return real(NEVER)
        return real(NEVER)

    return plane, disc


# ---- The surfaces a ball meets in a plane, walls and bars: where they are, and what an impact does.
#
# Surfaces are numbered: 4 k + 0, 1, 2, 3 are the upper face, lower face, right end and left end of bar k; after the
# bars come floor, ceiling, left and right wall. The ball's centre against a bar is a point against a stadium of radius
# R.

FREE, DONE = wp.constant(-1), wp.constant(-2)  # no surface; a row whose episode is over
INERTIA, RIGID = 0.4, 1e9  # in units of mass and radius squared: of a solid sphere, of one that as good as never spins
GRAZE = {"float32": 1e-6, "float64": 1e-12}  # cosines (squared, at round ends) that rounding cannot tell from 0


@dataclass(frozen=True)
class Board:
    """A board of `width` x `height` [m] with bars of one shape, and a ball that is a solid sphere.

    `pivots` [m] are the bars' centres, `half_length` [m] reaches to the centres of their round ends, `bar_radius` is
    half their thickness. A rebound is `restitution` times as fast as the impact, less below `crawl` [m/s], where the
    factor fades to zero; `friction` is Coulomb's. Masses cancel: impulses are per mass [m/s]. `gravity` [m/s^2] points
    down; `inertia` is in units of mass and radius squared.
    """

    width: float
    height: float
    pivots: tuple[tuple[float, float], ...]
    half_length: float
    bar_radius: float
    ball_radius: float
    restitution: float
    friction: float
    crawl: float = 0.1
    gravity: float = 9.81
    inertia: float = INERTIA


def constants(board: Board, *, dt: float, steps: int, name: str, device: str) -> Any:
    """Return the struct that kernels read a board from."""
    data = surfaces(name)[0]()
    data.dt, data.steps = dt, steps
    data.pivot = wp.array(board.pivots, dtype=wp.types.vector(2, precision(name).real), device=device)
    data.width, data.height, data.half_length = board.width, board.height, board.half_length
    data.radius, data.reach = board.ball_radius, board.ball_radius + board.bar_radius
    data.restitution, data.friction, data.crawl = board.restitution, board.friction, board.crawl
    data.gravity, data.inertia, data.graze = board.gravity, board.inertia, GRAZE[name]
    return data


@cache
@no_type_check
def surfaces(name: str) -> tuple[Any, ...]:
    """Return what both contact rules ask of geometry and friction, after the struct `Data` of their constants."""
    real = precision(name).real
    vec2 = wp.types.vector(2, real)
    Reals = wp.array2d[real]
    module = f"gradscape.board.{name}"

    @partial(wp.struct, module=module)
    class Data:
        """Those of Board, and the step; `reach` is ball and bar together, `graze` a cosine too small to meet."""

        dt: real
        steps: int
        pivot: wp.array[vec2]
        width: real
        height: real
        half_length: real
        radius: real
        reach: real
        restitution: real
        friction: real
        crawl: real
        gravity: real
        inertia: real
        graze: real

    @wp.func(module=module)
    def along(angle: real) -> vec2:
        return vec2(wp.cos(angle), wp.sin(angle))

    @wp.func(module=module)
    def anchor(data: Data, surface: int, angle: Reals, e: int) -> vec2:
        """Return a point in a wall or in a bar's axis; of a round end, its centre."""
        k = surface // 4
        side = real(1.0) - real(2.0) * real(surface % 2)
        if k < data.pivot.shape[0]:
            if surface % 4 < 2:
                return data.pivot[k]
            return data.pivot[k] + side * data.half_length * along(angle[e, k])
        if side > real(0.0):
            return vec2(real(0.0), real(0.0))
        return vec2(data.width, data.height)

    @wp.func(module=module)
    def outward(data: Data, surface: int, angle: Reals, e: int, here: vec2) -> vec2:
        """Return a surface's unit normal, towards the ball."""
        k = surface // 4
        side = real(1.0) - real(2.0) * real(surface % 2)
        if k < data.pivot.shape[0]:
            if surface % 4 < 2:
                axis = along(angle[e, k])
                return vec2(-side * axis[1], side * axis[0])
            return wp.normalize(here - anchor(data, surface, angle, e))
        if surface % 4 < 2:
            return vec2(real(0.0), side)
        return vec2(side, real(0.0))

    @wp.func(module=module)
    def distance(data: Data, surface: int, angle: Reals, e: int, here: vec2) -> real:
        """Return how far the ball is from a wall, from a face as if it were endless, or from a round end."""
        n = outward(data, surface, angle, e, here)
        clearance = data.radius
        if surface // 4 < data.pivot.shape[0]:
            clearance = data.reach
        return wp.dot(n, here - anchor(data, surface, angle, e)) - clearance

    @wp.func(module=module)
    def candidate(data: Data, k: int, angle: Reals, e: int, here: vec2) -> int:
        """Return the surface of bar `k` that is nearest; the numbers after those of bars are walls'."""
        bars = data.pivot.shape[0]
        if k >= bars:
            return 3 * bars + k
        to = here - data.pivot[k]
        axis = along(angle[e, k])
        ahead = wp.dot(to, axis)
        if ahead > data.half_length:
            return 4 * k + 2
        if ahead < -data.half_length:
            return 4 * k + 3
        return 4 * k + wp.where(axis[0] * to[1] - axis[1] * to[0] > real(0.0), 0, 1)

    @wp.func(module=module)
    def coulomb(stick: real, limit: real) -> real:
        """Return the friction that holds, where it may be that large, or else the largest."""
        if wp.abs(stick) < limit:
            return stick
        return wp.sign(stick) * limit

    @wp.func(module=module)
    def rebound(data: Data, approach: real) -> real:
        """Return the speed after an impact at the speed `approach`."""
        return data.restitution * wp.min(real(1.0), approach / data.crawl) * approach

    @wp.func(module=module)
    def deflect(data: Data, n: vec2, v: vec2, spin: real, after: real):
        """Return velocity and spin after an impact that leaves the normal speed `after`."""
        t = vec2(-n[1], n[0])
        push = after - wp.dot(v, n)
        slip = wp.dot(v, t) - data.radius * spin
        stick = -slip * data.inertia / (real(1.0) + data.inertia)
        rub = coulomb(stick, data.friction * wp.max(push, real(0.0)))
        return v + push * n + rub * t, spin - rub / (data.inertia * data.radius)

    return Data, along, anchor, outward, distance, candidate, rebound, deflect


# ---- How a ball moves that a surface carries: along a face evenly accelerated, around a bar's end by Runge and Kutta.
#
# On a face gravity and friction are constant until sliding turns into rolling, so that the path is a parabola's too. A
# round end is a pendulum with friction, without a closed form: steps of ARC, whatever the scene's step, classical
# Runge-Kutta.

ARC = wp.constant(1 / 240)  # the step around a round end [s]


@cache
@no_type_check
def rolling(name: str) -> tuple[Any, ...]:
    """Return the functions of one precision, after the struct of a ball's motion around a round end."""
    real = precision(name).real
    vec2, Reals = wp.types.vector(2, real), wp.array2d[real]
    module = f"gradscape.rolling.{name}"
    Data, _, anchor, outward, *_ = surfaces(name)

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
        """Return what changes; past lift-off, which ends this motion, friction continues smoothly below 0."""
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

    return Turn, regime, carry, start, advance, press, slip_rate, press_rate, grip, grip_rate


# ---- The kernels that take a row through its whole episode: one launch there, and one back for derivatives.
#
# A launch costs more than an event, and rows have their events at times of their own: a thread follows its row alone.


Kernels = tuple[Any, Any]  # one that takes rows from event to event until they are done, and one that goes back


@cache
@no_type_check
def path_struct(name: str) -> Any:
    """Return the struct of rows' states in one precision."""
    real = precision(name).real
    vec2 = wp.types.vector(2, real)

    @partial(wp.struct, module=f"gradscape.episodes.{name}")
    class Path:
        """The state at the start of every iteration, as `Flight` says it, arrays [iteration, row]."""

        x: wp.array2d[vec2]
        v: wp.array2d[vec2]
        spin: wp.array2d[real]
        rest: wp.array2d[real]
        step: wp.array2d[int]
        impacts: wp.array2d[int]
        support: wp.array2d[int]
        pick: wp.array2d[int]
        hits: wp.array2d[int]
        when: wp.array2d[real]

    return Path


@no_type_check
def episode_kernels(module: str, name: str, find: Any, move: Any) -> Kernels:
    """Return the kernels of one precision that repeat two Warp functions of one iteration of one row.

    `find` says what comes first and when, and `move` goes there: from the state at i, which both read, it writes that
    at i + 1. Nothing else is carried from one iteration to the next: variables that a loop carries would be lost to its
    derivatives.
    """
    real = precision(name).real
    Data, Path, Reals = surfaces(name)[0], path_struct(name), wp.array2d[real]

    @wp.kernel(module=module, enable_backward=False)
    def follow(last: int, taken: wp.array[int], data: Data, angle: Reals, path: Path):
        """Go on from iteration `taken`, and leave there where a row has come to: done, or at the `last` it may take."""
        e = wp.tid()
        i = taken[e]
        while i < last and path.step[i, e] < data.steps:
            find(i, e, data, angle, path)
            move(i, e, data, angle, path)
            i += 1
        taken[e] = i
        path.pick[i, e] = DONE

    @wp.func_replay(move)
    def stay(i: int, e: int, data: Data, angle: Reals, path: Path):
        """Do nothing, since all states are kept: the adjoint of a loop would repeat each move before it goes back."""

    @wp.kernel(module=module)
    def retrace(taken: wp.array[int], data: Data, angle: Reals, path: Path):
        e = wp.tid()
        for i in range(taken[e]):
            move(i, e, data, angle, path)

    return follow, retrace


# ---- The kernels of the ball among walls and bars: what comes first and when, and how the ball goes there.

JAM = wp.constant(8)  # events at once after which the rest of a step is dropped: the ball is stuck between surfaces
LINGER = wp.constant(1e-3)  # a ball that would be back sooner [s] stays: it hops by a micrometre
SLIDES, EDGE = wp.constant(-3), wp.constant(-4)  # slip ends; a face or round end ends
LEAVES, SLIPS = wp.constant(-5), wp.constant(-6)  # lift-off; friction does not hold any more
HALVES = {"float32": 20, "float64": 50}  # bisections of an event's time around a round end
SURE = wp.constant(2e-5)  # times [s] are known better than this where a ball does not graze


@cache
@no_type_check
def impact_kernels(name: str) -> Kernels:
    """Return the kernels of one precision."""
    real = precision(name).real
    vec2 = wp.types.vector(2, real)
    Reals, Path = wp.array2d[real], path_struct(name)
    module, halves = f"gradscape.impacts.{name}", HALVES[name]
    plane, disc = roots(name)
    Turn, regime, carry, start, advance, press, slip_rate, press_rate, grip, grip_rate = rolling(name)
    Data, along, anchor, outward, distance, candidate, rebound, deflect = surfaces(name)

    @wp.func(module=module)
    def is_round(data: Data, surface: int) -> bool:
        return surface >= 0 and surface // 4 < data.pivot.shape[0] and surface % 4 >= 2

    @wp.func(module=module)
    def hit_bar(data: Data, p: vec2, v: vec2, a: vec2, soonest: real, least: real):
        """Return when and where, before `soonest`, a parabola from p enters a bar, in the bar's frame."""
        met = int(FREE)
        L, R = data.half_length, data.reach
        for k in range(2):
            side = real(1.0) - real(2.0) * real(k)
            t = plane(side * p[1] - R, side * v[1], side * a[1], least)
            where = p[0] + t * (v[0] + real(0.5) * t * a[0])
            if t >= real(0.0) and wp.abs(v[1] + t * a[1]) <= least:  # it does not settle where it is just leaving
                where += real(SURE) * v[0]
            if t >= real(0.0) and t < soonest and wp.abs(where) <= L:
                soonest = t
                met = wp.where(side > real(0.0), 0, 1)
            t = disc(vec2(p[0] - side * L, p[1]), v, a, R, soonest, least)
            where = p[0] + t * (v[0] + real(0.5) * t * a[0])
            if t >= real(0.0) and t < soonest and side * where >= L:
                soonest = t
                met = wp.where(side > real(0.0), 2, 3)
        return soonest, met

    @wp.func(module=module)
    def edge(data: Data, support: int, angle: Reals, e: int, here: vec2, v: vec2, a: vec2) -> real:
        """Return when a ball that a face carries comes to its end."""
        axis = along(angle[e, support // 4])
        q = wp.dot(here - data.pivot[support // 4], axis)
        s, b = wp.dot(v, axis), wp.dot(a, axis)
        t = real(1e9)
        ahead = plane(data.half_length - q, -s, -b, real(0.0))
        if ahead >= real(0.0):
            t = ahead
        back = plane(data.half_length + q, s, b, real(0.0))
        if back >= real(0.0) and back < t:
            t = back
        return t

    @wp.func(module=module)
    def event(data: Data, support: int, angle: Reals, e: int, mode: real, turn: Turn) -> int:
        """Return what has happened to a ball around a round end, or FREE."""
        if press(data, turn) < real(0.0):
            return LEAVES
        n = vec2(wp.cos(turn.phi), wp.sin(turn.phi))
        v = turn.s * vec2(-n[1], n[0])
        if mode == real(0.0) and grip(data, turn) < real(0.0):
            return SLIPS
        if mode * (turn.s - data.radius * turn.spin) < real(0.0):
            return SLIDES
        side = real(1.0) - real(2.0) * real(support % 2)
        if side * wp.dot(n, along(angle[e, support // 4])) < real(0.0):
            return EDGE
        here = anchor(data, support, angle, e) + data.reach * n
        for k in range(data.pivot.shape[0] + 4):
            surface = candidate(data, k, angle, e, here)
            approach = -wp.dot(outward(data, surface, angle, e, here), v)
            if k != support // 4 and approach > real(0.0) and distance(data, surface, angle, e, here) < real(0.0):
                return surface
        return FREE

    @wp.func(module=module)
    def mode_of(data: Data, turn: Turn) -> real:
        slip = turn.s - data.radius * turn.spin
        scale = wp.abs(turn.s) + data.radius * wp.abs(turn.spin)
        return regime(data, slip, scale, -data.gravity * wp.cos(turn.phi), press(data, turn))

    @wp.func(module=module)
    def around(data: Data, support: int, angle: Reals, e: int, turn: Turn, span: real):
        """Return when and what happens first around a round end."""
        mode = mode_of(data, turn)
        early, late = real(0.0), wp.min(span, real(ARC))
        met = event(data, support, angle, e, mode, advance(data, mode, turn, late))
        if met != FREE:
            for _ in range(halves):
                t = real(0.5) * (early + late)
                now = event(data, support, angle, e, mode, advance(data, mode, turn, t))
                if now == FREE:
                    early = t
                else:
                    late = t
                    met = now
        return late, met

    @wp.func(module=module)
    def first_met(
        data: Data, support: int, angle: Reals, e: int, here: vec2, v: vec2, a: vec2, soonest: real, first: int
    ):
        """Return when and what, before `soonest`, a parabola meets first; what carries the ball is not met."""
        pace = wp.length(v) + soonest * wp.length(a)
        least = data.graze * (pace + data.crawl)
        near = data.half_length + data.reach + soonest * pace
        bars = data.pivot.shape[0]
        for k in range(bars):
            to = here - data.pivot[k]
            if wp.dot(to, to) <= near * near and (support == FREE or support // 4 != k):
                axis = along(angle[e, k])
                across = vec2(-axis[1], axis[0])
                p = vec2(wp.dot(to, axis), wp.dot(to, across))
                u, b = vec2(wp.dot(v, axis), wp.dot(v, across)), vec2(wp.dot(a, axis), wp.dot(a, across))
                t, met = hit_bar(data, p, u, b, soonest, least)
                if met != FREE:
                    first = 4 * k + met
                    soonest = t
        for wall in range(4 * bars, 4 * bars + 4):
            if wall != support:
                n = outward(data, wall, angle, e, here)
                t = plane(distance(data, wall, angle, e, here), wp.dot(n, v), wp.dot(n, a), least)
                if t >= real(0.0) and t < soonest:
                    first = wall
                    soonest = t
        return soonest, first

    @wp.func(module=module)
    def find(i: int, e: int, data: Data, angle: Reals, path: Path):
        here, carrier, span = path.x[i, e], path.support[i, e], path.rest[i, e]
        path.pick[i, e] = FREE
        path.when[i, e] = span
        if span <= data.graze * data.dt:  # nothing but rounding is left of the step
            return
        if is_round(data, carrier):
            turn = start(data, carrier, angle, e, here, path.v[i, e], path.spin[i, e])
            late, event_there = around(data, carrier, angle, e, turn, span)
            path.when[i, e] = late
            path.pick[i, e] = event_there
            return
        a, _, last = carry(data, carrier, angle, e, here, path.v[i, e], path.spin[i, e])
        soonest, first = real(span), int(FREE)
        if last < soonest:
            soonest = last
            first = SLIDES
        if carrier >= 0 and carrier // 4 < data.pivot.shape[0]:
            end = edge(data, carrier, angle, e, here, path.v[i, e], a)
            if end < soonest:
                soonest = end
                first = EDGE
        t, met = first_met(data, carrier, angle, e, here, path.v[i, e], a, soonest, first)
        path.when[i, e] = t
        path.pick[i, e] = met

    @wp.func(module=module)
    def correct(data: Data, t: real, gap: real, speed: real, least: real) -> real:
        """Return Newton's next time of an event, found to rounding: its derivative is that of the event's time."""
        if wp.abs(speed) <= least or wp.abs(gap) > real(SURE) * wp.abs(speed):  # it grazes
            return t
        if t - gap / speed < -data.graze:  # it is wedged: going back in time would speed it up
            return t
        return t - gap / speed

    @wp.func(module=module)
    def time_of_event(
        data: Data, surface: int, support: int, angle: Reals, e: int, t: real, x: vec2, v: vec2, slip: real, rate: real
    ) -> real:
        """Return the corrected time of an event at which the ball is at x with v, slipping more by `rate`."""
        least = data.graze * (wp.length(v) + data.crawl)
        if surface >= 0:
            n = outward(data, surface, angle, e, x)
            return correct(data, t, distance(data, surface, angle, e, x), wp.dot(n, v), least)
        if surface == EDGE:
            axis = along(angle[e, support // 4])
            q = wp.dot(x - data.pivot[support // 4], axis)
            return correct(data, t, q - wp.sign(q) * data.half_length, wp.dot(axis, v), least)
        if surface == SLIDES or surface == LEAVES or surface == SLIPS:  # noqa: SIM109 -- Warp has no `in`
            return correct(data, t, slip, rate, data.graze)
        return t

    @wp.func(module=module)
    def turn_at(data: Data, surface: int, support: int, angle: Reals, e: int, turn: Turn, t: real):
        """Return the time of an event around a round end, and what the ball does then."""
        mode = mode_of(data, turn)
        late = advance(data, mode, turn, t)
        n = vec2(wp.cos(late.phi), wp.sin(late.phi))
        there = anchor(data, support, angle, e) + data.reach * n
        v = late.s * vec2(-n[1], n[0])
        slip, rate = late.s - data.radius * late.spin, slip_rate(data, mode, late)
        if surface == LEAVES:
            lift, fade = press(data, late), press_rate(data, mode, late)
            gone = time_of_event(data, surface, support, angle, e, t, there, v, lift, fade)
            return gone, advance(data, mode, turn, gone)
        if surface == SLIPS:
            slip, rate = grip(data, late), grip_rate(data, mode, late)
        exact = time_of_event(data, surface, support, angle, e, t, there, v, slip, rate)
        return exact, advance(data, mode, turn, exact)

    @wp.func(module=module)
    def travel(data: Data, surface: int, support: int, angle: Reals, e: int, here: vec2, v: vec2, spin: real, t: real):
        """Return the time of an event, and where the ball is then, how fast, and how much it spins."""
        if is_round(data, support):
            first = start(data, support, angle, e, here, v, spin)
            exact, late = turn_at(data, surface, support, angle, e, first, t)
            n = vec2(wp.cos(late.phi), wp.sin(late.phi))
            there = anchor(data, support, angle, e) + data.reach * n
            return exact, there, late.s * vec2(-n[1], n[0]), late.spin
        a, twist, last = carry(data, support, angle, e, here, v, spin)
        near = here + t * v + (real(0.5) * t * t) * a
        end = time_of_event(data, surface, support, angle, e, t, near, v + t * a, real(0.0), real(0.0))
        if surface == SLIDES:
            end = last
        return end, here + end * v + (real(0.5) * end * end) * a, v + end * a, spin + end * twist

    @wp.func(module=module)
    def pull(data: Data, surface: int, n: vec2, v: vec2) -> real:
        """Return how fast a ball that follows a surface comes away from it, below 0 where it stays."""
        found = -data.gravity * n[1]
        if is_round(data, surface):
            s = wp.dot(v, vec2(-n[1], n[0]))
            found += s * s / data.reach
        return found

    @wp.func(module=module)
    def beyond(data: Data, support: int, angle: Reals, e: int, here: vec2) -> int:
        """Return what carries a ball that has come to the end of what carried it."""
        k = support // 4
        axis = along(angle[e, k])
        to = here - data.pivot[k]
        if support % 4 < 2:
            return 4 * k + wp.where(wp.dot(to, axis) > real(0.0), 2, 3)
        return 4 * k + wp.where(axis[0] * to[1] - axis[1] * to[0] > real(0.0), 0, 1)

    @wp.func(module=module)
    def carrier_of(data: Data, surface: int, angle: Reals, e: int, here: vec2, v: vec2) -> int:
        """Return a surface that would carry the ball, or FREE where it lifts off."""
        if pull(data, surface, outward(data, surface, angle, e, here), v) < real(0.0):
            return surface
        return FREE

    @wp.func(module=module)
    def move(i: int, e: int, data: Data, angle: Reals, path: Path):
        surface, carrier = path.pick[i, e], path.support[i, e]
        path.step[i + 1, e] = path.step[i, e]
        x, v, spin = path.x[i, e], path.v[i, e], path.spin[i, e]
        span, found = path.rest[i, e], path.when[i, e]
        path.hits[i + 1, e] = path.hits[i, e]
        path.impacts[i + 1, e] = 0
        path.support[i + 1, e] = carrier
        if surface == FREE and found >= span:
            _, there, arriving, turning = travel(data, surface, carrier, angle, e, x, v, spin, span)
            path.x[i + 1, e] = there
            path.v[i + 1, e] = arriving
            path.spin[i + 1, e] = turning
            path.rest[i + 1, e] = data.dt
            path.step[i + 1, e] = path.step[i, e] + 1
            return
        t, there, arriving, turning = travel(data, surface, carrier, angle, e, x, v, spin, found)
        path.x[i + 1, e] = there
        path.rest[i + 1, e] = span - t
        if surface >= 0:
            n = outward(data, surface, angle, e, there)
            u = wp.dot(arriving, n)
            if u < -data.crawl:
                path.hits[i + 1, e] = path.hits[i, e] + 1
            after = rebound(data, wp.max(-u, real(0.0)))
            rubbed, _ = deflect(data, n, arriving, turning, after)
            away = pull(data, surface, n, rubbed)
            path.support[i + 1, e] = FREE
            if away < real(0.0) and after < real(-0.5) * away * real(LINGER):
                path.support[i + 1, e] = surface
                after = real(0.0)
            leaving, turned = deflect(data, n, arriving, turning, after)
            path.v[i + 1, e] = leaving
            path.spin[i + 1, e] = turned
        elif surface == SLIDES:
            path.v[i + 1, e] = arriving
            n = outward(data, carrier, angle, e, there)
            path.spin[i + 1, e] = wp.dot(arriving, vec2(-n[1], n[0])) / data.radius
        elif surface == SLIPS:
            path.v[i + 1, e] = arriving
            n = outward(data, carrier, angle, e, there)
            least = real(4.0) * data.graze * (wp.length(arriving) + data.radius * wp.abs(turning))
            path.spin[i + 1, e] = (wp.dot(arriving, vec2(-n[1], n[0])) + wp.sign(n[0]) * least) / data.radius
        else:
            path.v[i + 1, e] = arriving
            path.spin[i + 1, e] = turning
            if surface == LEAVES:
                path.support[i + 1, e] = FREE
            if surface == EDGE:
                over = beyond(data, carrier, angle, e, there)
                path.support[i + 1, e] = carrier_of(data, over, angle, e, there, arriving)
        if found < real(LINGER) and surface != FREE:
            if path.impacts[i, e] + 1 == JAM:
                path.rest[i + 1, e] = data.dt
                path.step[i + 1, e] = path.step[i, e] + 1
            else:
                path.impacts[i + 1, e] = path.impacts[i, e] + 1

    return episode_kernels(module, name, find, move)


# ---- The same ball by fixed steps without a time of impact, as many simulators take them, for comparison.
#
# Semi-implicit Euler: the velocity is reflected in a step at whose start the ball overlaps a surface and approaches it.
# Such steps can tunnel, and their gradients know nothing of the time of impact.


@cache
@no_type_check
def step_kernels(name: str) -> Kernels:
    """Return the kernels of a step; they take what those of `impacts` take."""
    real = precision(name).real
    vec2 = wp.types.vector(2, real)
    Reals, Path = wp.array2d[real], path_struct(name)
    module = f"gradscape.overlaps.{name}"
    Data, _, _, outward, distance, candidate, rebound, deflect = surfaces(name)

    @wp.func(module=module)
    def find(i: int, e: int, data: Data, angle: Reals, path: Path):
        """Find the surface that is overlapped most, of those that are approached."""
        here = path.x[i, e]
        w = path.v[i, e] - vec2(real(0.0), data.gravity * data.dt)
        deepest = real(0.0)
        first = int(FREE)
        for k in range(data.pivot.shape[0] + 4):
            surface = candidate(data, k, angle, e, here)
            gap = distance(data, surface, angle, e, here)
            if gap < deepest and wp.dot(outward(data, surface, angle, e, here), w) < real(0.0):
                deepest = gap
                first = surface
        path.pick[i, e] = first

    @wp.func(module=module)
    def move(i: int, e: int, data: Data, angle: Reals, path: Path):
        surface = path.pick[i, e]
        here, turn = path.x[i, e], real(path.spin[i, e])
        w = path.v[i, e] - vec2(real(0.0), data.gravity * data.dt)
        path.hits[i + 1, e] = path.hits[i, e]
        if surface != FREE:
            n = outward(data, surface, angle, e, here)
            approach = -wp.dot(n, w)
            w, turn = deflect(data, n, w, turn, rebound(data, approach))
            if approach > data.crawl:
                path.hits[i + 1, e] = path.hits[i, e] + 1
        path.x[i + 1, e] = here + data.dt * w
        path.v[i + 1, e] = w
        path.spin[i + 1, e] = turn
        path.step[i + 1, e] = path.step[i, e] + 1

    return episode_kernels(module, name, find, move)


SPARE = 32  # iterations for which there is room at first, beyond two a step


@dataclass(frozen=True, eq=False)
class Slopes:
    """Hold derivatives by `angle`, shape (batch, bar), `start` and `velocity`, (batch, 2), and `spin`, (batch,)."""

    angle: torch.Tensor
    start: torch.Tensor
    velocity: torch.Tensor
    spin: torch.Tensor


class Flight:
    """Hold the state at the start of every iteration, arrays of shape (iteration, row).

    Position `x`, velocity `v`, `spin` (counterclockwise) and the time `rest` left in the step are differentiable;
    `step`, `impacts` (events at once), `support` (surface that carries the ball, or FREE), `pick` (surface that is met
    or another event, FREE or, of a row's last state, DONE) and `hits` (impacts faster than crawling) are whole numbers;
    `when` is the time of the event [s], as it was found.
    """

    NUMBERS = ("x", "v", "spin", "rest")
    COUNTS = ("step", "impacts", "support", "pick", "hits", "when")

    def __init__(self, length: int, capacity: int, name: str, device: str) -> None:
        real = precision(name).real
        vec2 = wp.types.vector(2, real)
        self.length, self.path = length, path_struct(name)()  # as kernels take it
        kinds = dict(zip(self.NUMBERS, (vec2, vec2, real, real), strict=True))
        kinds |= dict.fromkeys(self.COUNTS, wp.int32) | {"when": real}
        for field, kind in kinds.items():
            setattr(self.path, field, wp.zeros((length, capacity), dtype=kind, device=device))

    def tensor(self, field: str) -> torch.Tensor:
        """View one field as a tensor."""
        return to_torch(getattr(self.path, field))

    def adjoint(self, field: str) -> torch.Tensor:
        """View the adjoint of one field, zeros at first, as a tensor."""
        array = getattr(self.path, field)
        if array.grad is None:
            array.requires_grad = True
            setattr(self.path, field, array)  # now with what the adjoint kernel adds to
        return to_torch(array.grad)


class Solver:
    """Simulate up to `capacity` balls for `steps` steps of `dt` [s], and differentiate their final states.

    `contacts` is impact, as above, or step, as in `overlaps`. Every iteration is kept: it is only a few numbers.
    """

    def __init__(
        self, board: Board, *, dt: float, steps: int, name: str, capacity: int, device: str, contacts: str = "impact"
    ) -> None:
        self.steps, self.dt, self.name, self.capacity, self.device = steps, dt, name, capacity, device
        self.types = precision(name)
        self.follow, self.retrace = {"impact": impact_kernels, "step": step_kernels}[contacts](name)
        load([self.follow, self.retrace], device)
        self.data = constants(board, dt=dt, steps=steps, name=name, device=device)
        self.angle, self.adj_angle = (
            wp.zeros((capacity, len(board.pivots)), dtype=self.types.real, device=device) for _ in range(2)
        )
        self.iterations = wp.zeros(capacity, dtype=wp.int32, device=device)  # that rows have taken
        self.flight = Flight(2 * steps + SPARE, capacity, name, device)

    def run(
        self,
        angle: torch.Tensor,
        start: torch.Tensor,
        velocity: torch.Tensor | float = 0.0,
        spin: torch.Tensor | float = 0.0,
    ) -> torch.Tensor:
        """Return where balls are at the end [m], shape (batch, 2).

        `angle` [rad], shape (batch, bar); `start` [m] and `velocity` [m/s], shape (2,) or (batch, 2), and `spin`
        [rad/s], shape (batch,), are those of the beginning, at rest unless given.
        """
        batch = len(angle)
        to_torch(self.angle)[:batch] = angle.to(self.types.torch)
        first = {"x": start, "v": velocity, "spin": spin, "rest": self.dt, "support": FREE}
        for field in (*Flight.NUMBERS, *Flight.COUNTS):
            row = self.flight.tensor(field)[0, :batch]
            row[:] = torch.as_tensor(first.get(field, 0), dtype=torch.float64).to(row)
        self.taken = self._follow(batch)
        return self.at_end("x")

    def gradient(self, adj_x: torch.Tensor) -> Slopes:
        """Return what the adjoint of the last positions, shape (batch, 2), is for the beginning of the latest run."""
        batch = len(adj_x)
        used = int(self.taken.max()) + 1
        for field in Flight.NUMBERS:
            self.flight.adjoint(field)[:used, :batch] = 0
        self.adj_angle.zero_()
        adjoint = self.flight.adjoint("x")
        adjoint[self.taken, self._rows(batch)] = adj_x.to(adjoint)
        inputs = self._inputs()
        adjoints = [None, type(self.data)(), self.adj_angle, type(self.flight.path)()]
        settings: dict[str, Any] = {"device": self.device, "adjoint": True, "record_tape": False}
        wp.launch(self.retrace, batch, inputs, adj_inputs=adjoints, **settings)
        first = {name: self.flight.adjoint(field)[0, :batch].clone() for name, field in _SLOPES.items()}
        return Slopes(to_torch(self.adj_angle)[:batch].clone(), **first)

    def at_end(self, field: str) -> torch.Tensor:
        """Return one field of the latest run's last states, shape (batch, ...)."""
        return self.flight.tensor(field)[self.taken, self._rows(len(self.taken))]

    def at_steps(self, field: str, row: int) -> torch.Tensor:
        """Return one field of a row of the latest run at the ends of steps, shape (step + 1, ...)."""
        last = int(self.taken[row])
        step = self.flight.tensor("step")[: last + 1, row]
        ends = torch.cat([step.new_ones(1), step.diff()]) > 0
        return self.flight.tensor(field)[: last + 1, row][ends]

    def _follow(self, batch: int) -> torch.Tensor:
        """Launch until all rows are done, with more room where it has not been enough; return each row's iterations."""
        self.iterations.zero_()
        taken = to_torch(self.iterations)[:batch]
        while True:
            inputs = [self.flight.length - 1, *self._inputs()]
            wp.launch(self.follow, batch, inputs, device=self.device, record_tape=False)
            counts = taken.long()
            if bool((self.flight.tensor("step")[counts, self._rows(batch)] >= self.steps).all()):
                return counts
            self._double_length()

    def _double_length(self) -> None:
        old, self.flight = self.flight, Flight(2 * self.flight.length, self.capacity, self.name, self.device)
        for field in (*Flight.NUMBERS, *Flight.COUNTS):
            self.flight.tensor(field)[: old.length] = old.tensor(field)

    def _inputs(self) -> list[Any]:
        return [self.iterations, self.data, self.angle, self.flight.path]

    def _rows(self, batch: int) -> torch.Tensor:
        return torch.arange(batch, device=self.flight.tensor("step").device)


_SLOPES = {"start": "x", "velocity": "v", "spin": "spin"}
