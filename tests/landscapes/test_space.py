import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

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
