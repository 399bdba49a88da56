"""The scatters of a fluid's smoothing by columns of cells, for a GPU; `smoothing` has the formulas."""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ..runtime import precision
from .cells import SEGMENT
from .columns import PARTS, node_sum, walker
from .stencil import lattice, stencil


@cache
@no_type_check
def smoothing_columns(name: str, lanes: int) -> SimpleNamespace:
    """Return the kernels `spread, add_up, spread_adjoint, add_up_adjoint` of one precision, for warps of `lanes`.

    The body's particles are `size` from number `first` on; others in the same cells give nothing.
    """
    types = precision(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    Lattice, base_node, steps = lattice(name), stencil(name).base_node, walker(name)
    open_segment, walk, close_segment = steps.open, steps.walk, steps.close
    add_up_node, module = node_sum(name), f"gradscape.smoothing.{name}.columns.{lanes}"

    @wp.kernel(module=module, enable_backward=False)
    def spread(
        lattice: Lattice,
        order: wp.array2d[wp.int32],
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
        segment = t / lanes
        span = spans[e, segment]
        if span == 0:
            return
        at, last = segment * PARTS, end[e, segment]
        state = open_segment(parts, e, at, span)
        for i in range(first[e, segment], last, lanes):
            p = order[e, wp.min(i + t % lanes, last - 1)]
            s = (x[e, p] - lattice.origin) * lattice.inv_dx
            base = base_node(s, lattice)
            f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
            q = vec3()
            if p >= body and p < body + J.shape[1]:
                V = volume[e, p]
                q = vec3(V * (wp.log(J[e, p - body]) - slope * x[e, p][1]), V, real(0.0))
            state = walk(parts, e, at, wp.min(lanes, last - i), base[2] % SEGMENT, f, real(0.0), q, mat33(), state)
        close_segment(parts, e, at, span, state)

    @wp.kernel(module=module, enable_backward=False)
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

    @wp.kernel(module=module, enable_backward=False)
    def spread_adjoint(
        lattice: Lattice,
        order: wp.array2d[wp.int32],
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
        segment = t / lanes
        span = spans[e, segment]
        if span == 0:
            return
        at, last = segment * PARTS, end[e, segment]
        state = open_segment(parts, e, at, span)
        for i in range(first[e, segment], last, lanes):
            p = order[e, wp.min(i + t % lanes, last - 1)]
            s = (x[e, p] - lattice.origin) * lattice.inv_dx
            base = base_node(s, lattice)
            f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
            q = vec3()
            if p >= body and p < body + adj_log.shape[1]:
                q = vec3(share * adj_log[e, p - body], real(0.0), real(0.0))
            state = walk(parts, e, at, wp.min(lanes, last - i), base[2] % SEGMENT, f, real(0.0), q, mat33(), state)
        close_segment(parts, e, at, span, state)

    @wp.kernel(module=module, enable_backward=False)
    def add_up_adjoint(
        lattice: Lattice, spans: wp.array2d[wp.int32], parts: wp.array2d[vec4], adj_mean: wp.array2d[real]
    ):
        e, i = wp.tid()
        adj_mean[e, i] = add_up_node(lattice, spans, parts, e, i)[0]

    return SimpleNamespace(spread=spread, add_up=add_up, spread_adjoint=spread_adjoint, add_up_adjoint=add_up_adjoint)
