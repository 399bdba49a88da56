"""Parameters on a logarithmic scale: what is computed with, and what is read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from jaxtyping import Float
from matplotlib.axis import Axis
from torch import Tensor

import gradscape as gs
from gradscape.jobs.scene import named_point
from gradscape.landscapes.draw.figures.contour import landscape_figure
from gradscape.landscapes.draw.figures.profile import profile_figure
from gradscape.landscapes.draw.figures.sweep import Sweep
from gradscape.landscapes.draw.pages.nodes import read_off_nodes
from gradscape.landscapes.draw.render.relief import Relief
from gradscape.landscapes.draw.style import Scale, decades, write_power
from gradscape.landscapes.export import frame
from gradscape.landscapes.identity import StoreMismatchError
from gradscape.landscapes.overlay import overlay, principal_plane
from gradscape.landscapes.plane import Plane

BEST = 1e3, 2.0


class Spring(gs.Environment):
    """A loss that is a bowl over the decades of k and over c, with its minimum at BEST."""

    name: ClassVar[str] = "scaled-spring"
    loss_unit: ClassVar[str] = "J"
    space: gs.ParameterSpace = gs.ParameterSpace({"k": gs.log(1e-2, 1e6, "N/m"), "c": (0, 5, "N s/m")})

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> gs.Evaluation:
        k, c = x.unbind(-1)
        decade = (k / BEST[0]).log10()
        by_value = torch.stack([2 * decade / (k * np.log(10)), 2 * (c - BEST[1])], dim=-1)
        loss = decade**2 + (c - BEST[1]) ** 2
        return gs.Evaluation.from_results(loss, by_value if grad else None)


class LinearSpring(Spring):
    """The same on a linear scale."""

    space = gs.ParameterSpace({"k": (1e-2, 1e6, "N/m"), "c": (0, 5, "N s/m")})


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def map_of_spring(tmp_path_factory: pytest.TempPathFactory) -> gs.Slice:
    return gs.slice(Spring(), resolution=(9, 6), out=tmp_path_factory.mktemp("spring") / "slice")


def labels_of(axis: Axis) -> list[str]:
    low, high = sorted(axis.get_view_interval())
    return [one.label1.get_text() for one in axis.get_major_ticks() if low <= one.get_loc() <= high]


def test_a_slice_has_logarithms_for_coordinates_and_values_in_what_is_read(map_of_spring: gs.Slice) -> None:
    cut = map_of_spring
    assert cut.data["u"].to_numpy().tolist() == list(range(-2, 7))
    assert cut.data["u"].attrs == {"label": "k [N/m]", "long_name": "k", "scale": "log10", "units": "N/m"}
    assert "scale" not in cut.data["v"].attrs
    np.testing.assert_allclose(cut.slope[..., 0], 2 * (cut.data["u"].to_numpy() - 3) * np.ones((6, 1)), atol=1e-12)
    (lowest,) = cut.minima().to_dict("records")
    assert (lowest["k [N/m]"], lowest["c [N s/m]"]) == BEST
    table = frame(cut.data)
    assert sorted(set(table["k [N/m]"])) == [10.0**power for power in range(-2, 7)]
    assert list(table)[-2:] == ["gradient by log10 k [J]", "gradient by c [J/(N s/m)]"]


def test_a_slice_that_is_opened_again_keeps_the_scales(map_of_spring: gs.Slice) -> None:
    assert map_of_spring.folder is not None
    again = gs.open_slice(map_of_spring.folder)
    assert again.plane.scales == ("log10", "linear")
    assert again.identity["scales"] == ["log10", "linear"]
    assert again.data["u"].attrs["scale"] == "log10"
    with pytest.raises(StoreMismatchError, match="scales"):
        gs.slice(LinearSpring(), resolution=(9, 6), out=map_of_spring.folder)


def test_an_identity_of_linear_parameters_says_nothing_of_scales(here: Path) -> None:
    found = gs.slice(LinearSpring(), resolution=2)
    assert "scales" not in found.identity
    assert "scales" not in found.identity["plane"]
    run = gs.optimize(LinearSpring(), "random", budget=2)
    assert "scales" not in run.identity


def test_axes_of_pictures_show_decades(map_of_spring: gs.Slice) -> None:
    figure = landscape_figure(map_of_spring.data)
    figure.draw_without_rendering()
    assert labels_of(figure.axes[1].xaxis) == ["0.01", "1", "100", "10⁴", "10⁶"]
    assert figure.axes[1].get_xlabel() == "k [N/m]"
    assert labels_of(figure.axes[1].yaxis)[0].startswith("0")
    line = gs.slice(Spring(), ("k",), resolution=5, window=(1, 100), out=map_of_spring.folder.parent / "line")  # type: ignore[union-attr]
    figure = profile_figure(line.data)
    figure.draw_without_rendering()
    assert labels_of(figure.axes[-1].xaxis) == ["1", "10", "100"]
    assert figure.axes[-1].xaxis.get_minorticklocs().size > 10
    assert figure.axes[-1].get_ylabel() == "slope of the loss [J/decade]"


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        (1e-2, 1e6, ["0.01", "1", "100", "10⁴", "10⁶"]),
        (1e-12, 1e12, ["10⁻¹⁰", "10⁻⁵", "1", "10⁵", "10¹⁰"]),
        (1, 10, ["1", "2", "5", "10"]),
        (2e5, 9e5, ["2×10⁵", "3×10⁵", "4×10⁵", "5×10⁵", "6×10⁵", "7×10⁵", "8×10⁵", "9×10⁵"]),
        (310, 340, ["310", "320", "330", "340"]),
    ],
)
def test_ticks_are_at_decades_or_at_round_values_where_these_are_few(low: float, high: float, said: list[str]) -> None:
    places = decades(np.log10(low), np.log10(high))
    assert [write_power(place) for place in places] == said
    assert np.log10(low) <= min(places)
    assert max(places) <= np.log10(high)


def test_a_surface_and_a_page_of_the_gallery_have_the_same_decades(map_of_spring: gs.Slice) -> None:
    relief = Relief(map_of_spring.plane, Scale.between(0, 1))
    places, _ = relief.ticks(0)
    assert [relief.write(0, place) for place in places] == ["0.01", "1", "100", "10⁴", "10⁶"]
    across, up = read_off_nodes(map_of_spring.data, [], [])["axes"]
    assert (across["logarithmic"], up["logarithmic"]) == (True, False)
    assert list(across["ticks"]) == [-2, 0, 2, 4, 6]


def test_a_run_searches_decades_and_its_table_and_best_have_values(here: Path) -> None:
    run = gs.optimize(Spring(), "adam", budget=60, out="run")
    again = gs.open_run("run")
    assert again.identity["scales"] == ["log10", "linear"]
    np.testing.assert_allclose(again.best.x, BEST, rtol=0.5)
    values, x = again.table()[["k [N/m]", "c [N s/m]"]].to_numpy(), again.data["x"].to_numpy()
    np.testing.assert_allclose(values, np.stack([10 ** x[:, 0], x[:, 1]], axis=1), rtol=1e-12)
    summary = json.loads(Path("run/summary.json").read_text())
    assert summary["best"]["x"] == run.best.x.tolist() == again.best.x.tolist()


def test_runs_are_laid_over_slices_of_their_own_scale_alone(map_of_spring: gs.Slice, here: Path) -> None:
    ours, other = (gs.optimize(env, "random", budget=8, out=type(env).__name__) for env in (Spring(), LinearSpring()))
    (laid,) = overlay(map_of_spring.data, [ours.data])
    np.testing.assert_allclose(laid["u"], ours.data["x"][:, 0], atol=1e-12)
    with pytest.raises(ValueError, match="on the scales linear, linear, the slice has log10, linear"):
        overlay(map_of_spring.data, [other.data])
    plane = principal_plane([ours.data], resolution=3)
    assert plane.scales == ("linear", "linear")
    assert ((plane.origin >= Spring.space.lower) & (plane.origin <= Spring.space.upper)).all()


def test_points_in_files_and_tables_are_values(here: Path) -> None:
    Path("point.json").write_text("[1e3, 2]")
    Path("points.csv").write_text("k,c,loss\n1e2,1,5\n1000,2,0\n")
    env = Spring()
    for text in ("point.json", "points.csv", "points.csv:3"):
        assert named_point(env, text).tolist() == [3, 2]
    Path("zero.json").write_text("[0, 2]")
    with pytest.raises(ValueError, match="k is on a logarithmic scale and takes positive values; got 0"):
        named_point(env, "zero.json")


def test_an_extent_is_of_values_and_a_share_of_decades() -> None:
    center, how = Spring.space.center, {"resolution": 3}
    plane = Plane.through(Spring.space, center, ("k", "c"), window=([1e-1, 0.0], [1e3, 1.0]), **how)
    assert torch.stack([plane.lower, plane.upper]).tolist() == [[-1, 0], [3, 1]]
    assert plane.to_values(plane.upper).tolist() == [1e3, 1]
    assert Plane.through(Spring.space, center, ("k",), window=0.5, **how).upper.tolist() == [4]
    with pytest.raises(ValueError, match="positive values along a logarithmic parameter; got -1"):
        Plane.through(Spring.space, center, ("k",), window=(-1, 1), **how)


def test_a_sweep_over_a_logarithmic_parameter_moves_by_equal_ratios(here: Path) -> None:
    class Damped(Spring):
        name = "scaled-damped"
        space = gs.ParameterSpace({"k": gs.log(1e-2, 1e6), "c": (0, 5), "d": (0, 1)})

        def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> gs.Evaluation:
            loss = x[:, 0].log10().square() + x[:, 1:].square().sum(dim=1)
            return gs.Evaluation.from_results(loss, torch.zeros_like(x) if grad else None)

    found: Sweep = gs.sweep(Damped(), ("c", "d"), "k", frames=3, resolution=2)
    np.testing.assert_allclose(found.values, [1e-2, 1e2, 1e6], rtol=1e-12)
    assert found.write_value(1e6) == "1e+06"
    assert [float(one["loss"].min()) for one in found.slices] == [4, 4, 36]


def test_two_slices_on_other_scales_are_not_compared(map_of_spring: gs.Slice) -> None:
    with pytest.raises(ValueError, match="A has log10 k where B has k"):
        gs.compare(map_of_spring, LinearSpring())


def test_one_or_two_parameters_need_no_dims(map_of_spring: gs.Slice) -> None:
    assert map_of_spring.plane.names == ("k", "c")
    one: Any = gs.from_torch(lambda x: x.square().sum(dim=1), gs.ParameterSpace({"k": (0, 1)}))
    assert gs.slice(one, resolution=3).plane.names == ("k",)
    three: Any = gs.from_torch(lambda x: x.square().sum(dim=1), gs.ParameterSpace.box(["a", "b", "c"], 0, 1))
    with pytest.raises(ValueError, match=r"one or two parameters.*or --along"):
        gs.slice(three, resolution=3)
