import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gradscape.landscapes.plane import Plane
from gradscape.landscapes.space import ParameterSpace

SPACE = ParameterSpace(
    ("x", "y", "z", "w"),
    torch.tensor([-1.0, 0.0, 2.0, -5.0]).double(),
    torch.tensor([1.0, 10.0, 3.0, 5.0]).double(),
    ("m", "m/s", "", "kg [dry]"),
)
COORDINATES = st.lists(st.floats(-10, 10), min_size=2, max_size=2)
FEW = settings(max_examples=40)


def tilted(seed: int, rank: int = 2, dim: int = 6) -> Plane:
    draw = torch.Generator().manual_seed(seed)
    origin, directions = (torch.randn(size, generator=draw).double() for size in ((dim,), (rank, dim)))
    return Plane.span(origin, directions, resolution=4)


@FEW
@given(st.integers(0, 10**6), st.integers(1, 2), COORDINATES)
def test_project_undoes_lift_for_any_basis(seed, rank, u):
    plane = tilted(seed, rank)
    at = torch.tensor(u[:rank], dtype=torch.float64)
    condition = float(torch.linalg.cond(plane.basis))
    scale = 1 + float(plane.lift(at).abs().max()) / float(torch.linalg.svdvals(plane.basis)[-1])
    assert float((plane.project(plane.lift(at)) - at).abs().max()) < 1e-14 * condition * scale


@FEW
@given(st.integers(0, 10**6), COORDINATES, st.floats(0, 100))
def test_distance_is_the_length_of_what_leaves_the_plane(seed, u, far):
    plane = tilted(seed)
    normal = torch.linalg.svd(plane.basis).Vh[-1]
    on = plane.lift(torch.tensor(u, dtype=torch.float64))
    assert float(plane.distance(on + far * normal)) == pytest.approx(far, abs=1e-9)


def test_projection_is_the_nearest_point_of_the_plane():
    plane = tilted(0)
    x = torch.linspace(-3, 3, 6).double()
    u = plane.project(x)
    for step in torch.eye(2).double() * 1e-3:
        assert plane.distance(x) < (plane.lift(u + step) - x).norm()
        assert plane.distance(x) < (plane.lift(u - step) - x).norm()


def test_points_lift_and_project_whatever_their_batch():
    plane, u = tilted(1), torch.rand(3, 5, 2).double()
    x = plane.lift(u)
    assert x.shape == (3, 5, 6)
    assert torch.equal(x[1, 2], plane.lift(u[1, 2]))
    assert plane.project(x).shape == (3, 5, 2)
    assert plane.distance(plane.lift(u[:0])).shape == (0, 5)


@FEW
@given(COORDINATES)
def test_along_the_axes_a_coordinate_is_the_parameter_itself_to_the_bit(u):
    origin = SPACE.center
    plane = Plane.through(SPACE, origin, ["w", 1], resolution=3)
    x = plane.lift(torch.tensor(u, dtype=torch.float64))
    assert x.tolist() == [origin[0], u[1], origin[2], u[0]]


@pytest.mark.parametrize(
    ("window", "lower", "upper"),
    [
        (None, [-1, 0], [1, 10]),
        (1.0, [-1, 0], [1, 10]),
        (0.1, [0.8, 4.5], [1.0, 5.5]),
        (2.0, [-1.0, -5.0], [3.0, 15.0]),
        ((-3, 4), [-3, -3], [4, 4]),
        (([0, 1], 2), [0, 1], [2, 2]),
    ],
)
def test_extent_is_the_bounds_a_window_inside_them_or_a_range(window, lower, upper):
    origin = torch.tensor([1.0, 5.0, 2.0, 0.0]).double()
    plane = Plane.through(SPACE, origin, ["x", "y"], resolution=3, window=window)
    torch.testing.assert_close(plane.lower, torch.tensor(lower).double())
    torch.testing.assert_close(plane.upper, torch.tensor(upper).double())


def test_axes_have_names_and_units_ascend_and_include_both_ends():
    plane = Plane.through(SPACE, SPACE.center, ["w", "z"], resolution=[5, 7])
    assert plane.labels == ("w [kg [dry]]", "z")
    assert (plane.names, plane.units) == (("w", "z"), ("kg [dry]", ""))
    for axis, count, low, high in zip(plane.axes(), (5, 7), plane.lower, plane.upper, strict=True):
        assert (len(axis), axis[0], axis[-1]) == (count, low, high)
        assert (axis.diff() > 0).all()


@FEW
@given(st.integers(0, 10**6), st.integers(1, 2))
def test_principal_recovers_the_plane_its_points_lie_in(seed, rank):
    draw = torch.Generator().manual_seed(seed)
    plane = tilted(seed, rank)
    points = plane.lift(torch.randn(20, rank, generator=draw).double())
    found = Plane.principal(points, rank=rank, resolution=4)
    assert float(found.distance(points).max()) < 1e-12 * float(points.abs().max() + 1)
    assert torch.allclose(found.basis @ found.basis.T, torch.eye(rank).double())
    u = found.project(points)
    assert ((u > found.lower) & (u < found.upper)).all()


def test_slope_is_the_derivative_of_the_lifted_loss():
    plane = tilted(5)
    u = torch.tensor([0.3, -0.7]).double().requires_grad_()
    x = plane.lift(u)
    (along,) = torch.autograd.grad((x**3).sum(), u)
    torch.testing.assert_close(plane.slope(3 * x.detach() ** 2), along)


@FEW
@given(st.integers(0, 10**6))
def test_a_record_rebuilds_the_plane_to_the_bit(seed):
    plane = tilted(seed)
    again = Plane.from_record(plane.record())
    assert again.record() == plane.record()
    assert torch.equal(again.basis, plane.basis)


@pytest.mark.parametrize(
    ("dims", "options", "said"),
    [
        (["x", "x"], {}, "different parameters; got x, x"),
        (["x", "y", "z"], {}, "one or two"),
        ([], {}, "got none"),
        (["q"], {}, "no parameter is called 'q'"),
        (["x", "y"], {"resolution": (3,)}, "2 values of resolution; got 1"),
        (["x", "y"], {"window": ([0, 0, 0], 1)}, "one number per axis, 2 in all"),
    ],
)
def test_a_slice_that_makes_no_sense_is_refused(dims, options, said):
    with pytest.raises(ValueError, match=said):
        Plane.through(SPACE, SPACE.center, dims, **{"resolution": 4} | options)


def test_parallel_directions_and_a_foreign_origin_are_refused():
    with pytest.raises(ValueError, match="parallel"):
        Plane.span(torch.zeros(3), torch.tensor([[1.0, 2, 3], [2.0, 4, 6]]), resolution=4)
    with pytest.raises(ValueError, match=r"shape \(4,\); got shape \(3,\)"):
        Plane.through(SPACE, torch.zeros(3), ["x"], resolution=4)
    with pytest.raises(ValueError, match="spread"):
        Plane.principal(torch.outer(torch.arange(5.0), torch.ones(3)), resolution=4)
