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


WIDE = ParameterSpace(("x", "y"), SPACE.lower, torch.tensor([1.0, 199.0]).double(), ("m", "m"))


@pytest.mark.parametrize(
    ("one", "other", "how", "spearman", "cosine", "opposing", "ratio", "largest"),
    [
        (bowl, lambda x: bowl(x) + 0.5, {}, 1.0, 1.0, 0.0, 1.0, 0.5),
        (bowl, lambda x: 3 * bowl(x), {}, 1.0, 1.0, 0.0, 3.0, 4.0),
        (bowl, lambda x: -bowl(x), {"resolution": 17}, -1.0, -1.0, 288 / 289, 1.0, 4.0),  # both are zero at the bottom
        (lambda x: x[0], lambda x: x[1], {}, 0.0, 0.0, None, 1.0, 2.0),
        (lambda x: x[0] + x[1] / 100, lambda x: x[0] - x[1] / 100, {"space": WIDE}, None, 0.0, None, 1.0, 3.98),
        # Two valleys disagree between their bottoms: at -0.3, -0.2, ..., 0.3 of 21 columns.
        (lambda x: (x[0] + 0.35) ** 2, lambda x: (x[0] - 0.35) ** 2, {}, None, 1.0, 7 / 21, None, 1.4),
        (lambda x: (x[0] + 0.35) ** 2, lambda x: (x[0] - 0.35) ** 2, {"dims": ("x",)}, None, 1.0, 7 / 21, None, 1.4),
    ],
    ids=["constant", "factor", "upside down", "two axes", "sides count as one", "two valleys", "line"],
)
def test_differences_order_and_gradients_are_those_of_functions_that_are_known(
    one, other, how, spearman, cosine, opposing, ratio, largest
) -> None:
    found = compare(one, other, **how)
    told = (found.spearman, found.slopes.cosine, found.slopes.opposing, found.slopes.ratio, found.loss.largest)
    for estimate, wanted in zip(told, (spearman, cosine, opposing, ratio, largest), strict=True):
        assert wanted is None or estimate.value == pytest.approx(wanted, abs=1e-4)


def test_a_comparison_says_where_and_by_how_much_slices_part() -> None:
    found = compare(bowl, lambda x: 3 * bowl(x))
    assert found.points == found.compared == 441
    assert found.loss.range == pytest.approx(2.0)
    assert (found.slopes.ratio.low, found.slopes.ratio.high) == (pytest.approx(3.0), pytest.approx(3.0))
    assert {name: abs(at) for name, at in found.parting.place.items()} == {"x [m]": 1.0, "y [m]": 1.0}
    assert (found.parting.a, found.parting.b) == (pytest.approx(2.0), pytest.approx(6.0))
    valleys = compare(lambda x: (x[0] + 0.35) ** 2, lambda x: (x[0] - 0.35) ** 2)
    between = np.abs(valleys.cosine["u"]) < 0.35
    np.testing.assert_allclose(valleys.cosine, np.tile(np.where(between, -1.0, 1.0), (21, 1)))
    np.testing.assert_allclose(valleys.difference, np.tile(-1.4 * valleys.data[0]["u"], (21, 1)), atol=1e-12)
    assert valleys.loss.median.value == pytest.approx(1.4 * 0.5)


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
    assert compare(failing(bowl), failing(bowl)).statuses == ()
    nothing = compare(bowl, lambda x: bowl(x) * torch.nan)
    assert (nothing.compared, nothing.parting) == (0, None)
    record = to_json(nothing)
    assert record["loss"]["median"]["value"] is record["spearman"]["value"] is record["parting"] is None
    assert json.loads(json.dumps(record, allow_nan=False)) == record


def test_the_same_a_flat_and_a_slice_without_gradients_have_less_to_say() -> None:
    one = cut(bowl)
    same = compare_slices(one, one)
    assert (same.loss.largest.value, same.differing, same.statuses, same.a) == (0.0, {}, (), same.b)
    flat = compare(lambda x: 0 * x[0], bowl)
    assert np.isnan([flat.spearman.value, flat.loss.shares["median"].value]).all()
    assert flat.slopes.ratio.value == np.inf
    assert to_json(flat)["slopes"]["ratio"]["value"] is None
    alone = compare_slices(one, cut(bowl, grad=False))
    assert alone.slopes is alone.cosine is to_json(alone)["slopes"] is None
    assert "gradients" not in "".join(alone.table().index)
    assert alone.differing == {"gradients": ("True", "False")}


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


OTHER = ParameterSpace(("x", "z"), SPACE.lower, SPACE.upper, ("m", "m"))
LARGER = ParameterSpace(("x", "y", "z"), torch.zeros(3).double(), torch.ones(3).double(), ("m", "m", "m"))
PLANES = "give the name of an environment as B"


@pytest.mark.parametrize(
    ("a", "b", "said"),
    [
        ({}, {"resolution": 20}, f"A has 21 x 21 and B 20 x 20.*{PLANES}"),
        ({}, {"window": (-0.5, 1.0)}, f"lower ends differ: number 0 is -1 in A and -0.5 in B.*{PLANES}"),
        ({}, {"dims": ("y", "x")}, f"directions differ: A is along x, y and B is along y, x.*{PLANES}"),
        ({}, {"dims": ("x",)}, f"A has 21 x 21 and B 21.*{PLANES}"),
        ({"dims": ("x",)}, {"dims": ("x",), "at": (0.0, 0.5)}, r"go through differ: number 1 is 0 in A and 0\.5 in B"),
        ({}, {"space": OTHER, "dims": ("x", "z")}, "A has y where B has z"),
        ({}, {"space": LARGER, "at": (0.5, 0.5, 0.5)}, "A has 2 of them where B has 3"),
    ],
)
def test_slices_of_other_planes_and_spaces_are_refused(a, b, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        compare_slices(cut(bowl, **a), cut(bowl, **b))


def test_other_units_and_samples_that_are_missing_are_refused() -> None:
    one = cut(bowl)
    with pytest.raises(ValueError, match="A's is none and B's m,"):
        compare_slices(one, one.assign(loss=one["loss"].assign_attrs(units="m")))
    status = one["status"].copy(deep=True)
    status.data[0, :3] = Status.MISSING
    with pytest.raises(ValueError, match="3 samples of B are missing"):
        compare_slices(one, one.assign(status=status))
