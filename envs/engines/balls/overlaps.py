"""The same ball by fixed steps without a time of impact, as many simulators take them, for comparison.

Semi-implicit Euler: the velocity is reflected in a step at whose start the ball overlaps a surface and approaches it.
Such steps can tunnel, and their gradients know nothing of the time of impact.
"""

from functools import cache
from typing import no_type_check

import warp as wp

from ..runtime import precision
from .board import FREE, surfaces
from .episodes import Kernels, episode_kernels, path_struct


@cache
@no_type_check
def step_kernels(name: str) -> Kernels:
    """Return the kernels of a step; they take what those of `impacts` take."""
    real = precision(name).real
    vec2 = wp.types.vector(2, real)
    Reals, Path = wp.array2d[real], path_struct(name)
    module = f"gradscape.overlaps.{name}"
    Data, along, _, outward, distance, nearest, _, rebound, deflect = surfaces(name)

    @wp.func(module=module)
    def find(i: int, e: int, data: Data, angle: Reals, path: Path):
        """Find the surface that is overlapped most, of those that are approached."""
        here = path.x[i, e]
        w = path.v[i, e] - vec2(real(0.0), data.gravity * data.dt)
        bars = data.pivot.shape[0]
        deepest = real(0.0)
        first = int(FREE)
        for k in range(bars + 4):
            surface = int(3 * bars + k)
            if k < bars:
                to = here - data.pivot[k]
                axis = along(angle[e, k])
                surface = 4 * k + nearest(data, vec2(wp.dot(to, axis), axis[0] * to[1] - axis[1] * to[0]))
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
