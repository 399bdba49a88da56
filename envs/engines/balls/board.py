"""The surfaces a ball meets in a plane, walls and bars: where they are, and what an impact does.

Surfaces are numbered: 4 k + 0, 1, 2, 3 are the upper face, lower face, right end and left end of bar k; after the bars
come floor, ceiling, left and right wall. The ball's centre against a bar is a point against a stadium of radius R.
"""

from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple, no_type_check

import warp as wp

from ..runtime import precision

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
    data = surfaces(name).Data()
    data.dt, data.steps = dt, steps
    data.pivot = wp.array(board.pivots, dtype=wp.types.vector(2, precision(name).real), device=device)
    data.width, data.height, data.half_length = board.width, board.height, board.half_length
    data.radius, data.reach = board.ball_radius, board.ball_radius + board.bar_radius
    data.restitution, data.friction, data.crawl = board.restitution, board.friction, board.crawl
    data.gravity, data.inertia, data.graze = board.gravity, board.inertia, GRAZE[name]
    return data


class Surfaces(NamedTuple):
    """What both contact rules ask of geometry and friction, and the struct `Data` of their constants."""

    Data: Any
    along: Any
    anchor: Any
    outward: Any
    distance: Any
    nearest: Any
    coulomb: Any
    rebound: Any
    deflect: Any


@cache
@no_type_check
def surfaces(name: str) -> Surfaces:
    """Return the Warp functions of one precision."""
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
    def nearest(data: Data, p: vec2) -> int:
        """Return which surface of a bar is nearest to a point in the bar's frame."""
        if p[0] > data.half_length:
            return 2
        if p[0] < -data.half_length:
            return 3
        return wp.where(p[1] > real(0.0), 0, 1)

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

    return Surfaces(Data, along, anchor, outward, distance, nearest, coulomb, rebound, deflect)
