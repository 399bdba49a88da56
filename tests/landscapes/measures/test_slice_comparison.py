"""Two slices compared: functions whose differences, order and gradients are known, and what cannot be compared."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
import torch
import xarray as xr

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.convert import to_json
from gradscape.landscapes.measures.slice_comparison import compare_slices
from gradscape.landscapes.objective import Status
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.space import ParameterSpace

SPACE = ParameterSpace(("x", "y"), torch.tensor([-1.0, -1.0]).double(), torch.tensor([1.0, 1.0]).double(), ("m", "m"))
Function = Callable[[torch.Tensor], torch.Tensor]


def cut(function: Function, *, dims=("x", "y"), resolution: int = 21, space=SPACE, window=None, grad=True, at=None):
    point = SPACE.center if at is None else torch.tensor(at).double()
    plane = Plane.through(space, point, dims, resolution=resolution, window=window)
    return sample(from_torch(lambda x: function(x.T), space), plane, gradients=int(grad))


def bowl(x: torch.Tensor) -> torch.Tensor:
    return x[0] ** 2 + x[1] ** 2


def compare(one: Function, other: Function, **how):
    return compare_slices(cut(one, **how), cut(other, **how))


def test_a_constant_changes_losses_alone() -> None:
    found = compare(bowl, lambda x: bowl(x) + 0.5)
    assert found.points == found.compared == 441
    for value in (found.loss.median.value, found.loss.p95.value, found.loss.largest.value):
        assert value == pytest.approx(0.5)
    assert found.loss.range == pytest.approx(2.0)
    assert found.loss.shares["p95"].value == pytest.approx(0.25)
    assert found.spearman.value == pytest.approx(
        1.0, abs=1e-4
    )  # losses that are the same but for rounding change ranks
    assert (found.slopes.cosine.value, found.slopes.opposing.value) == (pytest.approx(1.0), 0.0)
    assert found.slopes.ratio.value == 1.0


def test_a_factor_changes_lengths_and_not_directions_and_parts_in_a_corner() -> None:
    found = compare(bowl, lambda x: 3 * bowl(x))
    assert found.slopes.ratio.value == pytest.approx(3.0)
    assert (found.slopes.ratio.low, found.slopes.ratio.high) == (pytest.approx(3.0), pytest.approx(3.0))
    assert found.spearman.value == pytest.approx(1.0)
    assert {abs(value) for value in found.parting.place.values()} == {1.0}
    assert set(found.parting.place) == {"x [m]", "y [m]"}
    assert (found.parting.a, found.parting.b) == (pytest.approx(2.0), pytest.approx(6.0))
    assert found.loss.largest.value == pytest.approx(4.0)


def test_a_bowl_upside_down_reverses_order_and_gradients() -> None:
    found = compare(bowl, lambda x: -bowl(x), resolution=17)
    assert found.spearman.value == pytest.approx(-1.0)
    assert found.slopes.cosine.value == pytest.approx(-1.0)
    assert found.slopes.opposing.value == pytest.approx(288 / 289)  # at the bottom both are zero, and agree
    np.testing.assert_allclose(found.cosine.sel(u=0, v=0), 1.0)


def test_slopes_along_two_axes_have_nothing_to_do_with_each_other() -> None:
    found = compare(lambda x: x[0], lambda x: x[1])
    assert found.spearman.value == pytest.approx(0.0, abs=1e-12)
    assert found.slopes.cosine.value == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(found.difference, found.data[0]["v"] - found.data[0]["u"], atol=1e-12)
    assert found.loss.largest.value == pytest.approx(2.0)


def test_two_valleys_disagree_between_their_bottoms() -> None:
    found = compare(lambda x: (x[0] + 0.35) ** 2, lambda x: (x[0] - 0.35) ** 2)
    assert found.slopes.opposing.value == pytest.approx(7 / 21)  # -0.3, -0.2, ..., 0.3 of 21 columns
    between = np.abs(found.cosine["u"]) < 0.35
    np.testing.assert_allclose(found.cosine, np.tile(np.where(between, -1.0, 1.0), (21, 1)))
    np.testing.assert_allclose(found.difference, np.tile(-1.4 * found.data[0]["u"], (21, 1)), atol=1e-12)
    assert found.loss.median.value == pytest.approx(1.4 * 0.5)


def test_sides_of_the_plane_count_as_one() -> None:
    wide = ParameterSpace(("x", "y"), SPACE.lower, torch.tensor([1.0, 199.0]).double(), ("m", "m"))
    found = compare(lambda x: x[0] + x[1] / 100, lambda x: x[0] - x[1] / 100, space=wide, window=None)
    np.testing.assert_allclose(found.cosine, 0.0, atol=1e-12)


def test_on_a_line_gradients_agree_or_oppose() -> None:
    found = compare(lambda x: (x[0] + 0.35) ** 2, lambda x: (x[0] - 0.35) ** 2, dims=("x",))
    assert found.slopes.opposing.value == pytest.approx(7 / 21)
    assert found.difference.dims == ("u",)
    assert {abs(value) for value in found.parting.place.values()} == {1.0}


def test_intervals_hold_what_blocks_of_the_plane_say_and_the_same_everywhere_is_certain() -> None:
    found = compare(bowl, lambda x: bowl(x) + 0.1 * torch.sin(9 * x[0] + 4 * x[1]))
    for one in (found.loss.median, found.loss.p95, found.spearman):
        assert one.low < one.value < one.high
    assert found.spearman.high <= 1.0
    same = compare(bowl, lambda x: bowl(x) + 0.5).loss.median
    assert same.low == pytest.approx(same.high)


def failing(function: Function) -> Function:
    return lambda x: torch.where(x[0] > 0.75, torch.nan, function(x))


def test_what_failed_is_counted_and_compared_nowhere() -> None:
    found = compare(bowl, failing(lambda x: bowl(x) + 1))
    assert found.compared == 441 - 3 * 21
    (pair,) = found.statuses
    assert (pair.a, pair.b, pair.points) == ("ok", "nonfinite", 63)
    assert found.loss.largest.value == pytest.approx(1.0)
    assert found.slopes.cosine.value == pytest.approx(1.0)
    assert np.isnan(found.cosine.sel(u=1.0)).all()
    both = compare(failing(bowl), failing(bowl))
    assert both.statuses == ()


def test_where_nothing_is_left_nothing_is_said() -> None:
    found = compare(bowl, lambda x: bowl(x) * torch.nan)
    assert (found.compared, found.parting) == (0, None)
    record = to_json(found)
    assert record["loss"]["median"]["value"] is record["spearman"]["value"] is record["parting"] is None
    assert json.loads(json.dumps(record, allow_nan=False)) == record


def test_the_same_slice_twice_differs_nowhere() -> None:
    one = cut(bowl)
    found = compare_slices(one, one)
    assert (found.loss.largest.value, found.differing, found.statuses) == (0.0, {}, ())
    assert found.a == found.b


def test_a_flat_slice_has_no_order_and_no_range() -> None:
    found = compare(lambda x: 0 * x[0], bowl)
    assert np.isnan(found.spearman.value)
    assert np.isnan(found.loss.shares["median"].value)
    assert found.slopes.ratio.value == np.inf
    assert to_json(found)["slopes"]["ratio"]["value"] is None


def test_without_gradients_losses_alone_are_compared() -> None:
    found = compare_slices(cut(bowl), cut(bowl, grad=False))
    assert found.slopes is None
    assert "gradients" not in "".join(found.table().index)
    assert to_json(found)["slopes"] is None
    assert found.differing == {"gradients": ("True", "False")}
    assert found.cosine is None


def interpolated(dataset: xr.Dataset, stride: int) -> xr.Dataset:
    """Return a slice of which every so manyth sample is evaluated."""
    status, loss = dataset["status"].copy(deep=True), dataset["loss"].copy(deep=True)
    kept = np.zeros(status.shape, bool)
    kept[::stride, ::stride] = True
    status.data[~kept], loss.data[~kept] = Status.INTERPOLATED, np.nan
    return dataset.assign(status=status, loss=loss)


def test_of_refined_slices_the_lattice_is_compared_that_both_have() -> None:
    one, other = cut(bowl, resolution=17), cut(lambda x: 2 * bowl(x), resolution=17)
    found = compare_slices(interpolated(one, 2), interpolated(other, 4))
    assert found.points == found.compared == 25
    assert found.statuses == ()
    assert found.slopes.ratio.value == pytest.approx(2.0)


def labelled(dataset: xr.Dataset, **changes) -> xr.Dataset:
    return dataset.assign_attrs(identity=json.dumps(json.loads(dataset.attrs["identity"]) | changes))


def test_names_tell_the_two_apart_and_settings_that_differ_are_named() -> None:
    one = labelled(cut(bowl), objective="fluid", fidelity="draft", options={"goal": "printed", "walls": 0.1})
    other = labelled(one, options={"goal": "easy", "walls": 0.1}, cut={"along": "pca:run"})
    found = compare_slices(one, other)
    assert found.differing == {"options.goal": ("'printed'", "'easy'")}
    assert found.settings() == ["options.goal: 'printed' in A, 'easy' in B"]
    alone = compare_slices(one, labelled(one, options={"goal": "printed", "drag": 0.0}))
    assert alone.settings() == ["only A has options.walls", "only B has options.drag"]
    assert (found.a, found.b) == ("fluid · draft · goal printed", "fluid · draft · goal easy")
    finer = compare_slices(one, labelled(one, fidelity="standard", model_version=2))
    assert (finer.a, finer.b) == ("fluid · draft", "fluid · standard")
    assert set(finer.differing) == {"fidelity", "model_version"}
    newer = other.assign_attrs(provenance=json.dumps({"versions": {"torch": "9.0"}}))
    assert compare_slices(other, newer).differing["versions.torch"][1] == "'9.0'"


def test_a_table_has_a_row_for_each_number() -> None:
    table = compare(bowl, lambda x: bowl(x) + 0.5).table()
    assert table.index.is_unique
    assert table.loc["median difference, relative", "value"] == pytest.approx(0.25)
    assert table.loc["loss in both", "value"] == 1.0


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"resolution": 20}, "A has 21 x 21 and B 20 x 20"),
        ({"window": (-0.5, 1.0)}, "lower ends differ: number 0 is -1 in A and -0.5 in B"),
        ({"dims": ("y", "x")}, "directions differ: A is along x, y and B is along y, x"),
        ({"dims": ("x",)}, "A has 21 x 21 and B 21"),
    ],
)
def test_slices_of_other_planes_are_refused(how: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=f"{said}.*give the name of an environment as B"):
        compare_slices(cut(bowl), cut(bowl, **how))


def test_lines_through_other_points_and_other_spaces_are_refused() -> None:
    with pytest.raises(ValueError, match=r"points they go through differ: number 1 is 0 in A and 0\.5 in B"):
        compare_slices(cut(bowl, dims=("x",)), cut(bowl, dims=("x",), at=(0.0, 0.5)))
    other = ParameterSpace(("x", "z"), SPACE.lower, SPACE.upper, ("m", "m"))
    with pytest.raises(ValueError, match="A has y where B has z"):
        compare_slices(cut(bowl), cut(bowl, space=other, dims=("x", "z")))
    larger = ParameterSpace(("x", "y", "z"), torch.zeros(3).double(), torch.ones(3).double(), ("m", "m", "m"))
    three = cut(bowl, space=larger, at=(0.5, 0.5, 0.5))
    with pytest.raises(ValueError, match="A has 2 of them where B has 3"):
        compare_slices(cut(bowl), three)


def test_other_units_and_samples_that_are_missing_are_refused() -> None:
    one = cut(bowl)
    metres = one.assign(loss=one["loss"].assign_attrs(units="m"))
    with pytest.raises(ValueError, match="A's is none and B's m,"):
        compare_slices(one, metres)
    status = one["status"].copy(deep=True)
    status.data[0, :3] = Status.MISSING
    with pytest.raises(ValueError, match="3 samples of B are missing"):
        compare_slices(one, one.assign(status=status))
