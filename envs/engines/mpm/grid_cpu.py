"""The grid's velocities for a CPU in float32, in C++: an environment's nodes one after another, and the same bits.

What walls do is a few comparisons, four numbers at a time. The nodes that a tool may reach are listed, and left to the
boundary's Warp function and the adjoint that Warp makes of it.
"""

from functools import cache
from typing import Any, no_type_check

import warp as wp

from .. import cpp
from ..runtime import precision, take_rows
from .boundaries import Boundary, LadleInTank, Open
from .exact import LANES
from .grid import velocity_kernel, velocity_of_columns
from .stencil import lattice
from .tools import STICKY, ToolsInRoom

# Walls in C++ by the kind of boundary.
WALLS = {Open: "OpenWalls", LadleInTank: "TankWalls", ToolsInRoom: f"Room<{STICKY:.0f}>::Walls"}


def velocity_on(device: str, name: str, boundary: Boundary, *, columns: bool) -> Any:
    """Return the velocity kernel of one precision that is quickest on a device, after scatters by columns or others."""
    function, Data = boundary.function(name)
    if columns:
        return velocity_of_columns(name, function, Data)
    walls = WALLS.get(type(boundary))
    if device == "cpu" and name == "float32" and walls:
        return velocity_in_rows(name, function, Data, walls)
    return velocity_kernel(name, function, Data)


@cache
@no_type_check
def velocity_in_rows(name: str, boundary_velocity: Any, Data: Any, walls: str) -> Any:
    """Return the kernel of `grid`, each of whose threads has the row of an environment.

    It takes room for a list of nodes besides: more numbers by one than there are nodes.
    """
    types = precision(name)
    real, vec3, vec4 = types.real, types.vec3, types.vec4
    Lattice, template = lattice(name), [f"gradscape::{walls}"]

    @cpp.func_native(called="place_of_node", template=[f"wp::{name}"], adjoint="")
    def place(lattice: Lattice, i: int) -> vec3: ...

    @cpp.func_native(adjoint="adj_free_velocity")
    def free_velocity(dt: real, gravity: real, grid_m: wp.array2d[vec4], e: int, i: int) -> vec3: ...

    @cpp.func_native(template=template, adjoint="")
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

    @cpp.func_native(template=template, adjoint="adj_velocity_of_others", replay=False)
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

    take_rows(velocity, velocity_kernel(name, boundary_velocity, Data), "lattice")
    return velocity
