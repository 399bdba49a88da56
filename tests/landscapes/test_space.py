import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gradscape.landscapes.plane import Plane
from gradscape.landscapes.space import ParameterSpace

SPACE = ParameterSpace(
    ("speed", "angle"), torch.tensor([-2.0, 0.0]).double(), torch.tensor([4.0, 0.5]).double(), ("m/s", "")
)
FEW = settings(max_examples=40)


@FEW
@given(st.lists(st.floats(0, 1), min_size=2, max_size=2))
def test_the_unit_cube_and_the_box_map_onto_each_other(u):
    unit = torch.tensor(u, dtype=torch.float64)
    torch.testing.assert_close(SPACE.to_unit(SPACE.from_unit(unit)), unit, rtol=0, atol=1e-14)
    assert (SPACE.from_unit(torch.zeros(2).double()) == SPACE.lower).all()


def test_a_seed_draws_the_same_points_again_and_inside_the_box():
    points = SPACE.uniform(500, seed=3)
    assert torch.equal(points, SPACE.uniform(500, seed=3))
    assert not torch.equal(points, SPACE.uniform(500, seed=4))
    assert ((points >= SPACE.lower) & (points <= SPACE.upper)).all()


def test_a_parameter_is_found_by_name_by_number_and_by_number_as_text():
    assert [SPACE.index(p) for p in ("angle", 1, "1")] == [1, 1, 1]


@pytest.mark.parametrize(("parameter", "said"), [("sped", "speed, angle"), (2, "0 to 1; got 2"), (-1, "got -1")])
def test_an_unknown_parameter_is_refused_with_what_there_is(parameter, said):
    with pytest.raises(ValueError, match=said):
        SPACE.index(parameter)


def test_axis_labels_carry_the_unit_if_there_is_one():
    assert SPACE.labels == ("speed [m/s]", "angle")


@pytest.mark.parametrize(
    ("names", "lower", "said"),
    [(("a", "a"), [0.0, 0.0], "distinct"), (("a", "b"), [0.0, 1.0], "lower < upper"), (("a",), [0.0, 0.0], "1 names")],
)
def test_a_space_that_makes_no_sense_is_refused(names, lower, said):
    with pytest.raises(ValueError, match=said):
        ParameterSpace(names, torch.tensor(lower).double(), torch.ones(2).double(), ("",) * len(names))


def test_parameters_are_named_with_their_bounds_and_units_in_one_go():
    space = ParameterSpace({"kp": (0, 2, "N/m"), "kd": (-1, 0.5), "n": np.array([1.0, 3.0])})
    assert (space.names, space.units) == (("kp", "kd", "n"), ("N/m", "", ""))
    assert space.lower.tolist() == [0, -1, 1]
    assert space.upper.tolist() == [2, 0.5, 3]
    assert space.lower.dtype == torch.float64


@pytest.mark.parametrize("kind", [list, tuple, np.array, torch.tensor])
def test_bounds_are_lists_arrays_or_tensors(kind):
    space = ParameterSpace(["a", "b"], kind([0, 1]), kind([2, 3]))
    assert (space.lower.tolist(), space.upper.tolist(), space.units) == ([0, 1], [2, 3], ("", ""))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (({"a": 1.0},), "parameter 'a' needs"),
        (({"a": (1.0,)},), r"parameter 'a' needs \(lower, upper\)"),
        (({"a": "01"},), "parameter 'a' needs"),
        (({"a": (0, 1)}, [0], [1]), "got both"),
        (({},), "distinct names; got none"),
        (("ab", [0, 0], [1, 1]), "takes names"),
        ((["a"],), "takes names, lower and upper bounds"),
        ((["a"], ["low"], [1]), "ParameterSpace's lower takes numbers"),
        ((["a"], [0], [float("inf")]), "finite lower < upper for a; got 0 to inf"),
        ((["a"], [0], [float("nan")]), "finite lower < upper for a"),
        ((["a", "b"], [[0], [0]], [1, 1]), r"lower must have as many, got shape \(2, 1\)"),
    ],
)
def test_what_is_no_space_is_refused_by_name(given, said):
    with pytest.raises(ValueError, match=said):
        ParameterSpace(*given)


def test_planes_go_through_lists_and_arrays_too():
    for point in ([1.0, 0.25], (1.0, 0.25), np.array([1.0, 0.25]), torch.tensor([1.0, 0.25])):
        plane = Plane.through(SPACE, point, ["angle"], resolution=3)
        assert plane.lift(torch.tensor([[0.5]]).double()).tolist() == [[1.0, 0.5]]
    assert Plane.span([0, 0], [[1, 0], [0, 2]], resolution=3).basis.tolist() == [[1, 0], [0, 2]]
