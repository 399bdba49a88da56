"""Scatters as a GPU's warps do them, without a GPU: what Warp makes for one, compiled for the CPU and emulated."""

from dataclasses import replace

import pytest
import torch
import warp as wp

from gradscape.envs.engines.mpm.boundaries import Open, substep_struct
from gradscape.envs.engines.mpm.columns import GPU_TEAM, PARTS, SEGMENT, STRETCH, column_kernels, segments
from gradscape.envs.engines.mpm.grid import velocity_on
from gradscape.envs.engines.mpm.model import Box, place_grid
from gradscape.envs.engines.mpm.smoothing import smoothed_struct, smoothing_columns
from gradscape.envs.engines.mpm.stencil import particles
from gradscape.envs.engines.mpm.transfers import transfers
from gradscape.envs.engines.runtime import to_torch

from .bodies import kneading
from .emulation import emulate
from .listing import Listing

ROWS, COUNT, BODY = 2, 300, slice(40, 270)


class Scattering:
    """Particles listed by cell in emulation, and nodes that add up what warps leave."""

    def __init__(self, box, spread, stretch):
        model = replace(kneading()[0], precision="float32")
        self.box, self.lattice, self.stretch = box, place_grid(model, box), stretch
        lowest = torch.tensor([0.6 + first for first in box.first])
        reach = spread * torch.tensor([nodes - 3.2 for nodes in box.nodes])
        draw = torch.Generator().manual_seed(5)
        self.x = torch.tensor(model.origin) + model.dx * (lowest + reach * torch.rand((ROWS, COUNT, 3), generator=draw))
        self.v, self.A = torch.randn((ROWS, COUNT, 3), generator=draw), torch.randn((ROWS, COUNT, 3, 3), generator=draw)
        self.mass = 0.5 + torch.rand((ROWS, COUNT), generator=draw)
        self.listing = Listing(emulate, "float32", self.lattice, box, self.x, stretch)
        for _ in range(2):  # the second time it begins where the first has ended
            self.listing.run()

    def walk(self, kernel, inputs):
        """Return what nodes add up of what warps leave, [row, node, 4]."""
        parts = wp.array(torch.full((ROWS, segments(self.box) * PARTS, 4), torch.nan).numpy(), dtype=wp.vec4)
        lists = self.listing.lists
        emulate(
            kernel,
            (ROWS, GPU_TEAM.threads(self.box, self.stretch)),
            [self.lattice, ROWS, lists, *inputs, parts],
        )
        momentum, velocity = self.zeros(self.box.cells, wp.vec4), self.zeros(self.box.cells, wp.vec4)
        now = substep_struct("float32")()
        now.empty = -1.0  # no node is empty, and there is no gravity
        tools, sums = wp.zeros((ROWS, 1, 1), dtype=wp.vec3), wp.zeros((1, 1), dtype=wp.int64)
        given = [self.lattice, Open().data("float32", "cpu"), now, tools, sums, momentum, velocity]
        kernel = velocity_on("float32", Open(), columns=True)
        emulate(kernel, (ROWS, self.box.cells), [*given, lists, parts])
        found = torch.zeros(ROWS, self.box.cells, 4)
        for row, (count, _) in enumerate(to_torch(lists.touched).tolist()):
            found[row, to_torch(lists.nodes)[row, :count].long()] = to_torch(momentum)[row, :count]
        return found

    def transfer(self, mass, q, A):
        """Return what `transfers` scatter of particles of momentum q and affine momentum A."""
        grid = self.zeros(self.box.cells, wp.vec4)
        inputs = [self.lattice, *map(self.array, (mass, self.x, q / mass[:, :, None], A)), grid]
        wp.launch(transfers("float32").p2g, (ROWS, 1), inputs)
        return to_torch(grid).clone()

    def zeros(self, count, kind=wp.int32):
        return wp.zeros((ROWS, count), dtype=kind)

    def array(self, values):
        kind = {2: wp.float32, 3: wp.vec3, 4: wp.mat33}[values.ndim]
        return wp.array(values.contiguous().numpy(), dtype=kind)

    def frame(self, x, v, C=None):
        """Return particles as kernels take them."""
        found = particles("float32")()
        found.x, found.v = self.array(x), self.array(v)
        found.C = None if C is None else self.side_by_side(C)
        return found

    def side_by_side(self, matrices):
        """Return matrices as they lie on a GPU."""
        return self.array(matrices.flatten(2).transpose(1, 2).reshape(matrices.shape))


@pytest.fixture(scope="module", params=[(0, 1.0), (3, 1.0), (5, 0.05)])
def scattering(request):
    first, spread = request.param
    box = Box((1, 0, first), (8, 7, 17 - first))
    whole, *others = (Scattering(box, spread, stretch) for stretch in (SEGMENT, STRETCH, 1))
    whole.others = others
    return whole


def assert_close(got, wanted):
    torch.testing.assert_close(got, wanted, rtol=0, atol=2e-5 * float(wanted.abs().max()))


@pytest.mark.slow
def test_warps_scatter_momentum_and_mass(scattering):
    """In stretches of any length they give the same bits."""
    s = scattering
    inputs = [s.array(s.mass), s.frame(s.x, s.v), s.side_by_side(s.A)]
    got = s.walk(column_kernels("float32", GPU_TEAM).p2g, inputs)
    for other in s.others:
        assert torch.equal(other.walk(column_kernels("float32", GPU_TEAM).p2g, inputs), got)
    assert_close(got, s.transfer(s.mass, s.mass[:, :, None] * s.v, s.A))


@pytest.mark.slow
def test_warps_scatter_adjoints_of_velocities(scattering):
    s, dt = scattering, 0.25
    adj_x, adj_C = s.v.flip(1), 0.01 * s.A
    inputs = [dt, s.array(s.x), s.frame(adj_x, s.v, adj_C)]
    got = s.walk(column_kernels("float32", GPU_TEAM).adjoint_g2p, inputs)
    inverse_dx = s.lattice.inv_dx
    wanted = s.transfer(torch.ones_like(s.mass), s.v + dt * adj_x, 4 * inverse_dx**2 * adj_C)
    assert_close(got[:, :, :3], wanted[:, :, :3])


def test_warps_scatter_what_one_body_smooths(scattering):
    s, slope = scattering, 0.3
    J = 0.9 + 0.2 * s.mass[:, BODY]
    fluid = smoothed_struct("float32")()
    fluid.first, fluid.slope, fluid.volume, fluid.x, fluid.J = BODY.start, slope, *map(s.array, (s.mass, s.x, J))
    got = s.walk(smoothing_columns("float32", GPU_TEAM).spread, [fluid])
    volume = torch.zeros_like(s.mass)
    volume[:, BODY] = s.mass[:, BODY]
    q = torch.zeros_like(s.x)
    q[:, BODY, 0], q[:, :, 1] = volume[:, BODY] * (J.log() - slope * s.x[:, BODY, 1]), volume
    assert_close(got[:, :, :2], s.transfer(torch.ones_like(s.mass), q, 0 * s.A)[:, :, :2])
