"""The smoothing of a fluid by columns of cells, for a GPU; `smoothing` has the formulas.

A node holds its mean s_i, its part a_i of the adjoint of s, a_i s_i, and 1 / sum w V.
"""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from .. import cpp
from ..runtime import precision
from .columns import Team, node_sum, walking_kernel
from .gathers import gatherers
from .layout import layout
from .nodes import node_taker
from .stencil import lattice, stencil
from .walk import walker


@cache
@no_type_check
def smoothing_columns(name: str, team: Team) -> SimpleNamespace:
    """Return `spread, add_up, collect, spread_adjoint, add_up_adjoint, adjoint_gather`, kernels.

    Those that spread take threads in a `team`; particles of other bodies in the same cells give nothing. `collect` and
    `adjoint_gather` are over [environment, particle of the body].
    """
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    Lattice, base_node, at_nodes = lattice(name), stencil(name).base_node, walker(name, sloping=False).at_nodes
    from_base = gatherers(name).from_base
    add_up_node, take_node = node_sum(name), node_taker()
    module = cpp.module(f"gradscape.smoothing.{name}.columns.{team.lanes}")
    lies, gather, mat33 = layout(name), gatherers(name).gather, types.mat33
    read_number, read_vector, read_node, write_node = (
        lies.read_number,
        lies.read_vector,
        lies.read_node,
        lies.write_node,
    )

    @wp.func(module=module)
    def at(lattice: Lattice, starts: wp.array2d[wp.int32], nodes: wp.array2d[vec4], e: int, x: vec3, q: vec3):
        """Return the sums of `gathers` at x, of what nodes hold, and of the slopes of w times its product with q."""
        base = base_node((x - lattice.origin) * lattice.inv_dx, lattice)
        f = from_base(x, base, lattice)
        return gather(lattice, starts, nodes, e, base - lattice.first, f, q, mat33(), real(0.0))

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
        """Return what a particle gives to its nodes of V s and V."""
        given = at_nodes(lattice, read_vector(x, e, p))
        if p >= body and p < body + J.shape[1]:
            V = read_number(volume, e, p)
            given.q = vec3(V * (wp.log(read_number(J, e, p - body)) - slope * read_vector(x, e, p)[1]), V, real(0.0))
        return given

    @wp.func(module=module)
    def given_adjoint(
        lattice: Lattice,
        body: int,
        share: real,
        x: wp.array2d[vec3],
        J_new: wp.array2d[real],
        adj_J_new: wp.array2d[real],
        e: int,
        p: int,
    ):
        """Return what a particle gives to its nodes of the adjoints of their means, from that of J'."""
        given = at_nodes(lattice, read_vector(x, e, p))
        if p >= body and p < body + J_new.shape[1]:
            adj_log = read_number(adj_J_new, e, p - body) * read_number(J_new, e, p - body)
            given.q = vec3(share * adj_log, real(0.0), real(0.0))
        return given

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def add_up(
        lattice: Lattice,
        planes: wp.array2d[wp.int32],
        touched: wp.array2d[wp.int32],
        named: wp.array2d[wp.int32],
        parts: wp.array2d[vec4],
        nodes: wp.array2d[vec4],
    ):
        """Set the nodes' means, and what these are shared by."""
        e, i = wp.tid()
        node = take_node(touched, named, e, i)
        if node < 0:
            return
        total = add_up_node(lattice, planes, parts, e, node)
        # A particle in the middle of a cell gives the farthest of its nodes nothing, and others may not meet these.
        inverse = wp.where(total[1] > real(0.0), real(1.0) / total[1], real(0.0))
        write_node(nodes, e, i, vec4(total[0] * inverse, real(0.0), real(0.0), inverse))

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def collect(
        lattice: Lattice,
        starts: wp.array2d[wp.int32],
        body: int,
        slope: real,
        share: real,
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        nodes: wp.array2d[vec4],
        J_new: wp.array2d[real],
    ):
        """Gather the nodes' means and take J so far towards them."""
        e, p = wp.tid()
        there = read_vector(x, e, body + p)
        sums = at(lattice, starts, nodes, e, there, vec3())
        here = wp.log(read_number(J, e, p))
        J_new[e, p] = wp.exp(here + share * (sums[0][0] - (here - slope * there[1])))

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def add_up_adjoint(
        lattice: Lattice,
        planes: wp.array2d[wp.int32],
        touched: wp.array2d[wp.int32],
        named: wp.array2d[wp.int32],
        parts: wp.array2d[vec4],
        nodes: wp.array2d[vec4],
    ):
        """Set the nodes' parts of the adjoint of s."""
        e, i = wp.tid()
        node = take_node(touched, named, e, i)
        if node < 0:
            return
        held = read_node(nodes, e, i)
        a = add_up_node(lattice, planes, parts, e, node)[0] * held[3]
        write_node(nodes, e, i, vec4(held[0], a, a * held[0], held[3]))

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def adjoint_gather(
        lattice: Lattice,
        starts: wp.array2d[wp.int32],
        body: int,
        slope: real,
        share: real,
        volume: wp.array2d[real],
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        J_new: wp.array2d[real],
        nodes: wp.array2d[vec4],
        adj_J: wp.array2d[real],
        adj_x: wp.array2d[vec3],
    ):
        """Gather the nodes' means and the adjoint of s; add to adj_x, turn adj_J from that of J' into that of J."""
        e, p = wp.tid()
        there = read_vector(x, e, body + p)
        ratio, V = read_number(J, e, p), read_number(volume, e, body + p)
        beyond = wp.log(ratio) - slope * there[1]
        g = read_number(adj_J, e, p) * read_number(J_new, e, p)
        sums = at(lattice, starts, nodes, e, there, vec3(share * g, V * beyond, -V))
        adj_s = V * sums[0][1] - share * g
        change = lattice.inv_dx * sums[4] - vec3(real(0.0), slope * adj_s, real(0.0))
        adj_x[e, body + p] = read_vector(adj_x, e, body + p) + change
        adj_J[e, p] = (g + adj_s) / ratio

    return SimpleNamespace(
        spread=walking_kernel("smoothing_columns.spread", name, team, given_volume, sloping=False),
        add_up=add_up,
        collect=collect,
        spread_adjoint=walking_kernel("smoothing_columns.spread_adjoint", name, team, given_adjoint, sloping=False),
        add_up_adjoint=add_up_adjoint,
        adjoint_gather=adjoint_gather,
    )
