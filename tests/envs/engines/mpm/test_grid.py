"""What happens at grid nodes: rows of a CPU against Warp's own code to the last bit, at walls, near tools, in boxes."""

from dataclasses import replace

import pytest
import torch
import warp as wp

from gradscape.envs.engines import cpp
from gradscape.envs.engines.mpm.boundaries import (
    STICKY,
    Kind,
    LadleInTank,
    Open,
    Sums,
    Tool,
    ToolsInRoom,
    substep_struct,
)
from gradscape.envs.engines.mpm.grid import velocity_at, velocity_on
from gradscape.envs.engines.mpm.stencil import lattice
from gradscape.envs.engines.runtime import precision

from ..bench import draw, placed

BATCH, DX, ORIGIN, STEP = 3, 1 / 32, (-0.25, -0.0625, -0.25), 1
TANK = LadleInTank(half_width=0.1875, lid=0.4, radius=0.07, half_thickness=0.01, height=0.25, band=0.02, friction=0.25)
TOOLS = (
    Tool(Kind.SPHERE, (0.04,), 0.5),
    Tool(Kind.CAPSULE, (0.05, 0.03), 0.9),
    Tool(Kind.TORUS, (0.06, 0.02), 0.0),
    Tool(Kind.CYLINDER, (0.04, 0.03), 0.5),
    Tool(Kind.ROLLER, (0.06, 0.03), 0.5),
)
ROOM = ToolsInRoom(TOOLS, (-0.1875, 0.0, -0.1875), (0.1875, 0.4, 0.1875), 0.03125, STICKY, 300.0)
BOUNDARIES = {
    "open": Open(),
    "tank": TANK,
    "tank that holds back": replace(TANK, slip=0.5),
    "tank that sticks, ladle without handle": replace(TANK, slip=0.0, height=0.0),
    "sticky floor": ROOM,
    "rubbing floor": replace(ROOM, friction=0.3),
    "slipping floor": replace(ROOM, friction=0.0, tools=TOOLS[:1]),
}
BOXES = {
    "whole grid": ((0, 0, 0), (17, 18, 17)),
    "a box": ((1, 1, 5), (9, 11, 12)),
    "a corner": ((14, 0, 13), (3, 7, 3)),
}


class Nodes:
    """The arguments of a boundary's velocity kernel: tools among nodes of which a half is empty, and some at rest."""

    def __init__(self, boundary, box):
        self.types, self.boundary = precision("float32"), boundary
        self.lattice = placed("float32", ORIGIN, DX, box[1], box[0])
        self.cells = box[1][0] * box[1][1] * box[1][2]
        mass = (draw(BATCH, self.cells, 1, seed=0)).clamp_min(0)
        velocity = 4 * draw(BATCH, self.cells, 3, seed=1)
        velocity[:, ::5] = 0.0
        velocity[:, 1::7] = -0.0
        self.grid_m = torch.cat([mass * velocity, mass], dim=2)
        self.adj_grid_v = draw(BATCH, self.cells, 4, seed=2)
        self.adj_grid_v[:, ::3] = -0.0
        self.tools = 0.2 * draw(BATCH, STEP + 2, boundary.slots, 3, seed=3) + torch.tensor([0.0, 0.1, 0.0])

    def run(self, kernel):
        """Return velocities, and the adjoints of momenta and tools, as integers of the same bits."""
        size = cpp.threads(kernel, self.cells)
        near = [wp.zeros((BATCH, self.cells + 1), dtype=wp.int32)] if size == 1 else []
        grid_v, adj_grid_m = (self.array(torch.full((BATCH, self.cells, 4), 7.0)) for _ in range(2))
        tools, adj_tools = self.array(self.tools), self.array(torch.zeros_like(self.tools))
        data, sums = self.boundary.data("float32", "cpu"), wp.zeros((1, 1), dtype=wp.int64)
        now, adj_now = (substep_struct("float32")() for _ in range(2))
        now.dt, now.gravity, now.empty, now.step, now.fraction, now.rate = 2e-3, 9.81, 1e-6, STEP, 0.25, 100.0
        inputs = [self.lattice, data, now, tools, sums, self.array(self.grid_m), grid_v, *near]
        wp.launch(kernel, (BATCH, size), inputs, record_tape=False)
        adjoints = [type(self.lattice)(), type(data)(), adj_now, adj_tools, None, adj_grid_m]
        adjoints += [self.array(self.adj_grid_v), *[None] * len(near)]
        how = {"adj_inputs": adjoints, "adj_outputs": [], "adjoint": True}
        wp.launch(kernel, (BATCH, size), inputs, record_tape=False, **how)
        self.near = near[0].numpy()[:, 0] if near else None
        return [torch.from_numpy(array.numpy()).view(torch.int32) for array in (grid_v, adj_grid_m, adj_tools)]

    def array(self, values):
        kind = {3: self.types.vec3, 4: self.types.vec4}[values.shape[-1]]
        return wp.array(values.float().contiguous().numpy(), dtype=kind, copy=True)


def in_warp(boundary):
    """Return the kernel of one node at a time, with the function and the adjoint that a GPU has."""
    types, (function, Data) = precision("float32"), boundary.function("float32")
    real, vec4, Paths, Nodes = types.real, types.vec4, wp.array3d[types.vec3], types.rows[2]
    Lattice, Substep, velocity_at_node = (
        lattice("float32"),
        substep_struct("float32"),
        velocity_at("float32", function, Data),
    )

    @cpp.func_native(called="read_node", adjoint="set_adj_read_node")
    def read(grid: Nodes, e: int, i: int) -> vec4: ...

    @cpp.func_native(called="write_node", adjoint="set_adj_write_node", replay=False)
    def write(grid: Nodes, e: int, i: int, value: vec4): ...

    @wp.kernel(module="unique", module_options=cpp.options())
    def velocity(
        lattice: Lattice, boundary: Data, now: Substep, tools: Paths, sums: Sums, grid_m: Nodes, grid_v: Nodes
    ):
        e, i = wp.tid()
        g = read(grid_m, e, i)
        if g[3] > now.empty:
            v = velocity_at_node(lattice, boundary, now, g, e, i, tools, sums)
            write(grid_v, e, i, vec4(v[0], v[1], v[2], real(0.0)))
        else:
            write(grid_v, e, i, vec4())

    return velocity


@pytest.mark.parametrize("box", BOXES.values(), ids=BOXES)
@pytest.mark.parametrize("boundary", BOUNDARIES.values(), ids=BOUNDARIES)
def test_rows_of_a_cpu_have_the_same_bits(boundary, box):
    nodes, rows = Nodes(boundary, box), velocity_on("float32", boundary, columns=False)
    wanted = nodes.run(in_warp(boundary))
    found = nodes.run(rows)
    for one, other in zip(wanted, found, strict=True):
        assert torch.equal(one, other)
    assert wanted[0].any()
    assert wanted[1].any()
    assert (nodes.near < nodes.cells / 2).all()  # half of them are empty
    if box is BOXES["whole grid"] and not isinstance(boundary, Open):
        assert wanted[2].any(dim=3).any(dim=2)[:, STEP:].all()
        assert (nodes.near > 0).all()
        assert (nodes.near < nodes.cells / 4).all()
