"""Transfers between particles and grid: conservation laws, exactness on affine fields, adjoints against Warp's own."""

from functools import cache
from types import SimpleNamespace

import pytest
import torch
import warp as wp

from gradscape.envs.engines import cpp
from gradscape.envs.engines.mpm.transfers import lattice, transfers
from gradscape.envs.engines.mpm.transfers_cpu import transfers_in_rows, transfers_on_cpu
from gradscape.envs.engines.runtime import has_rows, precision, to_torch

from ..bench import placed

ORIGIN, DX, NODES, DT = (-0.3, 0.2, 1.1), 0.05, (9, 8, 10), 2e-3
BATCH, COUNT = 2, 43
NAMES = ["float32", "float64"]
ROUND_OFF = {"float32": 1e-5, "float64": 1e-13}


def draw(*shape, seed):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5


X = torch.tensor(ORIGIN, dtype=torch.float64) + DX * (
    torch.tensor(NODES, dtype=torch.float64) / 2 + (torch.tensor(NODES) - 4) * draw(BATCH, COUNT, 3, seed=0)
)
V, A, M = draw(BATCH, COUNT, 3, seed=1), draw(BATCH, COUNT, 3, 3, seed=2), 1.5 + draw(BATCH, COUNT, seed=3)
CELLS = NODES[0] * NODES[1] * NODES[2]
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
        wp.launch(kernel, (BATCH, COUNT), inputs, record_tape=False)

    def adjoint(self, kernel, inputs, adjoints):
        wp.launch(
            kernel,
            (BATCH, COUNT),
            inputs,
            adj_inputs=[lattice(self.types.name)(), *adjoints],
            adj_outputs=[],
            adjoint=True,
            record_tape=False,
        )

    def p2g(self, x=X, v=V, a=A):
        grid_m = self.zeros(CELLS, 4)
        self.launch(self.kernels.p2g, [self.lattice, *map(self.array, (M, x, v, a)), grid_m])
        return double(grid_m)

    def g2p(self, x=X, grid_v=AT_NODES):
        new = [self.zeros(COUNT, 3), self.zeros(COUNT, 3), self.zeros(COUNT, 3, 3)]
        escaped = wp.zeros(BATCH, dtype=wp.int32)
        self.launch(self.kernels.g2p, [self.lattice, DT, self.array(x), self.array(grid_v), *new, escaped])
        assert not to_torch(escaped).any()
        return [double(array) for array in new]

    def adjoint_p2g(self, adj_grid_m):
        """Return the adjoints of x, v, A by the kernel written out."""
        adjoints = [self.zeros(COUNT, 3), self.zeros(COUNT, 3), self.zeros(COUNT, 3, 3)]
        inputs = [self.lattice, *map(self.array, (M, X, V, A, adj_grid_m)), *adjoints]
        self.launch(self.kernels.adjoint_p2g, inputs)
        return [double(array) for array in adjoints]

    def adjoint_g2p(self, adj_x_new, adj_v_new, adj_C_new):
        """Return the adjoints of x and grid_v by the kernel written out."""
        adj_grid_v, adj_x = self.zeros(CELLS, 4), self.zeros(COUNT, 3)
        given = map(self.array, (X, AT_NODES, adj_x_new, adj_v_new, adj_C_new))
        self.launch(self.kernels.adjoint_g2p, [self.lattice, DT, *given, adj_grid_v, adj_x])
        return double(adj_x), double(adj_grid_v)

    def warp_adjoint_p2g(self, adj_grid_m):
        """Return the adjoints of x, v, A by Warp's AD of p2g."""
        adjoints = [self.zeros(COUNT, 3), self.zeros(COUNT, 3), self.zeros(COUNT, 3, 3)]
        inputs = [self.lattice, *map(self.array, (M, X, V, A)), self.zeros(CELLS, 4)]
        self.adjoint(differentiated(self.types.name).p2g, inputs, [None, *adjoints, self.array(adj_grid_m)])
        return [double(array) for array in adjoints]

    def warp_adjoint_g2p(self, adj_x_new, adj_v_new, adj_C_new):
        """Return the adjoints of x and grid_v by Warp's AD of g2p."""
        adj_x, adj_grid_v = self.zeros(COUNT, 3), self.zeros(CELLS, 4)
        new = [self.zeros(COUNT, 3), self.zeros(COUNT, 3), self.zeros(COUNT, 3, 3), wp.zeros(BATCH, dtype=wp.int32)]
        inputs = [self.lattice, DT, self.array(X), self.array(AT_NODES), *new]
        given = [*map(self.array, (adj_x_new, adj_v_new, adj_C_new)), None]
        self.adjoint(differentiated(self.types.name).g2p, inputs, [None, adj_x, adj_grid_v, *given])
        return double(adj_x), double(adj_grid_v)


def double(array):
    return to_torch(array).double().clone()


@cache
def differentiated(name):
    """Return p2g and g2p built anew, this time with Warp's own adjoints."""
    kernels = transfers(name)
    decorate = wp.kernel(module=cpp.module(f"tests.transfers.{name}"), enable_backward=True)
    return SimpleNamespace(p2g=decorate(kernels.p2g.func), g2p=decorate(kernels.g2p.func))


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


@pytest.mark.parametrize(("transfer", "parts"), [("p2g", 3), ("g2p", 2)])
def test_adjoints_equal_warps_own(bench, transfer, parts):
    given = [draw(BATCH, CELLS, 4, seed=7)]
    if transfer == "g2p":
        given = [draw(BATCH, COUNT, *tail, seed=7 + i) for i, tail in enumerate([(3,), (3,), (3, 3)])]
    ours = getattr(bench, f"adjoint_{transfer}")(*given)
    warps = getattr(Bench("float64"), f"warp_adjoint_{transfer}")(*given)  # the sum of four floats has none of its own
    assert len(ours) == len(warps) == parts
    for got, wanted in zip(ours, warps, strict=True):
        assert wanted.abs().max() > 0
        assert_relative(got, wanted, {"float32": 1e-5, "float64": 1e-12}[bench.types.name])


def slope(function, x, direction, step):
    return (function(x + step * direction) - function(x - step * direction)) / (2 * step)


def test_adjoint_of_p2g_is_its_slope():
    bench = Bench("float64")
    adj_grid_m = draw(BATCH, CELLS, 4, seed=8)
    adjoints = bench.adjoint_p2g(adj_grid_m)
    for name, at, adjoint in zip("xva", (X, V, A), adjoints, strict=True):
        direction = draw(*at.shape, seed=9) * (DX if name == "x" else 1)
        by_differences = slope(lambda y, name=name: (bench.p2g(**{name: y}) * adj_grid_m).sum(), at, direction, 1e-5)
        torch.testing.assert_close((adjoint * direction).sum(), by_differences, rtol=1e-7, atol=0)


def test_adjoint_of_g2p_is_its_slope():
    bench = Bench("float64")
    given = [draw(BATCH, COUNT, *tail, seed=10 + i) for i, tail in enumerate([(3,), (3,), (3, 3)])]
    adjoints = bench.adjoint_g2p(*given)
    for name, at, adjoint in zip(("x", "grid_v"), (X, AT_NODES), adjoints, strict=True):
        direction = draw(*at.shape, seed=13) * (DX if name == "x" else 1)

        def paired(y, name=name):
            return sum((new * weight).sum() for new, weight in zip(bench.g2p(**{name: y}), given, strict=True))

        torch.testing.assert_close((adjoint * direction).sum(), slope(paired, at, direction, 1e-5), rtol=1e-7, atol=0)


def test_a_particle_near_the_edge_of_the_grid_is_reported():
    bench = Bench("float64")
    inside = torch.tensor(ORIGIN, dtype=torch.float64) + 3 * DX
    x = inside.expand(BATCH, COUNT, 3).clone()
    x[1, 7, 1] = ORIGIN[1] + (NODES[1] - 1) * DX
    escaped = wp.zeros(BATCH, dtype=wp.int32)
    new = [bench.zeros(COUNT, 3), bench.zeros(COUNT, 3), bench.zeros(COUNT, 3, 3)]
    bench.launch(bench.kernels.g2p, [bench.lattice, DT, bench.array(x), bench.array(AT_NODES), *new, escaped])
    assert to_torch(escaped).tolist() == [0, 1]


def outside(x):
    """Take some particles out of the grid, where they are clamped to its border."""
    moved = x.clone()
    moved[0, :4] += torch.tensor([[0.9, 0, 0], [-0.9, 0, 0], [0, 0.9, -0.9], [0, 0, 0.0]])
    return moved


@pytest.mark.parametrize("x", [X, outside(X)], ids=["within", "some without"])
def test_rows_of_a_cpu_have_the_same_bits(x):
    """Eight particles at a time, and three that are left, give what Warp's own code gives, one at a time."""
    bench, rows = Bench("float32"), transfers_in_rows()
    place = [bench.lattice, bench.array(M), bench.array(x), bench.array(V), bench.array(A)]
    moved = [bench.lattice, DT, bench.array(x), bench.array(AT_NODES)]
    adjoints = [bench.array(draw(BATCH, COUNT, *tail, seed=7)) for tail in ((3,), (3,), (3, 3))]
    free = bench.array(draw(BATCH, CELLS, 4, seed=8))

    def zeros(*names):
        tails = {"node": (CELLS, 4), "vector": (COUNT, 3), "matrix": (COUNT, 3, 3)}
        return [bench.zeros(tails[name][0], *tails[name][1:]) for name in names]

    calls = {
        "p2g": (place, lambda: zeros("node")),
        "g2p": (moved, lambda: [*zeros("vector", "vector", "matrix"), wp.zeros(BATCH, dtype=wp.int32)]),
        "adjoint_p2g": ([*place, free], lambda: [bench.array(V), *zeros("vector", "matrix")]),
        "adjoint_g2p": ([*moved, *adjoints], lambda: zeros("node", "vector")),
    }
    for name, (inputs, make) in calls.items():
        wanted, found = make(), make()
        wp.launch(getattr(bench.kernels, name), (BATCH, COUNT), [*inputs, *wanted], record_tape=False)
        wp.launch(getattr(rows, name), (BATCH, 1), [*inputs, *found], record_tape=False)
        for one, other in zip(wanted, found, strict=True):
            assert (one.numpy() == other.numpy()).all(), name
            assert one.numpy().any() or name == "g2p", name


def test_only_a_cpu_in_single_precision_has_rows():
    assert has_rows(transfers_on_cpu("float32").p2g)
    assert not has_rows(transfers_on_cpu("float64").p2g)
