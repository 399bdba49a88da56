"""What happens at grid nodes between the transfers."""

from functools import cache
from typing import Any, no_type_check

import warp as wp

from .. import cpp
from ..launches import blocks
from ..runtime import precision
from .cells import SEGMENT
from .exact import LANES
from .nodes import node_taker
from .stencil import lattice
from .walk import PARTS


@cache
@no_type_check
def velocity_at(name: str, boundary_velocity: Any, Data: Any) -> Any:
    """Return the function that makes of a node's momentum and mass its velocity after gravity and boundary."""
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    Lattice = lattice(name)

    @wp.func(module=f"gradscape.grid.{name}")
    def velocity_at_node(
        lattice: Lattice,
        boundary: Data,
        dt: real,
        gravity: real,
        g: vec4,
        e: int,
        i: int,
        tools: wp.array3d[vec3],
        sums: wp.array2d[wp.int64],
        step: int,
        fraction: real,
        rate: real,
    ) -> vec3:
        first = lattice.first
        column, k = i / lattice.nz, i % lattice.nz
        j = column % lattice.ny
        node = vec3(real(column / lattice.ny + first[0]), real(j + first[1]), real(k + first[2]))
        p = lattice.origin + node * (real(1.0) / lattice.inv_dx)
        v = vec3(g[0], g[1], g[2]) / g[3] - vec3(real(0.0), dt * gravity, real(0.0))
        return boundary_velocity(boundary, p, v, e, i % LANES, tools, sums, step, fraction, rate)

    return velocity_at_node


@cache
@no_type_check
def velocity_kernel(name: str, boundary_velocity: Any, Data: Any) -> Any:
    """Return the kernel that turns a node's momentum into its velocity after gravity and boundary."""
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    Lattice, velocity_at_node = lattice(name), velocity_at(name, boundary_velocity, Data)

    # A node is read once, so that its adjoint can be set, where Warp would add to it atomically; and it is set once.
    @cpp.func_native(called="read_node", adjoint="set_adj_read_node")
    def read(grid: wp.array2d[vec4], e: int, i: int) -> vec4: ...

    @cpp.func_native(called="write_node", adjoint="set_adj_write_node", replay=False)
    def write(grid: wp.array2d[vec4], e: int, i: int, value: vec4): ...

    @wp.kernel(module="unique", module_options=cpp.options())
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
    ):
        e, i = wp.tid()
        g = read(grid_m, e, i)
        if g[3] > empty:
            v = velocity_at_node(lattice, boundary, dt, gravity, g, e, i, tools, sums, step, fraction, rate)
            write(grid_v, e, i, vec4(v[0], v[1], v[2], real(0.0)))
        else:
            write(grid_v, e, i, vec4())

    return velocity


@cache
@no_type_check
def velocity_of_columns(name: str, boundary_velocity: Any, Data: Any) -> Any:
    """Return the same kernel, for sums by `columns`: it adds up a node's momentum, its adjoint that of the velocity.

    It runs over [environment, place in the grid].
    """
    types, take_node = precision(name), node_taker()
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    Lattice, velocity_at_node = lattice(name), velocity_at(name, boundary_velocity, Data)

    @cpp.func_native(called="write_sum", template=[SEGMENT, PARTS], adjoint="", replay=False)
    def add_up(
        lattice: Lattice,
        planes: wp.array2d[wp.int32],
        parts: wp.array2d[vec4],
        grid: wp.array2d[vec4],
        e: int,
        i: int,
        node: int,
    ): ...

    # A node is read once, so that its adjoint can be set, where Warp would add to it atomically; and it is set once.
    @cpp.func_native(called="read_node", adjoint="set_adj_read_node")
    def read(grid: wp.array2d[vec4], e: int, i: int) -> vec4: ...

    @cpp.func_native(called="write_with_parts", template=[SEGMENT, PARTS], adjoint="adj_write_with_parts", replay=False)
    def write(
        lattice: Lattice,
        planes: wp.array2d[wp.int32],
        parts: wp.array2d[vec4],
        grid: wp.array2d[vec4],
        e: int,
        i: int,
        node: int,
        value: vec4,
    ): ...

    @wp.kernel(module="unique", module_options=cpp.options(), launch_bounds=blocks(name))
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
        planes: wp.array2d[wp.int32],
        touched: wp.array2d[wp.int32],
        nodes: wp.array2d[wp.int32],
        parts: wp.array2d[vec4],
    ):
        e, i = wp.tid()
        node = take_node(touched, nodes, e, i)
        if node >= 0:
            add_up(lattice, planes, parts, grid_m, e, i, node)  # its adjoint finds in grid_m what it needs
            g = read(grid_m, e, i)
            if g[3] > empty:
                v = velocity_at_node(lattice, boundary, dt, gravity, g, e, node, tools, sums, step, fraction, rate)
                write(lattice, planes, parts, grid_v, e, i, node, vec4(v[0], v[1], v[2], real(0.0)))
            else:
                write(lattice, planes, parts, grid_v, e, i, node, vec4())

    return velocity
