import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gradscape.landscapes.space import ParameterSpace, log

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


@pytest.mark.parametrize(("parameter", "said"), [("sped", "speed, angle"), (2, "0 to 1; got 2"), (-1, "got -1")])
def test_a_parameter_is_found_by_name_and_number_and_an_unknown_one_refused_with_what_there_is(parameter, said):
    assert [SPACE.index(p) for p in ("angle", 1, "1")] == [1, 1, 1]
    with pytest.raises(ValueError, match=said):
        SPACE.index(parameter)


def test_parameters_are_named_with_their_bounds_and_units_in_one_go():
    space = ParameterSpace({"kp": (0, 2, "N/m"), "kd": (-1, 0.5), "n": np.array([1.0, 3.0])})
    assert (space.names, space.units) == (("kp", "kd", "n"), ("N/m", "", ""))
    assert space.lower.tolist() == [0, -1, 1]
    assert space.upper.tolist() == [2, 0.5, 3]
    assert space.lower.dtype == torch.float64


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
        ((["a", "a"], [0, 0], [1, 1]), "distinct"),
        ((["a", "b"], [0, 1], [1, 1]), "lower < upper"),
        ((["a"], [0, 0], [1, 1]), "1 names"),
        ((["a"], [0], [float("inf")]), "finite lower < upper for a; got 0 to inf"),
        ((["k"], [0], [1], None, ["log10"]), "lower > 0 for k, whose scale is log10; got 0 to 1"),
        ((["k"], [1], [2], None, ["log"]), "scales linear and log10; got 'log' for k"),
        ((["k"], [1], [2], None, []), "scales must have as many"),
        ((["a", "b"], [[0], [0]], [1, 1]), r"lower must have as many, got shape \(2, 1\)"),
    ],
)
def test_what_is_no_space_is_refused_by_name(given, said):
    with pytest.raises(ValueError, match=said):
        ParameterSpace(*given)


DECADES = ParameterSpace({"k": log(1e-2, 1e6, "N/m"), "c": (0, 5)})


def test_a_logarithmic_parameter_is_bounded_by_its_logarithm_and_labelled_by_its_value():
    assert (DECADES.scales, DECADES.units) == (("log10", "linear"), ("N/m", ""))
    assert DECADES.lower.tolist() == [-2, 0]
    assert DECADES.upper.tolist() == [6, 5]
    assert DECADES.to_values(DECADES.center).tolist() == [100, 2.5]
    assert DECADES.labels == ("k [N/m]", "c")
    assert DECADES.scaled_labels == ("log10 k [N/m]", "c")
    listed = ParameterSpace(["k", "c"], [1e-2, 0], [1e6, 5], ["N/m", ""], ["log10", "linear"])
    assert torch.equal(listed.lower, DECADES.lower)
    assert listed.scales == DECADES.scales


@FEW
@given(st.lists(st.tuples(st.floats(-2, 6), st.floats(0, 5)), min_size=1, max_size=7))
def test_points_and_values_turn_into_each_other_and_no_row_depends_on_the_others(rows):
    x = torch.tensor(rows, dtype=torch.float64)
    values = DECADES.to_values(x)
    torch.testing.assert_close(DECADES.from_values(values), x, rtol=0, atol=1e-14)
    assert torch.equal(values[:, 1], x[:, 1])
    assert torch.equal(torch.stack([DECADES.to_values(row) for row in x]), values)


@FEW
@given(st.integers(1, 10**9), st.integers(-30, 20))
def test_a_bound_comes_back_as_it_was_given(digits, exponent):
    bound = float(f"{digits}e{exponent}")
    space = ParameterSpace({"k": log(bound / 1024, bound)})
    assert float(space.to_values(space.upper)) == bound


def test_the_chain_rule_gives_what_differences_along_the_scale_do():
    x, step = torch.tensor([[1.5, 2.0], [-2.0, 0.5]], dtype=torch.float64), 1e-6

    def loss(x):
        k, c = DECADES.to_values(x).unbind(-1)
        return (k + 1).sqrt() * c

    k, c = DECADES.to_values(x).unbind(-1)
    grad = DECADES.chain(torch.stack([k, c], -1), torch.stack([c / (k + 1).sqrt() / 2, (k + 1).sqrt()], -1))
    steps = step * torch.eye(2, dtype=torch.float64)
    differences = torch.stack([(loss(x + one) - loss(x - one)) / (2 * step) for one in steps], -1)
    torch.testing.assert_close(grad, differences, rtol=1e-8, atol=1e-8)


def test_points_of_a_logarithmic_parameter_are_spread_evenly_over_its_decades():
    values = DECADES.to_values(DECADES.sobol(1024, seed=0))[:, 0]
    counts = torch.histc(values.log10(), bins=8, min=-2, max=6)
    torch.testing.assert_close(counts, torch.full((8,), 128.0).double(), rtol=0, atol=2)


def test_a_linear_space_costs_nothing():
    x = SPACE.center
    assert SPACE.is_linear
    assert SPACE.labels == ("speed [m/s]", "angle")
    assert all(found is x for found in (SPACE.to_values(x), SPACE.from_values(x), SPACE.chain(SPACE.upper, x)))


@pytest.mark.parametrize("ends", [(0, 1), (-1, 1), (2, 1), (1, 1), (1, float("inf")), (float("nan"), 1)])
def test_a_logarithmic_parameter_is_refused_without_positive_ascending_bounds(ends):
    with pytest.raises(ValueError, match="0 < lower < upper; got"):
        log(*ends)


def test_a_value_that_has_no_logarithm_is_refused_with_the_parameter():
    with pytest.raises(ValueError, match="k is on a logarithmic scale and takes positive values; got -3"):
        DECADES.from_values(torch.tensor([[1.0, -3.0], [-3.0, 1.0]]))
