import json

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgba

from gradscape.landscapes.draw import style
from gradscape.landscapes.draw.figures.search import race_figure
from gradscape.optim.registry import methods

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


def test_axes_name_their_units_and_are_logarithmic_where_the_targets_are():
    losses, shares = race_figure(race()).axes
    assert losses.get_ylabel() == "best loss so far [m]"
    assert (losses.get_yscale(), losses.get_xlabel(), losses.get_xlim()) == ("log", "episodes", (1, 20))
    assert shares.get_title() == "2 targets from 100 m down to 1 m, spaced logarithmically"
    plain, _ = race_figure(race(spacing="linear", targets=(2, 1.0, 3.0), loss_unit="")).axes
    assert (plain.get_yscale(), plain.get_ylim()[1], plain.get_ylabel()) == ("linear", 5, "best loss so far")


def test_the_figure_says_what_was_raced_and_how_much_of_it_is_sure():
    figure = race_figure(race())
    assert figure.get_suptitle() == "fluid · draft · 20 episodes · 2 seeds"
    assert "cpu · 2026-11-21 · landscape race fluid" in figure.axes[0].get_title()
    assert figure.axes[0].texts[0].get_text() == "mean of 2 seeds and 95 % bootstrap interval"
    assert race_figure(race(seeds=1)).axes[0].texts[0].get_text() == "one seed: no interval"


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
    assert losses.texts[0].get_text() == "no method succeeded with every seed: no mean"
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
