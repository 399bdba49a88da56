"""The grid's velocities for a CPU in float32, in C++: an environment's nodes one after another, and the same bits.

What walls do is a few comparisons, four numbers at a time. The nodes that a tool may reach are listed, and left to the
boundary's Warp function and the adjoint that Warp makes of it.
"""

from functools import cache
from typing import Any, no_type_check

import warp as wp

from ..runtime import precision, take_rows
from .boundaries import Boundary
from .boundaries_cpu import WALLS
from .exact import LANES
from .grid import velocity_kernel, velocity_of_columns
from .stencil import lattice

# Expressions are those of `grid` and of what Warp's adjoint of it computes, in their order. Its sums begin with 0, and
# make 0 of -0. Three numbers of a node are its momentum or velocity, the fourth its mass or nothing.
NODE = """
    typedef float V4 __attribute__((vector_size(16), aligned(4)));
    auto free_velocity = [&](V4 g) { return g / g[3] - V4{0.0f, dt * gravity, 0.0f, 0.0f}; };
    auto free_adjoint = [](V4 g, V4 a) {
        V4 back = 0.0f + a / g[3];
        back[3] = 0.0f - (g[0] * a[0] + g[1] * a[1] + g[2] * a[2]) / (g[3] * g[3]);
        return back;
    };
    const V4 zero = {0.0f, 0.0f, 0.0f, 0.0f};
    const V4* G = (const V4*)&wp::index(grid_m, e, 0);
"""
PLACE = """
    typedef float V4 __attribute__((vector_size(16), aligned(4)));
    const float h = 1.0f / lattice.inv_dx;
    auto place = [&](int i, int j, int k) {
        const wp::vec3 o = lattice.origin;
        const wp::vec3i first = lattice.first;
        const V4 node = {(float)(i + first[0]), (float)(j + first[1]), (float)(k + first[2]), 0.0f};
        return V4{o[0], o[1], o[2], 0.0f} + node * h;
    };
"""
PLACE_OF_ONE = (
    PLACE
    + """
    const V4 p = place(i / (lattice.nz * lattice.ny), i / lattice.nz % lattice.ny, i % lattice.nz);
    return wp::vec_t<3, wp::float32>(p[0], p[1], p[2]);
"""
)
VELOCITY_OF_ONE = (
    NODE
    + """
    const V4 v = free_velocity(G[i]);
    return wp::vec_t<3, wp::float32>(v[0], v[1], v[2]);
"""
)
ADJOINT_OF_ONE = (
    NODE
    + """
    *(V4*)&wp::index(adj_grid_m, e, i) = free_adjoint(G[i], V4{adj_ret[0], adj_ret[1], adj_ret[2], 0.0f});
"""
)
# The numbers of nodes that carry a velocity and are within reach of a tool, in their order, after how many they are.
LIST = """
    const float* MASS = (const float*)&wp::index(grid_m, e, 0) + 3;
    int *NEAR = &wp::index(near, e, 0), count = 0;
    for (int i = 0; i < lattice.nx; ++i)
        for (int j = 0; j < lattice.ny; ++j) {
            float from = __builtin_inff(), to = -from;
            find_reach(place(i, j, 0), from, to);
            const int row = (i * lattice.ny + j) * lattice.nz;
            for (int k = 0; from < to && k < lattice.nz; ++k) {
                const float z = place(i, j, k)[2];
                if (z > from && z < to && MASS[4 * (row + k)] > empty) NEAR[++count] = row + k;
            }
        }
    NEAR[0] = count;
"""
EACH = """
    const int *NEAR = &wp::index(near, e, 1), *end = NEAR + NEAR[-1];
    for (int i = 0, n = 0; i < lattice.nx; ++i)
        for (int j = 0; j < lattice.ny; ++j)
            for (int k = 0; k < lattice.nz; ++k, ++n) {
                if (NEAR < end && *NEAR == n) {
                    ++NEAR;
                    continue;
                }
"""
VELOCITY = (
    NODE
    + """
    V4* V = (V4*)&wp::index(grid_v, e, 0);
"""
    + EACH
    + """
                V4 v = zero;
                if (G[n][3] > empty) {
                    const V4 p = place(i, j, k);
                    v = along(p, free_velocity(G[n]));
                    v = below(p) & ~(v >= 0.0f) ? zero : v;
                    v = above(p) & ~(v <= 0.0f) ? zero : v;
                    v[3] = 0.0f;
                }
                V[n] = v;
            }
"""
)
ADJOINT = (
    NODE
    + """
    const V4* VA = (const V4*)&wp::index(adj_grid_v, e, 0);
    V4* GA = (V4*)&wp::index(adj_grid_m, e, 0);
"""
    + EACH
    + """
                V4 back = zero;
                if (G[n][3] > empty) {
                    const V4 p = place(i, j, k), v = along(p, free_velocity(G[n]));
                    const auto stopped = (below(p) & ~(v > 0.0f)) | (above(p) & ~(v < 0.0f));
                    back = free_adjoint(G[n], along(p, stopped ? zero : VA[n]));
                }
                GA[n] = back;
            }
"""
)


def velocity_on(device: str, name: str, boundary: Boundary, *, columns: bool) -> Any:
    """Return the velocity kernel of one precision that is quickest on a device, after scatters by columns or others."""
    function, Data = boundary.function(name)
    if columns:
        return velocity_of_columns(name, function, Data)
    walls = WALLS.get(type(boundary))
    if device == "cpu" and name == "float32" and walls:
        return velocity_in_rows(function, Data, walls)
    return velocity_kernel(name, function, Data)


@cache
@no_type_check
def velocity_in_rows(boundary_velocity: Any, Data: Any, walls: str) -> Any:
    """Return the kernel of `grid`, each of whose threads has the row of an environment.

    It takes room for a list of nodes besides: more numbers by one than there are nodes.
    """
    types = precision("float32")
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    Lattice = lattice("float32")

    @wp.func_native(PLACE_OF_ONE, adj_snippet="")
    def place(lattice: Lattice, i: int) -> vec3: ...

    @wp.func_native(VELOCITY_OF_ONE, adj_snippet=ADJOINT_OF_ONE)
    def free_velocity(dt: real, gravity: real, grid_m: wp.array2d[vec4], e: int, i: int) -> vec3: ...

    @wp.func_native(PLACE + walls + LIST, adj_snippet="")
    def list_near(
        e: int,
        lattice: Lattice,
        data: Data,
        empty: real,
        step: int,
        fraction: real,
        tools: wp.array3d[vec3],
        grid_m: wp.array2d[vec4],
        near: wp.array2d[int],
    ): ...

    @wp.func_native(PLACE + walls + VELOCITY, adj_snippet=PLACE + walls + ADJOINT, replay_snippet="")
    def velocity_of_others(
        e: int,
        lattice: Lattice,
        data: Data,
        dt: real,
        gravity: real,
        empty: real,
        step: int,
        fraction: real,
        tools: wp.array3d[vec3],
        grid_m: wp.array2d[vec4],
        near: wp.array2d[int],
        grid_v: wp.array2d[vec4],
    ): ...

    @wp.kernel(module="unique")
    def velocity(
        lattice: Lattice,
        boundary: Data,
        dt: real,
        gravity: real,
        empty: real,
        step: int,
        fraction: real,
        rate: real,
        tools: wp.array3d[vec3],
        sums: wp.array2d[wp.int64],
        grid_m: wp.array2d[vec4],
        grid_v: wp.array2d[vec4],
        near: wp.array2d[int],
    ):
        e, _ = wp.tid()
        list_near(e, lattice, boundary, empty, step, fraction, tools, grid_m, near)
        velocity_of_others(e, lattice, boundary, dt, gravity, empty, step, fraction, tools, grid_m, near, grid_v)
        count = near[e, 0]
        for n in range(count):
            i = near[e, count - n]  # the last comes first, so that adjoints come in the nodes' order
            v = free_velocity(dt, gravity, grid_m, e, i)
            v = boundary_velocity(boundary, place(lattice, i), v, e, i % LANES, tools, sums, step, fraction, rate)
            grid_v[e, i] = vec4(v[0], v[1], v[2], real(0.0))

    take_rows(velocity, velocity_kernel("float32", boundary_velocity, Data), "lattice")
    return velocity
