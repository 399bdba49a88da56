"""What a kernel has to move and to calculate, against kernels of which it can be counted by hand."""

import warp as wp

from gradscape.envs.engines.demand import Demand, demand
from gradscape.envs.engines.mpm.columns import GPU_TEAM, column_kernels
from gradscape.envs.engines.mpm.transfers import transfers
from gradscape.envs.engines.profiling import count_demands, time_kernels
from gradscape.envs.mpm.fluid import Fluid

BATCH, COUNT = 3, 5


@wp.func
def squared(values: wp.array2d[wp.float32], e: int, i: int):
    return values[e, i] * values[e, i]


@wp.kernel
def scale(factor: wp.float32, x: wp.array2d[wp.float32], y: wp.array2d[wp.float32]):
    e, i = wp.tid()
    y[e, i] = factor * x[e, i] + y[e, i]


@wp.kernel
def square(x: wp.array2d[wp.float32], y: wp.array2d[wp.float32]):
    e, i = wp.tid()
    y[e, i] = squared(x, e, i)


@wp.kernel
def turn(m: wp.array2d[wp.mat33], v: wp.array2d[wp.vec3], out: wp.array2d[wp.vec3]):
    e, i = wp.tid()
    out[e, i] = m[e, i] * v[e, i]


@wp.kernel
def collect(x: wp.array2d[wp.float64], sums: wp.array[wp.float64]):
    e, i = wp.tid()
    wp.atomic_add(sums, e, x[e, i])


@wp.kernel
def add_up(count: int, x: wp.array2d[wp.float32], y: wp.array2d[wp.float32]):
    e, i = wp.tid()
    total = wp.float32(0.0)
    for k in range(count):
        total += x[e, k]
    y[e, i] = total


def rows(dtype, count=COUNT, batch=BATCH, **how):
    return wp.zeros((batch, count), dtype=dtype, device="cpu", **how)


def test_each_array_is_read_once_and_written_once():
    x, y = rows(wp.float32), rows(wp.float32)
    assert demand(scale, (BATCH, COUNT), [2.0, x, y]) == Demand(4 * 3 * BATCH * COUNT, 2.0 * BATCH * COUNT)


def test_products_of_matrices_are_counted_in_full():
    found = demand(turn, (BATCH, COUNT), [rows(wp.mat33), rows(wp.vec3), rows(wp.vec3)])
    assert found == Demand(4 * (9 + 3 + 3) * BATCH * COUNT, 15.0 * BATCH * COUNT)


def test_functions_count_where_they_are_called():
    assert demand(square, (BATCH, COUNT), [rows(wp.float32), rows(wp.float32)]) == Demand(
        4 * 2 * BATCH * COUNT, 1.0 * BATCH * COUNT
    )


def test_arrays_that_are_larger_than_the_launch_are_met_in_part():
    x, y = rows(wp.float32, batch=10, count=20), rows(wp.float32, batch=10)
    assert demand(square, (BATCH, COUNT), [x, y]).bytes == 4 * 2 * BATCH * COUNT


def test_an_array_that_many_add_to_is_moved_once_each_way():
    sums = wp.zeros(BATCH, dtype=wp.float64, device="cpu")
    assert demand(collect, (BATCH, COUNT), [rows(wp.float64), sums]) == Demand(
        8 * BATCH * COUNT + 8 * 2 * BATCH, 1.0 * BATCH * COUNT
    )


def test_a_loop_of_unknown_length_meets_whole_arrays():
    x, y = rows(wp.float32, count=100), rows(wp.float32)
    found = demand(add_up, (BATCH, COUNT), [100, x, y])
    assert found.bytes == 4 * BATCH * (100 + COUNT)


def test_an_adjoint_by_differentiation_meets_values_and_adjoints():
    x, y, adj_x, adj_y = (rows(wp.float32) for _ in range(4))
    forward = demand(square, (BATCH, COUNT), [x, y])
    found = demand(square, (BATCH, COUNT), [x, y], [adj_x, adj_y], backward=True)
    assert found.bytes == 4 * BATCH * COUNT * (1 + 2 + 1)  # x, its adjoint both ways, the adjoint of y
    assert found.flops == 3 * forward.flops


def test_a_particle_is_moved_once_by_a_scatter():
    kernel = transfers("float32").p2g
    lattice = kernel.adj.args[0].type()
    mass, vectors, matrices = rows(wp.float32), [rows(wp.vec3) for _ in range(2)], rows(wp.mat33)
    grid = rows(wp.vec4, count=1000)
    found = demand(kernel, (BATCH, COUNT), [lattice, mass, *vectors, matrices, grid])
    assert found.bytes == 4 * (1 + 3 + 3 + 9 + 2 * 4) * BATCH * COUNT
    assert 27 * 4 * BATCH * COUNT < found.flops < 27 * 30 * BATCH * COUNT


def test_every_kernel_that_is_timed_is_counted():
    env = Fluid(fidelity="draft", device="cpu", horizon=0.02)
    points = env.space.sobol(2, seed=0)
    env._simulate(points, grad=True)
    with time_kernels("cpu") as times:
        env._simulate(points, grad=True)
    with count_demands() as demands:
        env._simulate(points, grad=True)
    p2g, backward = "transfers_in_rows.p2g", "velocity_in_rows.velocity backward"
    assert set(demands) == set(times) > {p2g, "transfers_in_rows.adjoint_g2p", backward}
    assert all(one.bytes > 0 for one in demands.values())
    once = demands[p2g].bytes / times[p2g].calls
    assert once == 4 * (1 + 3 + 3 + 9 + 2 * 4) * 2 * env.model.particles


def test_of_partial_sums_no_more_is_counted_than_is_told():
    """As many are met as there are segments with particles, which no argument says; what is walked is counted whole."""
    kernels, count = column_kernels("float32", GPU_TEAM), 40
    segments = [wp.zeros(BATCH, dtype=wp.int32), wp.zeros((BATCH, 4), dtype=wp.vec4i)]
    order = wp.zeros((BATCH, count), dtype=wp.int32)
    particles = [wp.zeros((BATCH, count), dtype=kind) for kind in (wp.float32, wp.vec3, wp.vec3, wp.mat33)]
    given = [kernels.p2g.adj.args[0].type(), BATCH, order, *segments, *particles]
    found = [demand(kernels.p2g, (BATCH, 64), [*given, wp.zeros((BATCH, room), dtype=wp.vec4)]) for room in (90, 9000)]
    assert found[0] == found[1]
    assert found[0].bytes == BATCH * (count * 4 * (1 + 1 + 3 + 3 + 9) + 4 * (1 + 4 * 4))
