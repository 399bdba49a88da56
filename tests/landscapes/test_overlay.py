import numpy as np
import pytest
import torch
import xarray as xr
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_rgba

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.draw import style
from gradscape.landscapes.draw.figures.overlay import joint_scale, overlay_figure
from gradscape.landscapes.overlay import best_point, improvements, overlay, principal_plane
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.space import ParameterSpace

from .made_runs import run_table

# Units that differ a thousandfold: half-widths 1 m/s, 1000 N and 10.
LOWER, UPPER = [-1.0, 0.0, -10.0], [1.0, 2000.0, 10.0]
SPACE = ParameterSpace(
    ("speed", "force", "mass"), torch.tensor(LOWER).double(), torch.tensor(UPPER).double(), ("m/s", "N", "")
)
CENTER, HALF = np.array([0.0, 1000, 0]), np.array([1.0, 1000, 10])


def bowl(x):
    """Return the squared distance from the middle of the scaled box, and nothing in a corner."""
    z = (x - torch.from_numpy(CENTER)) / torch.from_numpy(HALF)
    return torch.where((z[:, :2] > 0.75).all(dim=1), torch.nan, z.square().sum(dim=1))


BOWL = from_torch(bowl, SPACE, name="bowl")


def run(z, kind, *, seed=0, method="bo-leap", grad=True) -> xr.Dataset:
    """Return the table of a run that evaluated these points of the scaled box."""
    return run_table(BOWL, CENTER + HALF * np.asarray(z, dtype=float), kind, method=method, seed=seed, grad=grad)


def descent(start, *, step=0.1, count=6):
    z = [np.asarray(start, dtype=float)]
    while len(z) < count:
        z.append(np.clip(z[-1] - step * 2 * z[-1], -1, 1))
    return np.stack(z)


PLANE = Plane.through(SPACE, SPACE.center, ("speed", "force"), resolution=(9, 5))
SLICE = sample(BOWL, PLANE)
SPREAD = np.random.default_rng(0).uniform(-0.7, 0.7, (30, 3))


def test_points_fall_on_the_plane_and_their_distance_is_in_half_widths_of_the_box():
    (laid,) = overlay(SLICE, [run([[0.5, -0.5, 0.0], [0.25, 0.5, -0.4]], [0, 0])])
    np.testing.assert_allclose(laid["u"], [0.5, 0.25])
    np.testing.assert_allclose(laid["v"], [500, 1500])
    np.testing.assert_allclose(laid["distance"], [0, 0.4], atol=1e-12)


def test_a_skew_plane_is_nearest_in_the_scaled_box_whatever_the_units():
    directions = torch.tensor([[1.0, 1000, 0], [0, 0, 10.0]]).double()  # (1, 1, 0) and (0, 0, 1) there
    skew = Plane.span(SPACE.center, directions, resolution=5)
    (laid,) = overlay(sample(BOWL, skew), [run([[0.6, 0.0, 0.3]], [0])])
    np.testing.assert_allclose([laid["u"][0], laid["v"][0]], [0.3, 0.3])
    np.testing.assert_allclose(laid["distance"], np.hypot(0.3, 0.3))


def test_the_loss_beneath_is_that_of_the_cell_the_point_is_drawn_in():
    (laid,) = overlay(SLICE, [run([[0.1, 0.2, 0.9], [0.13, 0.26, 0], [0.9, 0.9, 0]], [0, 0, 0])])
    by_hand = SLICE["loss"].sel(u=[0.0, 0.25], v=[1000, 1500], method="nearest").values.diagonal()
    np.testing.assert_array_equal(laid["beneath"], [*by_hand, np.nan])  # the last lies over a sample that failed
    assert laid["loss"][0] > laid["beneath"][0] + 0.8  # what the plane does not show


def test_points_beyond_the_window_are_marked_and_have_nothing_beneath():
    small = Plane.through(SPACE, SPACE.center, ("speed", "force"), resolution=5, window=0.5)
    (laid,) = overlay(sample(BOWL, small), [run([[0.55, 0, 0], [0.6, 0, 0], [0, -0.99, 0]], [0, 0, 0])])
    np.testing.assert_array_equal(laid["outside"], [False, False, True])  # a sample is 0.25 wide
    np.testing.assert_array_equal(np.isnan(laid["beneath"]), laid["outside"])


def test_descents_are_found_by_their_gradients_even_when_they_alternate():
    one, two = descent([0.9, -0.8, 0.3]), descent([-0.5, 0.6, -0.9], count=6)
    mixed = np.stack([one, two], axis=1).reshape(-1, 3)
    (laid,) = overlay(SLICE, [run(mixed, [2] * 12)])
    np.testing.assert_array_equal(laid["previous"], [-1, -1, *range(10)])


def test_a_descent_that_overshoots_or_follows_the_border_is_one_and_none_is_without_gradients():
    (laid,) = overlay(SLICE, [run(descent([0.9, -0.8, 0.3], step=0.9), [2] * 6)])
    np.testing.assert_array_equal(laid["previous"], [-1, 0, 1, 2, 3, 4])  # not the nearest point on the same line
    table = run(np.array([[0.9, 0.2, 0.1], [1.0, 0.1, 0.05], [1.0, 0.05, 0.025]]), [2, 2, 2])
    table["grad"].values[:] = np.array([-0.4, 2 * 0.1, 0.1]) * [1, 1, 1] / HALF  # pushes against the border
    table["grad"].values[1] *= 0.5
    np.testing.assert_array_equal(overlay(SLICE, [table])[0]["previous"], [-1, 0, 1])
    (laid,) = overlay(SLICE, [run(descent([0.9, -0.8, 0.3]), [1] * 6, grad=False)])
    assert (laid["previous"] == -1).all()


def test_the_best_point_is_the_best_of_all_runs_and_failures_do_not_count():
    tables = [run([[0.9, 0.9, 0.0], [0.3, 0, 0]], [0, 0]), run([[0.2, 0, 0]], [0], seed=1)]
    x, loss = best_point(tables)
    np.testing.assert_allclose(x, CENTER + HALF * [0.2, 0, 0])
    assert loss == pytest.approx(0.04)
    with pytest.raises(ValueError, match="no episode of these runs succeeded"):
        best_point([run([[0.9, 0.9, 0.0]], [0])])


def test_the_principal_plane_does_not_depend_on_units():
    """Points on a disc that is tilted in the scaled box: with parameters as they are, force would be everything."""
    angle = np.linspace(0, 6, 40)
    flat = np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.linspace(0.2, 0.8, 40)[:, None]
    z = flat @ np.array([[1, 0, 0], [0, 0.6, 0.8]])
    table = run(z, [0] * 40)
    (laid,) = overlay(sample(BOWL, principal_plane([table], resolution=4)), [table])
    np.testing.assert_allclose(laid["distance"], 0, atol=1e-9)
    assert not laid["outside"].any()
    np.testing.assert_allclose(laid["u"] ** 2 + laid["v"] ** 2, ((z - z.mean(axis=0)) ** 2).sum(axis=1))
    moved = principal_plane([table], resolution=4, through=SPACE.upper)
    np.testing.assert_allclose(moved.lift(moved.project(SPACE.upper)), SPACE.upper)


def test_runs_of_other_parameters_and_lines_are_refused():
    other = run(SPREAD, [0] * 30).assign_coords(dim=["a", "b", "c"])
    with pytest.raises(ValueError, match=r"bo-leap-s0 searched 3 parameters \(a, b, c\), the slice has 3 \(speed"):
        overlay(SLICE, [other])
    line = sample(BOWL, Plane.through(SPACE, SPACE.center, ("speed",), resolution=5))
    with pytest.raises(ValueError, match="an overlay needs a plane; got a slice of rank 1"):
        overlay(line, [run(SPREAD, [0] * 30)])


@pytest.mark.drawn
def test_runs_of_one_method_and_seed_are_told_apart():
    tables = [run(SPREAD, [0] * 30), run(SPREAD, [0] * 30), run(SPREAD, [0] * 30, seed=1)]
    assert [laid.attrs["label"] for laid in overlay(SLICE, tables)] == ["bo-leap-s0-1", "bo-leap-s0-2", "bo-leap-s1"]


FAILING = np.concatenate([SPREAD, [[0.9, 0.9, 0.0], [0.95, 0.9, 0.1]]])
LAID = overlay(SLICE, [run(FAILING, [1] * 16 + [3] * 16), run(descent([0.9, -0.8, 0.3]), [2] * 6, method="descents")])
FIGURE = overlay_figure(SLICE, LAID)
MAP, AGAINST = FIGURE.axes[:2]


def drawn(ax, gid: str) -> list[PathCollection]:
    return [artist for artist in ax.collections if artist.get_gid() == gid]


def legend() -> list[str]:
    return [text.get_text() for text in FIGURE.legends[0].get_texts()]


def test_every_point_is_drawn_where_it_falls_in_the_colour_of_its_true_loss():
    (dots,) = drawn(MAP, "population")
    np.testing.assert_array_equal(dots.get_offsets(), np.stack([LAID[0]["u"], LAID[0]["v"]], 1)[:16])
    np.testing.assert_array_equal(dots.get_array(), LAID[0]["loss"][:16])
    (mesh,) = [artist for artist in MAP.collections if artist.get_array() is not None and artist.get_gid() is None]
    assert (dots.norm.vmin, dots.norm.vmax) == (mesh.norm.vmin, mesh.norm.vmax)
    assert dots.get_cmap() == mesh.get_cmap()


def test_points_shrink_with_their_distance_from_the_plane():
    (dots,) = drawn(MAP, "population")
    order = np.argsort(LAID[0]["distance"][:16].values)
    sizes = dots.get_sizes()[order]
    assert (np.diff(sizes) < 0).all()
    assert f"{max(float(laid['distance'].max()) for laid in LAID):.2g} half-widths of the box off it" in legend()


def test_kinds_have_their_markers_and_descents_their_lines():
    shapes = {gid: drawn(MAP, gid)[0].get_paths()[0].vertices.shape for gid in ("population", "descent", "acquisition")}
    assert len(set(shapes.values())) == 3
    lines = [artist for artist in MAP.collections if isinstance(artist, LineCollection)]
    by_count = {len(line.get_segments()): line for line in lines}
    assert set(by_count) == {0, 5}
    np.testing.assert_allclose(by_count[5].get_segments()[0], np.stack([LAID[1]["u"], LAID[1]["v"]], 1)[:2])
    faint = by_count[5].get_colors()[:, 3]
    assert (np.diff(faint) > 0).all()  # it comes nearer to the plane as it goes
    np.testing.assert_allclose(by_count[5].get_colors()[0, :3], to_rgba(style.METHODS["descents"]["color"])[:3])


@pytest.mark.drawn
def test_failures_are_crosses_and_neither_points_nor_best():
    (crosses,) = drawn(MAP, "failed")
    np.testing.assert_array_equal(crosses.get_offsets(), np.stack([LAID[0]["u"], LAID[0]["v"]], 1)[-2:])
    assert len(drawn(MAP, "acquisition")[0].get_offsets()) == 14
    assert "failed episode: 2 of 38 points" in legend()
    nothing = overlay(SLICE, [run([[0.9, 0.9, 0.0]] * 3, [0] * 3)])
    figure = overlay_figure(SLICE, nothing)
    assert not drawn(figure.axes[0], "best")
    assert "bo-leap, seed 0: no episode succeeded" in [text.get_text() for text in figure.legends[0].get_texts()]


@pytest.mark.drawn
def test_points_beyond_the_map_are_hollow_at_its_border_and_counted():
    small = Plane.through(SPACE, SPACE.center, ("speed", "force"), resolution=5, window=0.5)
    dataset = sample(BOWL, small)
    laid = overlay(dataset, [run([[0.0, 0, 0], [0.9, 0, 0], [0, -0.99, 0]], [0, 0, 0])])
    figure = overlay_figure(dataset, laid)
    (hollow,) = drawn(figure.axes[0], "outside")
    np.testing.assert_allclose(hollow.get_offsets(), [[0.625, 1000], [0, 375]])
    assert len(hollow.get_facecolors()) == 0
    assert "outside the map: 2 of 3 points" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_losses_are_held_against_the_samples_beneath():
    own = next(dots for dots in drawn(AGAINST, "descent") if len(dots.get_offsets()))
    np.testing.assert_array_equal(own.get_offsets(), np.stack([LAID[1]["beneath"], LAID[1]["loss"]], 1))
    assert AGAINST.get_xlim() == AGAINST.get_ylim()
    assert AGAINST.get_title().startswith("36 of 38 points: those with both losses")


def test_a_run_that_converged_leaves_the_map_its_colours():
    lifted = SLICE.assign(loss=SLICE["loss"] + 1.0)
    laid = overlay(lifted, [run(descent([0.5, 0.5, 0.5], step=0.49, count=9), [2] * 9)])
    scale = joint_scale(lifted, laid)
    assert laid[0]["loss"].min() < 1e-20
    assert scale.norm.vmin == pytest.approx(0.1)
    assert scale.extend == "min"


@pytest.mark.parametrize(("low", "high"), [(0.04, 0.24), (-3.0, 2.0), (1e-3, 10.0)])
def test_the_map_rules_its_scale_whatever_runs_found(low, high):
    """A map from 0.04 to 0.24 was drawn to 0.98, nearly black: runs that got worse took its colours away."""
    shape = SLICE["loss"].shape
    dataset = SLICE.assign(loss=(("v", "u"), np.geomspace(1, 2, shape[0] * shape[1]).reshape(shape)))
    loss = dataset["loss"].to_numpy()
    loss[:] = low + (high - low) * (loss - 1)
    (laid,) = overlay(dataset, [run(SPREAD, [0] * 30)])
    laid["loss"].values[:] = np.linspace(low, 10 * high, 30)
    scale = joint_scale(dataset, [laid])
    assert (scale.ends, scale.extend) == ((low, high), "max")
    laid["loss"].values[0] = low - 100 * (high - low)
    below = joint_scale(dataset, [laid])
    assert below.ends[1] == high
    assert below.ends[0] == pytest.approx(low / 10 if low > 0 else 2 * low - high)
    assert below.extend == "both"


def test_distances_have_their_unit_wherever_they_are_written():
    said = [text for text in legend() if "off" in text]
    assert any(text.startswith("bo-leap, seed 0: best") for text in said)
    assert all("half-width" in text and "of the box off" in text for text in said)


@pytest.mark.parametrize("count", [1, 12])
@pytest.mark.drawn
def test_what_was_the_best_so_far_is_joined_in_its_order_and_numbered_where_there_is_room(count):
    tables = [
        run(np.random.default_rng(seed).uniform(-0.7, 0.7, (30, 3)), [1] * 30, seed=seed) for seed in range(count)
    ]
    laid = overlay(SLICE, tables)
    figure = overlay_figure(SLICE, laid)
    ax = figure.axes[0]
    lines = [line for line in ax.lines if line.get_gid() == "order"]
    for own in laid:
        best = np.minimum.accumulate(own["loss"].values)
        rows = np.flatnonzero(np.diff(best, prepend=np.inf) < 0)
        np.testing.assert_array_equal(improvements(own), rows)
        path = np.stack([own["u"], own["v"]], axis=1)[rows]
        assert sum(np.array_equal(line.get_xydata(), path) for line in lines) == 2  # white, with a dark edge
    numbers = [text for text in ax.texts if text.get_gid() == "episode"]
    assert len(numbers) >= min(count, 4)
    for text in numbers:
        row = int(text.get_text()) - 1
        at = [(float(own["u"][row]), float(own["v"][row])) for own in laid if row in improvements(own)]
        assert any(np.allclose(text.xy, place) for place in at)
    boxes = [text.get_window_extent() for text in numbers]
    assert not any(one.overlaps(other) for number, one in enumerate(boxes) for other in boxes[:number])
    assert any("numbers: episodes" in text.get_text() for text in figure.legends[0].get_texts())
    assert "colour: the loss of the point itself" in figure.legends[0].get_title().get_text().replace("\n", " ")
