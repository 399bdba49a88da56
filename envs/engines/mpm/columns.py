"""Scatters without atomic adds, for a GPU: threads walk columns of cells, and nodes add up what columns give them.

Particles are listed by cell (`cells`). Nine lanes of a warp walk along a segment (`walk`), which leaves planes of nine
numbers of four parts, and each node then adds up those of the nine columns that it is part of. Every sum has one
order, which depends on nothing but an environment's own particles: neither on its place in a batch, nor on the box of
nodes, nor on chance.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from .. import cpp
from ..launches import blocks
from ..runtime import precision
from .cells import SEGMENT, most_walks
from .layout import layout
from .model import Box
from .stencil import lattice
from .walk import PARTS, lane_numbers, walker


@dataclass(frozen=True)
class Team:
    """How threads share walks: `groups` of them, a walk each, of `size` lanes, in a warp of so many `lanes`."""

    lanes: int
    groups: int
    size: int

    def threads(self, box: Box, stretch: int = SEGMENT) -> int:
        """Return how many threads a box of nodes takes whose walks leave stretches of so many planes."""
        return -(-most_walks(box, stretch) // self.groups) * self.lanes


GPU_TEAM, CPU_TEAM = Team(32, 3, 9), Team(1, 1, 1)  # on a CPU a thread has a walk

# Threads go through the rows of a batch from the last one on. Kernels before and after go from the first one on, and a
# GPU's cache still has what was written last.
WALK = """
def kernel(lattice, rows, order, full, walks, OWN, parts):
    k, t = wp.tid()
    e = rows - 1 - k
    mine = take_walk(e, t, full, walks)
    if t / lanes * groups >= full[e]:
        return
    at, begin, count, span = mine[0] * PARTS, mine[1], mine[2], mine[3]
    state = open_segment(parts, e, at, span)
    last = begin + wp.max(count - 1, 0)
    place = begin + row_of(t % lanes)
    p = listed(order, e, place, last)
    for i in range(0, most(count), size):
        what = given(lattice, OWN, e, p)
        p = listed(order, e, place + i + size, last)  # asked for before the present ones are walked
        state = walk(parts, e, at, span, wp.min(size, count - i), what, state)
    close_segment(parts, e, at, span, state)
"""


@cache
@no_type_check
def walk_taker(team: Team):
    """Return the functions `take_walk, listed` of a team.

    The first says of a thread's walk (segment, first place, count, span), none if it has none; the second which
    particle has a place in the list, or the `last` one of a walk.
    """
    lanes, groups, group_of = team.lanes, team.groups, lane_numbers().group

    @wp.func(module=f"gradscape.columns.{lanes}")
    def take_walk(e: int, t: int, full: wp.array[wp.int32], walks: wp.array2d[wp.vec4i]):
        group = group_of(t % lanes)
        i = t / lanes * groups + group
        mine = walks[e, wp.min(i, walks.shape[1] - 1)]  # does not wait for how many there are
        if group >= groups or i >= full[e]:
            return wp.vec4i(0, 0, 0, 0)
        return mine

    @wp.func(module=f"gradscape.columns.{lanes}")
    def listed(order: wp.array2d[wp.int32], e: int, place: int, last: int):
        return order[e, wp.min(place, last)]

    return take_walk, listed


def walking_kernel(key: str, name: str, team: Team, given: Any, *, sloping: bool) -> Any:
    """Return the kernel that leaves parts of sums at nodes, to which a particle gives what the function `given` says.

    It runs over [environment, thread of a `team`], and takes what WALK says, OWN being what `given` takes besides the
    lattice, an environment and a particle. What particles give is `sloping`, or not, as the `walker` has it.
    """
    steps, row_of, (take_walk, listed) = walker(name, sloping=sloping), lane_numbers().row, walk_taker(team)
    most, open_segment, walk, close_segment = steps.most, steps.open, steps.walk, steps.close
    lanes, groups, size = team.lanes, team.groups, team.size

    def kernel() -> Any:  # which Warp finds here by their names
        functions = given, take_walk, listed, row_of, most, open_segment, walk, close_segment
        return functions, lanes, groups, size, PARTS

    own = {label: kind for label, kind in given.input_types.items() if label not in ("lattice", "e", "p")}
    vec4 = precision(name).vec4
    kinds = {"lattice": lattice(name), "rows": int, "order": wp.array2d[wp.int32], "full": wp.array[wp.int32]}
    kinds |= {"walks": wp.array2d[wp.vec4i]} | own | {"parts": wp.array2d[vec4]}
    bounds = {"grid_stride": False} | ({"launch_bounds": blocks(name)} if blocks(name) else {})
    return wp.Kernel(
        cpp.with_arguments(kernel, kinds),
        key=key.replace(".", "__locals__"),
        module=wp.get_module(cpp.module(given.module.name)),
        options={"enable_backward": False} | bounds,
        source=WALK.replace("OWN", ", ".join(own)),
    )


@cache
@no_type_check
def node_sum(name: str):
    """Return the function (lattice, planes, parts, e, node) that adds up what the parts say of a node, in one order."""
    Lattice, vec4 = lattice(name), precision(name).vec4

    @cpp.func_native(template=[SEGMENT, PARTS])
    def add_up_node(
        lattice: Lattice, planes: wp.array2d[wp.int32], parts: wp.array2d[vec4], e: int, node: int
    ) -> vec4: ...

    return add_up_node


@cache
@no_type_check
def column_kernels(name: str, team: Team) -> SimpleNamespace:
    """Return the kernels `p2g, adjoint_g2p` of one precision, over [environment, thread of a `team`].

    They are the scatters of `transfers`, up to the parts of sums that nodes then add up (`grid`).
    """
    types, at_nodes, lies = precision(name), walker(name, sloping=True).at_nodes, layout(name)
    real, vec3, mat33 = types.real, types.vec3, types.mat33
    Lattice, module = lattice(name), cpp.module(f"gradscape.columns.{name}.{team.lanes}")
    read_number, read_vector, read_matrix = lies.read_number, lies.read_vector, lies.read_matrix

    @wp.func(module=module)
    def momentum(
        lattice: Lattice,
        mass: wp.array2d[real],
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
        A: wp.array2d[mat33],
        e: int,
        p: int,
    ):
        """Return what a particle gives to its nodes of momentum m v + A (x_i - x) and mass."""
        given = at_nodes(lattice, read_vector(x, e, p))
        given.mass = read_number(mass, e, p)
        given.a = read_matrix(A, e, p) * (real(1.0) / lattice.inv_dx)
        given.q = given.mass * read_vector(v, e, p) - given.a * given.f
        return given

    @wp.func(module=module)
    def velocity_adjoint(
        lattice: Lattice,
        dt: real,
        x: wp.array2d[vec3],
        adj_x_new: wp.array2d[vec3],
        adj_v_new: wp.array2d[vec3],
        adj_C_new: wp.array2d[mat33],
        e: int,
        p: int,
    ):
        """Return what a particle gives to its nodes of the adjoints of the velocities that g2p gathered."""
        given = at_nodes(lattice, read_vector(x, e, p))
        given.a = (real(4.0) * lattice.inv_dx) * read_matrix(adj_C_new, e, p)
        given.q = read_vector(adj_v_new, e, p) + dt * read_vector(adj_x_new, e, p) - given.a * given.f
        return given

    return SimpleNamespace(
        p2g=walking_kernel("column_kernels.p2g", name, team, momentum, sloping=True),
        adjoint_g2p=walking_kernel("column_kernels.adjoint_g2p", name, team, velocity_adjoint, sloping=True),
    )
