"""The scatters of a fluid's smoothing by columns of cells, for a GPU; `smoothing` has the formulas."""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ..runtime import precision
from .columns import PARTS, Team, node_sum, segment_taker, walker
from .layout import layout
from .stencil import lattice


@cache
@no_type_check
def smoothing_columns(name: str, team: Team) -> SimpleNamespace:
    """Return the kernels `spread, add_up, spread_adjoint, add_up_adjoint` of one precision, for threads in a `team`.

    The body's particles are `size` from number `first` on; others in the same cells give nothing.
    """
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    Lattice, steps = lattice(name), walker(name)
    take_segment, most = segment_taker(team), steps.most
    at_nodes, open_segment, walk, close_segment = steps.at_nodes, steps.open, steps.walk, steps.close
    lanes, groups, size = team.lanes, team.groups, team.size
    add_up_node, module = node_sum(name), f"gradscape.smoothing.{name}.columns.{team.lanes}"
    read_number, read_vector = layout(name).read_number, layout(name).read_vector

    @wp.func(module=module)
    def given_volume(
        lattice: Lattice,
        body: int,
        slope: real,
        volume: wp.array2d[real],
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        e: int,
        p: int,
    ):
        given = at_nodes(lattice, read_vector(x, e, p))
        if p >= body and p < body + J.shape[1]:
            V = read_number(volume, e, p)
            given.q = vec3(V * (wp.log(read_number(J, e, p - body)) - slope * read_vector(x, e, p)[1]), V, real(0.0))
        return given

    @wp.func(module=module)
    def given_adjoint(
        lattice: Lattice, body: int, share: real, x: wp.array2d[vec3], adj_log: wp.array2d[real], e: int, p: int
    ):
        given = at_nodes(lattice, read_vector(x, e, p))
        if p >= body and p < body + adj_log.shape[1]:
            given.q = vec3(share * read_number(adj_log, e, p - body), real(0.0), real(0.0))
        return given

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def spread(
        lattice: Lattice,
        order: wp.array2d[wp.int32],
        full: wp.array[wp.int32],
        segments: wp.array2d[wp.vec4i],
        body: int,
        slope: real,
        volume: wp.array2d[real],
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        parts: wp.array2d[vec4],
    ):
        """Scatter V s and V."""
        e, t = wp.tid()
        mine = take_segment(e, t, full, segments)
        if t / lanes * groups >= full[e]:
            return
        at, begin, count, span = mine[0] * PARTS, mine[1], mine[2], mine[3]
        state = open_segment(parts, e, at, span)
        last = begin + wp.max(count - 1, 0)
        place = begin + t % lanes % size
        for i in range(0, most(count), 2 * size):
            first = given_volume(lattice, body, slope, volume, x, J, e, order[e, wp.min(place + i, last)])
            second = given_volume(lattice, body, slope, volume, x, J, e, order[e, wp.min(place + i + size, last)])
            state = walk(parts, e, at, wp.min(2 * size, count - i), first, second, state)
        close_segment(parts, e, at, span, state)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def add_up(
        lattice: Lattice,
        spans: wp.array2d[wp.int32],
        parts: wp.array2d[vec4],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
    ):
        e, i = wp.tid()
        total = add_up_node(lattice, spans, parts, e, i)
        amount[e, i] = total[0]
        weight[e, i] = total[1]

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def spread_adjoint(
        lattice: Lattice,
        order: wp.array2d[wp.int32],
        full: wp.array[wp.int32],
        segments: wp.array2d[wp.vec4i],
        body: int,
        share: real,
        x: wp.array2d[vec3],
        adj_log: wp.array2d[real],
        parts: wp.array2d[vec4],
    ):
        """Scatter the adjoints of the nodes' means, from those of log J'."""
        e, t = wp.tid()
        mine = take_segment(e, t, full, segments)
        if t / lanes * groups >= full[e]:
            return
        at, begin, count, span = mine[0] * PARTS, mine[1], mine[2], mine[3]
        state = open_segment(parts, e, at, span)
        last = begin + wp.max(count - 1, 0)
        place = begin + t % lanes % size
        for i in range(0, most(count), 2 * size):
            first = given_adjoint(lattice, body, share, x, adj_log, e, order[e, wp.min(place + i, last)])
            second = given_adjoint(lattice, body, share, x, adj_log, e, order[e, wp.min(place + i + size, last)])
            state = walk(parts, e, at, wp.min(2 * size, count - i), first, second, state)
        close_segment(parts, e, at, span, state)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def add_up_adjoint(
        lattice: Lattice, spans: wp.array2d[wp.int32], parts: wp.array2d[vec4], adj_mean: wp.array2d[real]
    ):
        e, i = wp.tid()
        adj_mean[e, i] = add_up_node(lattice, spans, parts, e, i)[0]

    return SimpleNamespace(spread=spread, add_up=add_up, spread_adjoint=spread_adjoint, add_up_adjoint=add_up_adjoint)
