"""The scatters of a fluid's smoothing by columns of cells, for a GPU; `smoothing` has the formulas."""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ..runtime import precision
from .cells import SEGMENT
from .columns import PARTS, Team, node_sum, segment_taker, walker
from .stencil import lattice, stencil


@cache
@no_type_check
def smoothing_columns(name: str, team: Team) -> SimpleNamespace:
    """Return the kernels `spread, add_up, spread_adjoint, add_up_adjoint` of one precision, for threads in a `team`.

    The body's particles are `size` from number `first` on; others in the same cells give nothing.
    """
    types = precision(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    Lattice, base_node, steps = lattice(name), stencil(name).base_node, walker(name)
    take_segment, most = segment_taker(team), steps.most
    open_segment, walk, close_segment = steps.open, steps.walk, steps.close
    lanes, groups, size = team.lanes, team.groups, team.size
    add_up_node, module = node_sum(name), f"gradscape.smoothing.{name}.columns.{team.lanes}"

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def spread(
        lattice: Lattice,
        order: wp.array2d[wp.int32],
        full: wp.array[wp.int32],
        which: wp.array2d[wp.int32],
        first: wp.array2d[wp.int32],
        end: wp.array2d[wp.int32],
        spans: wp.array2d[wp.int32],
        body: int,
        slope: real,
        volume: wp.array2d[real],
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        parts: wp.array2d[vec4],
    ):
        """Scatter V s and V."""
        e, t = wp.tid()
        if t / lanes * groups >= full[e]:
            return
        mine = take_segment(e, t, full[e], which, first, end, spans)
        at, span, begin, count = mine[0] * PARTS, mine[1], mine[2], mine[3]
        state = open_segment(parts, e, at, span)
        following = order[e, begin + wp.min(t % lanes % size, wp.max(count - 1, 0))]
        for i in range(0, most(count), size):
            p = following
            following = order[e, begin + wp.min(i + size + t % lanes % size, wp.max(count - 1, 0))]
            s = (x[e, p] - lattice.origin) * lattice.inv_dx
            base = base_node(s, lattice)
            f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
            q = vec3()
            if p >= body and p < body + J.shape[1]:
                V = volume[e, p]
                q = vec3(V * (wp.log(J[e, p - body]) - slope * x[e, p][1]), V, real(0.0))
            state = walk(parts, e, at, wp.min(size, count - i), base[2] % SEGMENT, f, real(0.0), q, mat33(), state)
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
        which: wp.array2d[wp.int32],
        first: wp.array2d[wp.int32],
        end: wp.array2d[wp.int32],
        spans: wp.array2d[wp.int32],
        body: int,
        share: real,
        x: wp.array2d[vec3],
        adj_log: wp.array2d[real],
        parts: wp.array2d[vec4],
    ):
        """Scatter the adjoints of the nodes' means, from those of log J'."""
        e, t = wp.tid()
        if t / lanes * groups >= full[e]:
            return
        mine = take_segment(e, t, full[e], which, first, end, spans)
        at, span, begin, count = mine[0] * PARTS, mine[1], mine[2], mine[3]
        state = open_segment(parts, e, at, span)
        following = order[e, begin + wp.min(t % lanes % size, wp.max(count - 1, 0))]
        for i in range(0, most(count), size):
            p = following
            following = order[e, begin + wp.min(i + size + t % lanes % size, wp.max(count - 1, 0))]
            s = (x[e, p] - lattice.origin) * lattice.inv_dx
            base = base_node(s, lattice)
            f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
            q = vec3()
            if p >= body and p < body + adj_log.shape[1]:
                q = vec3(share * adj_log[e, p - body], real(0.0), real(0.0))
            state = walk(parts, e, at, wp.min(size, count - i), base[2] % SEGMENT, f, real(0.0), q, mat33(), state)
        close_segment(parts, e, at, span, state)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def add_up_adjoint(
        lattice: Lattice, spans: wp.array2d[wp.int32], parts: wp.array2d[vec4], adj_mean: wp.array2d[real]
    ):
        e, i = wp.tid()
        adj_mean[e, i] = add_up_node(lattice, spans, parts, e, i)[0]

    return SimpleNamespace(spread=spread, add_up=add_up, spread_adjoint=spread_adjoint, add_up_adjoint=add_up_adjoint)
