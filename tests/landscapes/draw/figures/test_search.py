"""Searches: the losses of a run, races of methods, and the map of a league."""

import json
from collections.abc import Sequence

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.patches import Rectangle

from gradscape.landscapes.draw import style
from gradscape.landscapes.draw.figures.search import league_figure, race_figure, run_figure
from gradscape.landscapes.objective import Status
from gradscape.optim.registry import methods

KINDS = {"flag_values": [0, 1, 2, 3, 4], "flag_meanings": "random population descent acquisition policy"}


def table(loss: list[float], kind: list[int] | None = None, *, budget: int = 20, unit: str = "m") -> xr.Dataset:
    status = np.where(np.isfinite(loss), Status.OK, Status.ESCAPED).astype(np.int8)
    about = {"env": "hill", "method": "cma-es", "fidelity": "draft", "seed": 3, "budget": budget}
    return xr.Dataset(
        {
            "loss": ("evaluation", loss, {"units": unit}),
            "kind": ("evaluation", np.array(kind or [1] * len(loss), np.int8), KINDS),
            "status": ("evaluation", status),
            "episodes": ("evaluation", np.arange(1, len(loss) + 1)),
        },
        attrs=about | {"identity": '{"gradscape": "0"}', "provenance": "{}"},
    )


def drawn(figure, name: str):
    return next((line for line in figure.axes[0].lines if line.get_gid() == name), None)


def test_every_episode_is_a_point_of_its_kind_or_a_failure_under_the_best_so_far():
    figure = run_figure(table([np.nan, 5.0, 7.0, np.nan, 3.0, 4.0], [1, 1, 1, 1, 2, 1]))
    best, failed = drawn(figure, "best"), drawn(figure, "failed")
    np.testing.assert_array_equal(best.get_ydata(), [np.nan, 5, 5, 5, 3, 3])
    assert (best.get_label(), failed.get_label()) == ("best so far: 3", "failed: 2 of 6")
    found = [drawn(figure, name).get_xdata().tolist() for name in ("population", "descent", "failed")]
    assert found == [[2, 3, 6], [5], [1, 4]]
    assert drawn(figure, "policy") is None
    assert figure.get_suptitle() == "hill · draft · cma-es · seed 3 · 6 of 20 episodes so far"
    assert (figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()) == ("episodes", "loss [m]")
    said = {line.get_label() for line in run_figure(table([np.nan, np.nan])).axes[0].lines}
    assert said >= {"no episode has succeeded", "failed: 2 of 2"}


@pytest.mark.parametrize(("loss", "scale"), [([0.1, 9.0, 2.0], "log"), ([-0.1, 9.0], "linear"), ([5.0, 9.0], "linear")])
def test_losses_over_decades_get_a_logarithmic_axis(loss, scale):
    assert run_figure(table(loss)).axes[0].get_yscale() == scale


def test_outliers_leave_the_picture_and_are_counted():
    ax = run_figure(table([*np.linspace(1, 3, 300), 1e9])).axes[0]
    assert ax.get_ylim()[1] < 10
    assert any("1 above the plot" in line.get_label() for line in ax.lines)


NAN = np.nan


def race(methods=("cma-es", "bo-leap"), **attributes) -> xr.Dataset:
    """A race of two seeds: the last method has a longer curve, reaches everything, and the first half of it."""
    count = len(methods)
    steps = {
        "episodes": np.vstack([[[1, 5, NAN]] * (count - 1), [[1, 2, 20]]]),
        "mean": np.vstack([[[9, 4, NAN]] * (count - 1), [[8, 3, 1]]]),
    }
    hit = np.vstack([[[3, 5, NAN, NAN]] * (count - 1), [[20, 1, 2, 2]]])
    return xr.Dataset(
        {
            **{name: (("method", "step"), values) for name, values in steps.items()},
            "low": (("method", "step"), steps["mean"] - 0.5),
            "high": (("method", "step"), steps["mean"] + 1),
            "hit": (("method", "pair"), hit),
            "unsuccessful": ("method", np.zeros(count, int)),
        },
        {"method": list(methods)},
        {
            "title": "fluid · draft · 20 episodes · 2 seeds",
            "budget": 20,
            "seeds": 2,
            "loss_unit": "m",
            "spacing": "log",
            "targets": (2, 1.0, 100.0),
            "lead": "none is first: bo-leap, of the best mean rank, is not distinguishable from cma-es",
            "identity": json.dumps({"gradscape": "0.1.0", "device": "cpu"}),
            "provenance": json.dumps({"created": "2026-11-21", "command": "landscape race fluid"}),
        }
        | attributes,
    )


def lines(ax):
    return {line.get_color(): line for line in ax.lines}


def test_both_panels_draw_each_method_in_its_own_colour():
    losses, shares = race_figure(race()).axes
    for name, mean, share in (
        ("cma-es", [9, 4], [0, 0.25, 0.5, 0.5]),
        ("bo-leap", [8, 3, 1], [0, 0.25, 0.5, 0.75, 1, 1]),
    ):
        color = style.METHODS[name]["color"]
        np.testing.assert_array_equal(lines(losses)[color].get_ydata(), mean)
        np.testing.assert_array_equal(lines(shares)[color].get_ydata(), share)
    np.testing.assert_array_equal(lines(shares)[style.METHODS["bo-leap"]["color"]].get_xdata(), [1, 1, 2, 2, 20, 20])
    assert {line.get_drawstyle() for ax in (losses, shares) for line in ax.lines} == {"steps-post"}


def test_a_band_spans_the_interval_as_steps():
    losses, _ = race_figure(race()).axes
    (corners,) = losses.collections[1].get_paths()
    inside = [corners.contains_point((x, y)) for x, y in ((1.5, 8.9), (10, 2.6), (10, 3.9), (10, 4.1), (1.5, 7.4))]
    assert inside == [True, True, True, False, False]


def test_the_figure_says_what_was_raced_in_which_units_and_how_much_of_it_is_sure():
    figure = race_figure(race())
    losses, shares = figure.axes
    assert (losses.get_xlabel(), losses.get_ylabel()) == ("episodes", "best loss so far [m]")
    assert (losses.get_yscale(), losses.get_xlim()) == ("log", (1, 20))
    assert shares.get_title() == "2 targets from 100 m down to 1 m, spaced logarithmically"
    plain, _ = race_figure(race(spacing="linear", targets=(2, 1.0, 3.0), loss_unit="")).axes
    assert (plain.get_yscale(), plain.get_ylim()[1], plain.get_ylabel()) == ("linear", 5, "best loss so far")
    assert figure.get_suptitle() == "fluid · draft · 20 episodes · 2 seeds"
    assert "cpu · 2026-11-21 · landscape race fluid" in losses.get_title()
    sure, *leads = losses.texts[0].get_text().split("\n")
    assert sure == "mean of 2 seeds and 95 % bootstrap interval"
    assert " ".join(leads) == "none is first: bo-leap, of the best mean rank, is not distinguishable from cma-es"
    assert race_figure(race(seeds=1)).axes[0].texts[0].get_text().startswith("one seed: no interval\n")


def test_a_method_without_a_mean_says_so_and_keeps_its_share_of_targets():
    dataset = race()
    dataset["unsuccessful"][0] = 1
    for name in ("mean", "low", "high"):
        dataset[name][0] = NAN
    figure = race_figure(dataset)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["cma-es (no success with 1 of 2 seeds, so no mean)", "bo-leap"]
    assert len(lines(figure.axes[0])[style.METHODS["cma-es"]["color"]].get_xdata()) == 0
    assert lines(figure.axes[1])[style.METHODS["cma-es"]["color"]].get_ydata()[-1] == 0.5


def test_a_race_without_any_success_is_drawn_as_that():
    dataset = race(targets=(0, NAN, NAN), spacing="linear")
    for name in ("mean", "low", "high", "hit"):
        dataset[name][:] = NAN
    losses, shares = race_figure(dataset).axes
    assert losses.texts[0].get_text().startswith("no method succeeded with every seed: no mean\n")
    assert "no targets" in shares.get_title()
    assert all((line.get_ydata() == 0).all() for line in shares.lines)


@pytest.mark.parametrize("scale", [1.0, 1e2, 1e9])
def test_a_logarithmic_axis_has_numbers_however_many_decades_it_spans(scale):
    dataset = race()
    for name in ("mean", "low"):
        dataset[name][0, 1] = dataset[name][0, 1] / scale
    figure = race_figure(dataset)
    figure.canvas.draw()
    ax = figure.axes[0]
    low, high = ax.get_ylim()
    shown = [tick.label1.get_text() for tick in ax.yaxis.get_major_ticks() if low <= tick.get_loc() <= high]
    assert 3 <= len([text for text in shown if text]) <= 10


def test_methods_differ_in_colour_and_without_it():
    assert set(style.METHODS) == set(methods())
    looks = list(style.METHODS.values())
    assert len({look["color"] for look in looks}) == len({look["marker"] for look in looks}) == len(looks)
    colors = [np.array(to_rgba(look["color"])[:3]) for look in looks]
    assert min(np.abs(a - b).max() for i, a in enumerate(colors) for b in colors[:i]) > 0.15


METHODS = ["bo-leap", "cma-es-gradient", "descents", "random"]
RANK = np.array([[1.0, 2.25, 3.0, 3.75], [1.5, np.nan, 1.5, 3.0], [1.25, 2.25, 2.25, 3.4]])


def ranked() -> xr.Dataset:
    parts = {"rank": RANK, "rank_low": RANK - 0.2, "rank_high": RANK + 0.3, "first": RANK == 1.0}
    return xr.Dataset(
        {name: (("scene", "method"), values) for name, values in parts.items()},
        {"scene": ["fluid", "swing-stiffness", "all scenes"], "method": METHODS},
        {"title": "League of 4 methods", "seeds": "10", "command": "landscape league"},
    )


def luminance(colour: Sequence[float], most: float = 1.0) -> float:
    """Return WCAG's relative luminance of red, green and blue."""
    parts = np.array(colour[:3]) / most
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("width", [None, 85.0, 170.0])
def test_each_cell_has_its_rank_and_a_method_that_did_not_run_a_hatch(width: float | None) -> None:
    picture = league_figure(ranked(), width=width)
    ax = picture.axes[0]
    said = {(round(one.get_position()[0]), round(one.get_position()[1])): one for one in ax.texts}
    hatched = [one.get_xy() for one in ax.patches if isinstance(one, Rectangle) and one.get_hatch()]
    assert hatched == [(0.5, 0.5)]
    assert len(said) == np.isfinite(RANK).sum()
    first = [one.get_text() for one in ax.texts if round(one.get_position()[1]) == 0]
    bold = {one.get_text() for one in ax.texts if one.get_weight() == "bold"}
    assert len(bold) == 1
    assert float(bold.pop()) == 1.0
    assert {"1.00", "2.25", "3.75"} <= set(first) or {"1", "2.2", "3.8"} <= set(first)
    assert [one.get_text() for one in ax.get_yticklabels()] == ["fluid", "swing-stiffness", "all scenes"]


def test_intervals_are_left_out_where_there_is_no_room_and_the_legend_says_so() -> None:
    many = xr.concat(
        [ranked().assign_coords(method=[f"{name}{part}" for name in METHODS]) for part in range(3)], "method"
    )
    many.attrs = ranked().attrs
    for width, told in ((None, True), (85.0, False)):
        picture = league_figure(many, width=width)
        assert any(" to " in one.get_text() for one in picture.axes[0].texts) == told
        assert any("intervals are in league.json" in one.get_text() for one in picture.legends[0].get_texts()) != told


def test_texts_do_not_leave_their_cells() -> None:
    picture = league_figure(ranked())
    picture.canvas.draw()
    ax = picture.axes[0]
    cell = ax.get_window_extent().width / len(METHODS)
    assert all(one.get_window_extent().width < cell for one in ax.texts)


def test_ink_is_legible_on_every_rank_and_no_grey() -> None:
    for share in np.linspace(0, 1, 101):
        colour = style.RANK_MAP(share)
        assert style.text_on(colour) in ("black", "white")
        light, dark = sorted((luminance(colour), luminance(to_rgb(style.text_on(colour)))), reverse=True)
        assert (light + 0.05) / (dark + 0.05) >= 4.5
    assert all(np.ptp(to_rgb(ink)) > 0.04 for ink in style.TINTED)  # a dark page turns greys over
