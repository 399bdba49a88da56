import itertools
import os
import threading

import numpy as np
import pytest
import torch
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm
from matplotlib.image import imread
from matplotlib.quiver import Quiver

from gradscape.landscapes.draw import style
from gradscape.landscapes.draw.figures import page
from gradscape.landscapes.draw.figures.contour import landscape_figure
from gradscape.landscapes.draw.figures.profile import profile_figure
from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.store import SliceStore

SPACE = ParameterSpace(
    ("speed", "lift", "mass"),
    torch.tensor([-1.0, 0, 0]).double(),
    torch.tensor([1.0, 50, 1]).double(),
    ("m/s", "m", ""),
)


class Bowl(Objective):
    """A bowl with a flat corner, a corner that is not finite and one that escapes."""

    space = SPACE
    name = "bowl"

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        unit = self.space.to_unit(x)
        loss, gradient = x[:, 0] ** 2 + 0.01 * x[:, 1], torch.stack([2 * x[:, 0], 0 * x[:, 1] + 0.01, 0 * x[:, 2]], 1)
        gradient[(unit[:, :2] < 0.25).all(dim=1)] = 0
        loss[(unit[:, :2] > 0.75).all(dim=1)] = torch.nan
        escaped = (unit[:, 0] < 0.25) & (unit[:, 1] > 0.75)
        return Evaluation.from_results(
            loss, gradient if grad else None, torch.where(escaped, Status.ESCAPED, Status.OK)
        )


def plane(*resolution: int, dims: tuple[str, ...] = ("speed", "lift")) -> Plane:
    return Plane.through(SPACE, SPACE.center, dims, resolution=resolution)


DATASET = sample(Bowl(), plane(16, 12))
FIGURE = landscape_figure(DATASET)
TOP, BOTTOM = FIGURE.axes[:2]


def quiver_of(figure) -> Quiver:
    return next(c for c in figure.axes[1].collections if isinstance(c, Quiver))


def mesh_of(figure) -> QuadMesh:
    return next(c for c in figure.axes[0].collections if isinstance(c, QuadMesh))


def legend_of(figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def patches_of(axes) -> dict[str, object]:
    return {patch.get_gid(): patch for patch in axes.patches if patch.get_gid()}


def arrows_in_pixels(figure) -> np.ndarray:
    quiver = quiver_of(figure)
    transform = figure.axes[1].transData.transform
    return transform(quiver.XY + np.stack([quiver.U, quiver.V], axis=1)) - transform(quiver.XY)


def test_arrows_are_equally_long_in_the_picture_and_point_down_its_steepest_slope():
    """Across an arrow the loss does not change: in the picture it is perpendicular to the contour, downhill."""
    for resolution in ((4, 4), (40, 9), (16, 12)):
        figure = landscape_figure(sample(Bowl(), plane(*resolution)))
        figure.draw_without_rendering()
        quiver, arrows = quiver_of(figure), arrows_in_pixels(figure)
        lengths = np.linalg.norm(arrows, axis=1)
        np.testing.assert_allclose(lengths, lengths[0], rtol=1e-6)
        assert lengths[0] > 5
        slope = np.stack([2 * quiver.X, np.full_like(quiver.X, 0.01)], axis=1)
        to_data = np.linalg.inv(figure.axes[1].transData.get_matrix()[:2, :2])
        along, across = arrows @ to_data.T, (arrows @ [[0, 1], [-1, 0]]) @ to_data.T
        assert ((along * slope).sum(axis=1) < 0).all()
        np.testing.assert_allclose((across * slope).sum(axis=1), 0, atol=1e-12)


def test_colour_is_the_magnitude_of_the_gradient_per_width_of_the_box_when_units_differ():
    quiver = quiver_of(FIGURE)
    wanted = np.log10(np.hypot(2 * 2 * quiver.X, 50 * 0.01))
    np.testing.assert_allclose(quiver.get_array(), wanted, atol=1e-12)
    assert "per width of the box" in FIGURE.axes[3].get_ylabel()


def test_colour_is_the_projected_gradient_in_its_unit_when_units_agree():
    space = ParameterSpace.box(("a", "b"), 0.0, 1.0, "m/s")
    skew = Plane(
        torch.zeros(2).double(), torch.tensor([[2.0, 0], [1.0, 1]]).double(), torch.zeros(2).double(),
        torch.ones(2).double(), (4, 4), ("p [m/s]", "q [m/s]"),
    )  # fmt: skip

    class Ramp(Objective):
        def __init__(self):
            self.space = space

        def evaluate(self, x, *, grad=True):
            return Evaluation.from_results(
                3 * x[:, 0] + 4 * x[:, 1], torch.tensor([3.0, 4.0]).double().expand(len(x), 2)
            )

    figure = landscape_figure(sample(Ramp(), skew))
    np.testing.assert_allclose(quiver_of(figure).get_array(), np.log10(5.0))
    assert figure.axes[3].get_ylabel().endswith("[1/(m/s)]")


def test_failures_are_masked_hatched_and_counted_and_not_interpolated():
    mesh, status = mesh_of(FIGURE), DATASET["status"].to_numpy()
    drawn = np.ma.masked_array(mesh.get_array())
    np.testing.assert_array_equal(np.ma.getmaskarray(drawn), status != Status.OK)
    np.testing.assert_array_equal(drawn.compressed(), DATASET["loss"].values[status == Status.OK])
    for axes in (TOP, BOTTOM):
        patches = patches_of(axes)
        assert set(patches) == {"NONFINITE", "ESCAPED"}
        assert len({patch.get_hatch() for patch in patches.values()}) == 2
        assert patches["NONFINITE"].get_path().contains_point((1.0, 50.0))
        assert patches["ESCAPED"].get_path().contains_point((-1.0, 50.0))
        assert not patches["ESCAPED"].get_path().contains_point((0.0, 25.0))
    said = legend_of(FIGURE)
    for kind, name in ((Status.NONFINITE, "not finite"), (Status.ESCAPED, "outside the domain")):
        assert f"{name}: {(status == kind).sum()} of 192" in said


def test_every_cell_is_centred_on_its_sample():
    corners = mesh_of(FIGURE).get_coordinates()
    np.testing.assert_allclose((corners[0, 1:, 0] + corners[0, :-1, 0]) / 2, DATASET["u"])
    np.testing.assert_allclose((corners[1:, 0, 1] + corners[:-1, 0, 1]) / 2, DATASET["v"])


def test_zero_gradients_are_dots_and_failures_are_neither_dots_nor_arrows():
    (dots,) = (line for line in BOTTOM.lines if line.get_marker() == "o")
    flat = (DATASET["grad"] == 0).all("dim").to_numpy()
    assert len(dots.get_xdata()) == flat.sum() > 0
    assert (np.asarray(dots.get_xdata()) < -0.4).all()
    assert len(quiver_of(FIGURE).U) == (DATASET["status"] == Status.OK).sum() - flat.sum()
    assert f"gradient exactly zero: {flat.sum()} of 192" in legend_of(FIGURE)


class HalfBlind(Bowl):
    """A bowl whose gradient is missing at negative speeds."""

    name = "half blind"

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        missing = x[:, 0] < 0
        gradient = torch.stack([2 * x[:, 0] + 3, 0 * x[:, 1] + 0.01, 0 * x[:, 2]], 1)
        gradient[missing] = torch.nan
        return Evaluation.from_results(x[:, 0] ** 2 + 3 * x[:, 0], gradient if grad else None)


def test_a_loss_without_a_gradient_is_drawn_as_a_value_and_dotted_among_the_arrows_alone():
    dataset = sample(HalfBlind(), plane(16, 12))
    figure = landscape_figure(dataset)
    top, bottom = figure.axes[:2]
    lacking = int((dataset["status"] == Status.NO_GRADIENT).sum())
    assert 0 < lacking < 192
    assert not np.ma.getmaskarray(np.ma.masked_array(mesh_of(figure).get_array())).any()
    assert not patches_of(top)
    assert set(patches_of(bottom)) == {"NO_GRADIENT"}
    assert patches_of(bottom)["NO_GRADIENT"].get_path().contains_point((-0.9, 25.0))
    assert len(quiver_of(figure).U) == 192 - lacking
    assert f"no gradient: {lacking} of 192" in legend_of(figure)
    line = profile_figure(sample(HalfBlind(), plane(9, dims=("speed",))))
    said = legend_of(line)
    assert "no gradient: 4 of 9" in said
    assert not any("not finite" in one for one in said)


def test_the_star_is_on_the_lowest_sample():
    (star,) = (line for line in TOP.lines if line.get_marker() == "*")
    row, column = np.unravel_index(np.nanargmin(DATASET["loss"]), DATASET["loss"].shape)
    assert (star.get_xdata()[0], star.get_ydata()[0]) == (DATASET["u"].values[column], DATASET["v"].values[row])


class Plain(Bowl):
    """One loss everywhere."""

    name = "plain"

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        return Evaluation.from_results(
            torch.full((len(x),), 4.5).double(), torch.zeros_like(x), torch.full((len(x),), 1)
        )


def test_a_plain_has_neither_a_lowest_sample_nor_a_scale_of_gradients():
    figure = landscape_figure(sample(Plain(), plane(5, 5)))
    assert not [line for line in figure.axes[0].lines if line.get_marker() == "*"]
    assert legend_of(figure) == ["every sample: 4.5", "gradient exactly zero: 25 of 25"]
    assert [ax.get_visible() for ax in figure.axes] == [True, True, True, False]


def test_axes_bars_and_title_say_what_is_shown_and_in_which_units():
    assert BOTTOM.get_xlabel() == "speed [m/s]"
    assert TOP.get_ylabel() == BOTTOM.get_ylabel() == "lift [m]"
    assert FIGURE.axes[2].get_ylabel() == "loss"
    assert FIGURE.get_suptitle() == "bowl · 16 \N{MULTIPLICATION SIGN} 12 points"


def test_many_points_keep_few_arrows_but_every_cell():
    figure = landscape_figure(sample(Bowl(), plane(70, 40)))
    for places in (quiver_of(figure).X, quiver_of(figure).Y):
        assert len(np.unique(places)) <= style.ARROWS
    assert mesh_of(figure).get_array().shape == (40, 70)


def test_a_coarse_picture_has_the_axes_of_the_finished_one_and_no_gap():
    store, coarse = SliceStore.in_memory(plane(16, 12), SPACE), []
    sample(Bowl(), plane(16, 12), store, progress=lambda p: coarse.append(store.coarse()) if p.level_complete else None)
    figure = landscape_figure(coarse[0])
    assert figure.axes[0].get_xlim() == TOP.get_xlim()
    assert figure.axes[0].get_ylim() == TOP.get_ylim()
    corners = mesh_of(figure).get_coordinates()
    assert corners.shape == (5, 5, 2)
    assert (corners[0, 0, 0], corners[0, -1, 0]) == TOP.get_xlim()
    assert "16 of 192 points so far" in figure.get_suptitle()


def test_what_is_not_sampled_yet_is_grey_and_counted_as_such():
    store = SliceStore.in_memory(plane(16, 12), SPACE)
    tile = store.tiles()[0]
    store.write(tile, Bowl().evaluate(store.points(tile)))
    figure = landscape_figure(store.dataset())
    patch = patches_of(figure.axes[0])["MISSING"]
    assert patch.get_hatch() is None
    assert len(patch.get_path().to_polygons()) == 192 - 16
    assert "not sampled yet: 176 of 192" in legend_of(figure)


@pytest.mark.parametrize("grad", [True, False])
def test_a_slice_where_everything_failed_is_still_a_picture(tmp_path, grad):
    class Broken(Bowl):
        def evaluate(self, x, *, grad=True):
            nan = torch.full((len(x),), torch.nan).double()
            return Evaluation.from_results(nan, nan[:, None].expand(-1, 3) if grad else None)

    figure = landscape_figure(sample(Broken(), plane(4, 4), gradients=int(grad)))
    page.save(figure, tmp_path / "broken.png")
    assert "not finite: 16 of 16" in legend_of(figure)
    assert sum("lift" in axes.get_ylabel() for axes in figure.axes) == (2 if grad else 1)


def test_losses_over_three_decades_are_on_a_logarithmic_scale_and_an_outlier_does_not_flatten_the_rest():
    assert isinstance(style.Scale.of_loss(np.geomspace(1e-2, 1e3, 50)).norm, LogNorm)
    rest = np.linspace(-1, 1, 999)
    scale = style.Scale.of_loss(np.append(rest, 1e9))
    assert scale.norm.vmax < 1.1
    assert scale.extend == "max"
    flat = style.Scale.of_loss(np.full(9, 2.0))
    assert flat.norm.vmin < 2.0 < flat.norm.vmax


def test_a_file_is_whole_or_not_there(tmp_path, monkeypatch):
    path = tmp_path / "deep" / "picture.png"
    page.save(FIGURE, path)
    assert imread(path).shape[:2] == tuple(round(style.DPI * side) for side in FIGURE.get_size_inches()[::-1])
    before = path.read_bytes()
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        page.save(landscape_figure(sample(Bowl(), plane(4, 4))), path)
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == ["picture.png"]


def test_pictures_drawn_by_two_threads_are_those_drawn_by_one(tmp_path):
    def draw(name: str) -> None:
        page.save(landscape_figure(DATASET), tmp_path / name)

    threads = [threading.Thread(target=draw, args=(f"{n}.png",)) for n in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    draw("alone.png")
    assert len({file.read_bytes() for file in tmp_path.iterdir()}) == 1


LINE = sample(Bowl(), plane(60, dims=("speed",)))
BOUNCES = (np.abs(LINE["u"].values) * 4).astype(int)


def test_a_profile_shows_the_slope_along_its_line_and_its_central_difference():
    loss, slope = profile_figure(LINE).axes
    np.testing.assert_array_equal(loss.lines[0].get_ydata(), LINE["loss"])
    ours = next(line for line in slope.lines if line.get_label() == "gradient")
    behind = next(line for line in slope.lines if "central" in line.get_label())
    np.testing.assert_allclose(ours.get_ydata(), 2 * LINE["u"])
    np.testing.assert_allclose(behind.get_ydata()[1:-1], 2 * LINE["u"][1:-1], atol=1e-12)  # exact for a parabola
    assert slope.get_xlabel() == "speed [m/s]"
    assert slope.get_ylabel() == "slope of the loss [1/(m/s)]"


def test_event_counts_are_labelled_bands_and_lines_where_they_change():
    figure = profile_figure(LINE, events={"bounces": BOUNCES})
    strip, loss, _ = figure.axes
    changes = np.flatnonzero(np.diff(BOUNCES))
    between = (LINE["u"].values[changes] + LINE["u"].values[changes + 1]) / 2
    lines = [line.get_xdata()[0] for line in loss.lines if len(line.get_xdata()) == 2 and line.get_label()[0] == "_"]
    np.testing.assert_allclose(lines, between)
    assert next(text.get_text() for text in strip.texts) == "3"
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in strip.texts]
    assert not any(a.overlaps(b) for a, b in itertools.pairwise(boxes))


def test_crowded_event_labels_give_way():
    line = sample(Bowl(), plane(128, dims=("speed",)))
    strip = profile_figure(line, events={"bounces": np.arange(128) * 1000}).axes[0]
    assert len(strip.texts) == 0


def test_a_profile_breaks_at_failures_and_counts_them():
    line = Plane.through(SPACE, SPACE.upper, ["lift"], resolution=20)
    figure = profile_figure(sample(Bowl(), line))
    assert np.isnan(figure.axes[0].lines[0].get_ydata()).sum() == 5
    assert "not finite: 5 of 20" in legend_of(figure)
    assert patches_of(figure.axes[0])["NONFINITE"].get_hatch()
