"""Particle-grid transfers of MLS-MPM with quadratic B-splines, and their adjoints by hand.

Notation of Hu et al. 2018 (MLS-MPM): particle position x [m], velocity v [m/s], affine velocity C [1/s], affine
momentum A [kg/s]; node i holds momentum and mass (grid_m), or velocity (grid_v). Arrays are [environment, particle] and
[environment, node]; a node's flat index runs z fastest.

Those of a CPU are in C++ (`native/transfers.h`). On a GPU the scatters are those of `columns`, and materials gather
the adjoint of p2g.
"""

from functools import cache, partial
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from .. import cpp
from ..runtime import Ints, precision
from .columns import count_struct, counter
from .stencil import adjoint_gatherers, gatherers, lattice, layout, particles, stencil


@cache
@no_type_check
def transfers(name: str) -> SimpleNamespace:
    """Return the transfer kernels `p2g, g2p, adjoint_p2g, adjoint_g2p` of one precision for a CPU."""
    Lattice, real = lattice(name), precision(name).real
    numbers, vectors, nodes, matrices = precision(name).rows
    declare = partial(cpp.kernel_in_rows, f"gradscape.transfers.{name}")
    given = {"lattice": Lattice, "mass": numbers, "x": vectors, "v": vectors, "A": matrices}
    gathered = {"lattice": Lattice, "dt": real, "x": vectors, "grid_v": nodes}
    new = {"adj_x_new": vectors, "adj_v_new": vectors, "adj_C_new": matrices}
    # Scatter momentum m v + A (x_i - x) and mass.
    p2g = declare("p2g", **given, grid_m=nodes)
    # Gather the adjoints of p2g: add to adj_x, set adj_v and adj_A.
    adjoint_p2g = declare("adjoint_p2g", **given, adj_grid_m=nodes, adj_x=vectors, adj_v=vectors, adj_A=matrices)
    # Gather v' = sum w v_i and C' = 4/dx^2 sum w v_i (x_i - x)^T; move x' = x + dt v'.
    left = wp.array[wp.int32]
    g2p = declare("g2p", **gathered, x_new=vectors, v_new=vectors, C_new=matrices, left_box=left)
    # Scatter the adjoints of g2p: add to adj_grid_v, set adj_x.
    adjoint_g2p = declare("adjoint_g2p", **gathered, **new, adj_grid_v=nodes, adj_x=vectors)
    return SimpleNamespace(p2g=p2g, g2p=g2p, adjoint_p2g=adjoint_p2g, adjoint_g2p=adjoint_g2p)


@cache
@no_type_check
def transfers_of_columns(name: str) -> SimpleNamespace:
    """Return the kernels `g2p, adjoint_p2g` of one precision for a GPU, both over [environment, particle].

    The scatters are in `columns`. These take what those of `transfers` do, but g2p counts particles by cell, where
    they are then, if it is told to.
    """
    types, sums_of, lies = precision(name), gatherers(name), layout(name)
    real, vec3, mat33 = types.real, types.vec3, types.mat33
    Reals, Vectors, Nodes, Matrices = types.rows
    Lattice, Particles, Counting = lattice(name), particles(name), count_struct()
    module, base_node, count_in_cell = (
        cpp.module(f"gradscape.transfers.{name}.columns"),
        stencil(name).base_node,
        counter(name),
    )
    gather, from_base, gather_back = sums_of.gather, sums_of.from_base, adjoint_gatherers(name).p2g
    read_vector, read_matrix, write_matrix = lies.read_vector, lies.read_matrix, lies.write_matrix

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def g2p(
        lattice: Lattice,
        starts: Ints,
        dt: real,
        x: Vectors,
        grid_v: Nodes,
        after: Particles,
        left_box: wp.array[wp.int32],
        counts: Counting,
        wanted: int,
    ):
        """Gather v' = sum w v_i and C' = 4/dx^2 sum w v_i (x_i - x)^T; move x' = x + dt v'."""
        e, p = wp.tid()
        here = read_vector(x, e, p)
        base = base_node((here - lattice.origin) * lattice.inv_dx, lattice)
        f = from_base(here, base, lattice)
        sums = gather(lattice, starts, grid_v, e, base - lattice.first, f, vec3(), mat33(), real(0.0))
        v = sums[0]
        C = wp.matrix_from_cols(sums[1] - f[0] * v, sums[2] - f[1] * v, sums[3] - f[2] * v)
        write_matrix(after.C, e, p, (real(4.0) * lattice.inv_dx) * C)
        there = here + dt * v
        after.v[e, p] = v
        after.x[e, p] = there
        if wp.min(wp.min(f[0], f[1]), f[2]) < real(0.49) or wp.max(wp.max(f[0], f[1]), f[2]) > real(1.51):
            left_box[e] = 1
        if wanted > 0:
            count_in_cell(lattice, there, e, p, counts)

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def adjoint_p2g(
        lattice: Lattice,
        starts: Ints,
        mass: Reals,
        x: Vectors,
        v: Vectors,
        A: Matrices,
        adj_grid_m: Nodes,
        adj_x: Vectors,
        adj_v: Vectors,
        adj_A: Matrices,
    ):
        """Gather the adjoints of p2g: add to adj_x, set adj_v and adj_A."""
        e, p = wp.tid()
        adj_a, own = gather_back(lattice, starts, mass, x, v, read_matrix(A, e, p), adj_grid_m, adj_v, e, p)
        write_matrix(adj_A, e, p, adj_a)
        adj_x[e, p] = read_vector(adj_x, e, p) + own

    return SimpleNamespace(g2p=g2p, adjoint_p2g=adjoint_p2g)
