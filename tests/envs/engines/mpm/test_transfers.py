"""Transfers between particles and grid: conservation laws, exactness on affine fields, and formulas in torch."""

from types import SimpleNamespace

import pytest
import torch
import warp as wp

from gradscape.envs.engines.mpm.smoothing import _stencil
from gradscape.envs.engines.mpm.transfers import transfers
from gradscape.envs.engines.runtime import precision, to_torch

from ..bench import NAMES, draw, placed

ORIGIN, DX, NODES, DT = (-0.3, 0.2, 1.1), 0.05, (9, 8, 10), 2e-3
BATCH, COUNT = 2, 43
ROUND_OFF = {"float32": 1e-5, "float64": 1e-13}


X = torch.tensor(ORIGIN, dtype=torch.float64) + DX * (
    torch.tensor(NODES, dtype=torch.float64) / 2 + (torch.tensor(NODES) - 4) * draw(BATCH, COUNT, 3, seed=0)
)
V, A, M = draw(BATCH, COUNT, 3, seed=1), draw(BATCH, COUNT, 3, 3, seed=2), 1.5 + draw(BATCH, COUNT, seed=3)
CELLS = NODES[0] * NODES[1] * NODES[2]
ROW = torch.arange(BATCH)[:, None, None]
AT_NODES = draw(BATCH, CELLS, 4, seed=4) * torch.tensor([1, 1, 1, 0])  # a grid velocity has no fourth part


def node_positions():
    axes = [origin + DX * torch.arange(n, dtype=torch.float64) for origin, n in zip(ORIGIN, NODES, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


class Bench:
    """Hold the arrays of one precision, and launch the transfers on tensors."""

    def __init__(self, name):
        self.types, self.kernels = precision(name), transfers(name)
        self.lattice = placed(name, ORIGIN, DX, NODES)
        self.kinds = {(): self.types.real, (3,): self.types.vec3, (4,): self.types.vec4, (3, 3): self.types.mat33}

    def array(self, values, kind=None):
        tail = tuple(values.shape[2:]) if values.ndim > 1 else ()
        return wp.array(values.to(self.types.torch).contiguous().numpy(), dtype=kind or self.kinds[tail], copy=True)

    def zeros(self, size, *tail):
        return self.array(torch.zeros(BATCH, size, *tail))

    def launch(self, kernel, inputs):
        wp.launch(kernel, (BATCH, 1), inputs, record_tape=False)

    def p2g(self, x=X, v=V, a=A):
        grid_m = self.zeros(CELLS, 4)
        self.launch(self.kernels.p2g, [self.lattice, *map(self.array, (M, x, v, a)), grid_m])
        return double(grid_m)

    def g2p(self, x=X, grid_v=AT_NODES, *, inside=True):
        new = [self.zeros(COUNT, 3), self.zeros(COUNT, 3), self.zeros(COUNT, 3, 3)]
        escaped = wp.zeros(BATCH, dtype=wp.int32)
        self.launch(self.kernels.g2p, [self.lattice, DT, self.array(x), self.array(grid_v), *new, escaped])
        assert to_torch(escaped).any() != inside
        return [double(array) for array in new]

    def adjoint_p2g(self, adj_grid_m, x=X):
        """Return the adjoints of x, v, A."""
        adjoints = [self.zeros(COUNT, 3), self.zeros(COUNT, 3), self.zeros(COUNT, 3, 3)]
        inputs = [self.lattice, *map(self.array, (M, x, V, A, adj_grid_m)), *adjoints]
        self.launch(self.kernels.adjoint_p2g, inputs)
        return [double(array) for array in adjoints]

    def adjoint_g2p(self, adj_x_new, adj_v_new, adj_C_new, x=X):
        """Return the adjoints of x and grid_v."""
        adj_grid_v, adj_x = self.zeros(CELLS, 4), self.zeros(COUNT, 3)
        given = map(self.array, (x, AT_NODES, adj_x_new, adj_v_new, adj_C_new))
        self.launch(self.kernels.adjoint_g2p, [self.lattice, DT, *given, adj_grid_v, adj_x])
        return double(adj_x), double(adj_grid_v)


def double(array):
    return to_torch(array).double().clone()


def outside(x):
    """Take some particles out of the grid, where they are clamped to its border."""
    moved = x.clone()
    moved[0, :4] += torch.tensor([[0.9, 0, 0], [-0.9, 0, 0], [0, 0.9, -0.9], [0, 0, 0.0]])
    return moved


def stencil(x):
    """Return the numbers of the 27 nodes around each particle, their weights, and how far they are from it [m]."""
    node, weight = _stencil(SimpleNamespace(origin=ORIGIN, dx=DX, nodes=NODES), x)
    return node, weight, node_positions()[node] - x[:, :, None]


def reference_p2g(x, v, a):
    """Return momentum and mass at nodes, in torch."""
    node, weight, apart = stencil(x)
    momentum = M[:, :, None, None] * v[:, :, None] + torch.einsum("bpij,bpnj->bpni", a, apart)
    given = weight[..., None] * torch.cat([momentum, M[:, :, None, None].expand(-1, -1, 27, 1)], dim=3)
    return torch.zeros(BATCH, CELLS, 4).double().index_put((ROW, node), given, accumulate=True)


def reference_g2p(x, grid_v):
    """Return x, v and C after a step, in torch."""
    node, weight, apart = stencil(x)
    velocity = weight[..., None] * grid_v[ROW, node][..., :3]
    v = velocity.sum(dim=2)
    return x + DT * v, v, 4 / DX**2 * torch.einsum("bpni,bpnj->bpij", velocity, apart)


@pytest.fixture(scope="module", params=NAMES)
def bench(request):
    return Bench(request.param)


def assert_relative(got, wanted, tolerance):
    torch.testing.assert_close(got, wanted, rtol=0, atol=tolerance * float(wanted.abs().max()))


def moment(x, q):
    return torch.linalg.cross(x.expand_as(q), q, dim=-1).sum(dim=-2)


def test_p2g_conserves_mass_and_momentum(bench):
    grid = bench.p2g()
    tolerance = ROUND_OFF[bench.types.name]
    assert_relative(grid[:, :, 3].sum(dim=1), M.sum(dim=1), tolerance)
    assert_relative(grid[:, :, :3].sum(dim=1), (M[:, :, None] * V).sum(dim=1), 10 * tolerance)


def test_p2g_conserves_angular_momentum_with_that_of_the_affine_field(bench):
    momentum = bench.p2g()[:, :, :3]
    axial = torch.stack([A[..., k, j] - A[..., j, k] for j, k in ((1, 2), (2, 0), (0, 1))], dim=-1)
    wanted = moment(X, M[:, :, None] * V) + DX**2 / 4 * axial.sum(dim=1)
    assert_relative(moment(node_positions(), momentum), wanted, 10 * ROUND_OFF[bench.types.name])


def test_g2p_reproduces_an_affine_velocity_field(bench):
    v0, C = draw(3, seed=5), draw(3, 3, seed=6)
    field = torch.cat([v0 + node_positions() @ C.T, torch.zeros(CELLS, 1)], dim=1).expand(BATCH, -1, -1)
    x_new, v_new, C_new = bench.g2p(grid_v=field)
    tolerance = 10 * ROUND_OFF[bench.types.name]
    assert_relative(v_new, v0 + X @ C.T, tolerance)
    assert_relative(C_new, C.expand_as(C_new), 10 * tolerance)  # a difference of velocities over a cell
    assert_relative(x_new, X + DT * (v0 + X @ C.T), tolerance)


@pytest.mark.parametrize("where", [X, outside(X)], ids=["within", "some without"])
def test_transfers_and_their_adjoints_are_those_of_torch(bench, where):
    """Of eight particles at a time, and three that are left; some are clamped to the grid's border."""
    at = [one.clone().requires_grad_() for one in (where, V, A, AT_NODES)]
    adj_grid, adj_new = draw(BATCH, CELLS, 4, seed=7), [draw(BATCH, COUNT, *t, seed=8) for t in ((3,), (3,), (3, 3))]
    grid, new = reference_p2g(*at[:3]), reference_g2p(at[0], at[3])
    wanted = [grid, *torch.autograd.grad((grid * adj_grid).sum(), at[:3])]
    wanted += [*new, *torch.autograd.grad(sum((x * w).sum() for x, w in zip(new, adj_new, strict=True)), at[::3])]
    found = [bench.p2g(where), *bench.adjoint_p2g(adj_grid, where), *bench.g2p(where, inside=where is X)]
    found += bench.adjoint_g2p(*adj_new, where)
    for got, exact in zip(found, wanted, strict=True):
        assert exact.abs().max() > 0
        assert_relative(got, exact.detach(), {"float32": 2e-5, "float64": 1e-12}[bench.types.name])


def test_a_particle_near_the_edge_of_the_grid_is_reported():
    bench = Bench("float64")
    inside = torch.tensor(ORIGIN, dtype=torch.float64) + 3 * DX
    x = inside.expand(BATCH, COUNT, 3).clone()
    x[1, 7, 1] = ORIGIN[1] + (NODES[1] - 1) * DX
    escaped = wp.zeros(BATCH, dtype=wp.int32)
    new = [bench.zeros(COUNT, 3), bench.zeros(COUNT, 3), bench.zeros(COUNT, 3, 3)]
    bench.launch(bench.kernels.g2p, [bench.lattice, DT, bench.array(x), bench.array(AT_NODES), *new, escaped])
    assert to_torch(escaped).tolist() == [0, 1]
