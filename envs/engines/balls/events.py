"""The kernels of the ball among walls and bars: what comes first and when, and how the ball goes there."""

from functools import cache
from typing import no_type_check

import warp as wp

from ..runtime import precision
from .board import FREE, surfaces
from .episodes import Kernels, episode_kernels, path_struct
from .rolling import ARC, rolling
from .roots import roots

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
    Data, along, anchor, outward, distance, nearest, _, rebound, deflect = surfaces(name)
    plane, disc = roots(name)
    Turn, regime, carry, start, advance, press, slip_rate, press_rate, grip, grip_rate = rolling(name)

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
        bars = data.pivot.shape[0]
        for k in range(bars + 4):
            surface = int(3 * bars + k)
            if k < bars:
                axis = along(angle[e, k])
                to = here - data.pivot[k]
                surface = 4 * k + nearest(data, vec2(wp.dot(to, axis), axis[0] * to[1] - axis[1] * to[0]))
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
        data: Data,
        surface: int,
        support: int,
        angle: Reals,
        e: int,
        t: real,
        there: vec2,
        v: vec2,
        slip: real,
        rate: real,
    ) -> real:
        """Return the corrected time of an event at which the ball is `there` at v, slipping more by `rate`."""
        least = data.graze * (wp.length(v) + data.crawl)
        if surface >= 0:
            n = outward(data, surface, angle, e, there)
            return correct(data, t, distance(data, surface, angle, e, there), wp.dot(n, v), least)
        if surface == EDGE:
            axis = along(angle[e, support // 4])
            q = wp.dot(there - data.pivot[support // 4], axis)
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
