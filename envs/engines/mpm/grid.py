"""What happens at grid nodes between the transfers."""

from functools import cache
from typing import Any, no_type_check

import warp as wp

from .. import cpp
from ..launches import blocks
from ..runtime import Ints, precision
from .boundaries import LANES, Boundary, Sums, substep_struct
from .columns import PARTS, SEGMENT, list_functions, list_struct
from .stencil import lattice


def velocity_on(name: str, boundary: Boundary, *, columns: bool) -> Any:
    """Return the kernel of a node's velocity in one precision: by `columns` for a GPU, in rows for a CPU."""
    function, Data = boundary.function(name)
    if columns:
        return velocity_of_columns(name, function, Data)
    return velocity_in_rows(name, function, Data, boundary.walls)


@cache
@no_type_check
def velocity_at(name: str, boundary_velocity: Any, Data: Any) -> Any:
    """Return the function that makes of a node's momentum and mass its velocity after gravity and boundary."""
    types = precision(name)
    real, vec3, vec4, Paths = types.real, types.vec3, types.vec4, wp.array3d[types.vec3]
    Lattice, Substep = lattice(name), substep_struct(name)

    @wp.func(module=f"gradscape.grid.{name}")
    def velocity_at_node(
        lattice: Lattice, boundary: Data, now: Substep, g: vec4, e: int, i: int, tools: Paths, sums: Sums
    ) -> vec3:
        first = lattice.first
        column, k = i / lattice.nz, i % lattice.nz
        j = column % lattice.ny
        node = vec3(real(column / lattice.ny + first[0]), real(j + first[1]), real(k + first[2]))
        p = lattice.origin + node * (real(1.0) / lattice.inv_dx)
        v = vec3(g[0], g[1], g[2]) / g[3] - vec3(real(0.0), now.dt * now.gravity, real(0.0))
        return boundary_velocity(boundary, p, v, e, i % LANES, tools, sums, now)

    return velocity_at_node


@cache
@no_type_check
def velocity_in_rows(name: str, boundary_velocity: Any, Data: Any, walls: str) -> Any:
    """Return the kernel that turns nodes' momenta into their velocities after gravity and boundary, for a CPU.

    What `walls` do is a few comparisons, four numbers at a time, in C++ (`native/grid.h`). The nodes that a tool may
    reach are listed, and left to the boundary's Warp function and the adjoint that Warp makes of it. The list has room
    for one number more than there are nodes.
    """
    types = precision(name)
    real, vec3, vec4, Nodes, Paths = types.real, types.vec3, types.vec4, types.rows[2], wp.array3d[types.vec3]
    Lattice, Substep, template = lattice(name), substep_struct(name), [f"gradscape::{walls}"]

    @cpp.func_native(called="place_of_node", template=[f"wp::{name}"], adjoint="")
    def place(lattice: Lattice, i: int) -> vec3: ...

    @cpp.func_native(adjoint="adj_free_velocity")
    def free_velocity(now: Substep, grid_m: Nodes, e: int, i: int) -> vec3: ...

    @cpp.func_native(template=template, adjoint="")
    def list_near(e: int, lattice: Lattice, data: Data, now: Substep, tools: Paths, grid_m: Nodes, near: Ints): ...

    @cpp.func_native(template=template, adjoint="adj_velocity_of_others", replay=False)
    def velocity_of_others(
        e: int, lattice: Lattice, data: Data, now: Substep, tools: Paths, grid_m: Nodes, near: Ints, grid_v: Nodes
    ): ...

    @wp.kernel(module="unique", module_options=cpp.options())
    def velocity(
        lattice: Lattice,
        boundary: Data,
        now: Substep,
        tools: Paths,
        sums: Sums,
        grid_m: Nodes,
        grid_v: Nodes,
        near: Ints,
    ):
        e, _ = wp.tid()
        list_near(e, lattice, boundary, now, tools, grid_m, near)
        velocity_of_others(e, lattice, boundary, now, tools, grid_m, near, grid_v)
        count = near[e, 0]
        for n in range(count):
            i = near[e, count - n]  # the last comes first, so that adjoints come in the nodes' order
            v = free_velocity(now, grid_m, e, i)
            v = boundary_velocity(boundary, place(lattice, i), v, e, i % LANES, tools, sums, now)
            grid_v[e, i] = vec4(v[0], v[1], v[2], real(0.0))

    return cpp.take_rows(velocity)


@cache
@no_type_check
def velocity_of_columns(name: str, boundary_velocity: Any, Data: Any) -> Any:
    """Return the same kernel for a GPU, which adds up a node's momentum, and its adjoint that of the velocity.

    It runs over [environment, place in the grid].
    """
    types, take_node, Lists = precision(name), list_functions().take_node, list_struct()
    real, vec4, Nodes, Paths = types.real, types.vec4, types.rows[2], wp.array3d[types.vec3]
    Lattice, Substep, velocity_at_node = lattice(name), substep_struct(name), velocity_at(name, boundary_velocity, Data)

    @cpp.func_native(called="write_sum", template=[SEGMENT, PARTS], adjoint="", replay=False)
    def add_up(lattice: Lattice, planes: Ints, parts: Nodes, grid: Nodes, e: int, i: int, node: int): ...

    # A node is read once, so that its adjoint can be set, where Warp would add to it atomically; and it is set once.
    @cpp.func_native(called="read_node", adjoint="set_adj_read_node")
    def read(grid: Nodes, e: int, i: int) -> vec4: ...

    @cpp.func_native(called="write_with_parts", template=[SEGMENT, PARTS], adjoint="adj_write_with_parts", replay=False)
    def write(lattice: Lattice, planes: Ints, parts: Nodes, grid: Nodes, e: int, i: int, node: int, value: vec4): ...

    @wp.kernel(module="unique", module_options=cpp.options(), launch_bounds=blocks(name))
    def velocity(
        lattice: Lattice,
        boundary: Data,
        now: Substep,
        tools: Paths,
        sums: Sums,
        grid_m: Nodes,
        grid_v: Nodes,
        lists: Lists,
        parts: Nodes,
    ):
        e, i = wp.tid()
        node = take_node(lists, e, i)
        if node >= 0:
            add_up(lattice, lists.planes, parts, grid_m, e, i, node)  # its adjoint finds in grid_m what it needs
            g = read(grid_m, e, i)
            if g[3] > now.empty:
                v = velocity_at_node(lattice, boundary, now, g, e, node, tools, sums)
                write(lattice, lists.planes, parts, grid_v, e, i, node, vec4(v[0], v[1], v[2], real(0.0)))
            else:
                write(lattice, lists.planes, parts, grid_v, e, i, node, vec4())

    return velocity
