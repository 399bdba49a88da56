"""The kernels that take a row through its whole episode: one launch there, and one back for derivatives.

A launch costs more than an event, and rows have their events at times of their own: a thread follows its row alone.
"""

from functools import cache, partial
from typing import Any, NamedTuple, no_type_check

import warp as wp

from ..runtime import precision
from .board import DONE, surfaces


class Kernels(NamedTuple):
    """`follow` takes rows from event to event until they are done; of `retrace` only the adjoint is launched."""

    follow: Any
    retrace: Any


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
    Data, Path, Reals = surfaces(name).Data, path_struct(name), wp.array2d[real]

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

    return Kernels(follow, retrace)
