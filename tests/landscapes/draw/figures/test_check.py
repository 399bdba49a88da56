"""The picture of a check: each number where it belongs, gaps as gaps, and the verdict with its interval."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from gradscape.landscapes.checks.slopes import Kind
from gradscape.landscapes.checks.usefulness import OPTIMISER_STEPS, UNKNOWN
from gradscape.landscapes.draw import style
from gradscape.landscapes.draw.figures.check import LOWEST, NOTHING, check_figure
from gradscape.landscapes.draw.figures.page import Picture
from gradscape.optim.registry import optimizer_class

from .records import CURVE, checked


def lines(ax: Axes, name: str) -> list[Line2D]:
    return [line for line in ax.lines if line.get_gid() == name]


def entries(picture: Picture) -> list[str]:
    return [text.get_text().replace("\n", " ") for text in picture.legends[0].get_texts()]


def test_curves_stand_at_their_steps_and_break_where_noise_hides_the_loss() -> None:
    curves, _ = check_figure(checked()).axes
    for name in ("cosine", "sign"):
        (line,) = lines(curves, name)
        whole = [(one.step, getattr(one, name).value) for one in CURVE]
        np.testing.assert_array_equal(line.get_xydata(), [*whole[:2], (1e-4, np.nan), *whole[2:]])  # lost in the noise
    (gap,) = [patch for patch in curves.patches if patch.get_gid() == "gap"]
    assert (gap.get_x(), gap.get_x() + gap.get_width()) == pytest.approx((10**-4.5, 10**-3.5))
    band, *_ = [one for one in curves.collections if one.get_gid() == "cosine-interval"]
    assert band.get_paths()[1].get_extents().ymin == pytest.approx(CURVE[3].cosine.low)


def test_bias_is_what_the_mean_of_gradients_lacks_and_intervals_beyond_the_panel_end_in_arrows() -> None:
    picture = check_figure(checked())
    curves = picture.axes[0]
    shown = [tuple(np.ravel(line.get_xydata())) for line in lines(curves, "smoothed")]
    assert shown == [(1e-3, pytest.approx(1.2)), (1e-1, pytest.approx(0.75))]
    (low, high) = curves.get_ylim()
    ends = {line.get_xdata()[0]: tuple(line.get_ydata()) for line in lines(curves, "smoothed-interval")}
    assert ends[1e-3] == pytest.approx((0.7, high))
    assert ends[1e-1] == pytest.approx((0.6, 0.9))
    assert low == LOWEST
    arrows = [tuple(np.ravel(line.get_xydata())) for line in curves.lines if line.get_marker() in ("v", "^")]
    assert arrows == [(1e-3, high), (1e-2, low), (1e-2, high)]
    (said,) = [text for text in entries(picture) if "mean gradient" in text]
    assert said.endswith("beyond the panel: \N{MINUS SIGN}2 at 0.01")


def test_steps_of_optimisers_are_those_of_the_methods() -> None:
    own = {name: optimizer_class(name).Options() for name in ("adam", "descents", "cma-es")}
    firsts = (own["adam"].rate, own["descents"].max_step, own["cma-es"].sigma)  # in a box from -1 to 1
    assert tuple(OPTIMISER_STEPS.values()) == pytest.approx([one / 2 for one in firsts])
    curves = check_figure(checked()).axes[0]
    assert [line.get_xdata()[0] for line in lines(curves, "optimiser")] == list(OPTIMISER_STEPS.values())
    assert set(OPTIMISER_STEPS) <= {text.get_text() for text in curves.texts}


def test_every_kind_of_points_has_a_bar_and_its_number() -> None:
    _, bars = check_figure(checked()).axes
    widths = [patch.get_width() for patch in bars.patches if patch.get_gid() == "kind"]
    assert widths == list(range(1, 20, 2))
    assert [text.get_text() for text in bars.get_yticklabels()] == [str(kind) for kind in Kind]
    assert set(style.POINT_KINDS) == set(map(str, Kind))
    assert bars.get_title() == "100 random points"


@pytest.mark.parametrize(
    ("found", "title", "remark"),
    [
        (
            checked(kinds={Kind.WRONG: 27}),
            "check fails: gradients are wrong at 42 % (30 to 55 %) of 64 points",
            "factor 2 (certain), with stiffness",
        ),
        (checked(kinds={Kind.NAN: 27}), "gradients are NaN at 42 % (30 to 55 %)", "factor 2"),
        (checked(wrong=0, passed=True), "check passes: gradients are", "a defect in less than 5 % of the box"),
        (checked(wrong=0), "check fails, though gradients are", "factor 2"),
        (replace(checked(), share=None), "no gradient to compare", "factor 2"),
    ],
)
def test_it_says_the_verdict_with_its_interval_and_causes(found: object, title: str, remark: str) -> None:
    picture = check_figure(found)  # type: ignore[arg-type] # of a list of several
    assert title in picture.get_suptitle().replace("\n", " ")
    assert remark in picture.axes[0].get_title()


def test_nothing_to_compare_is_said_and_drawn_as_that() -> None:
    unknown = replace(CURVE[3], compared=0, sign=UNKNOWN, cosine=UNKNOWN, bias=UNKNOWN)
    for curve in ((), (unknown,)):
        picture = check_figure(checked(curve, kinds={}))
        curves, bars = picture.axes
        assert NOTHING in [text.get_text() for text in curves.texts]
        assert not lines(curves, "cosine") + lines(curves, "sign") + lines(curves, "smoothed")
        left, right = curves.get_xlim()
        gaps = [patch for patch in curves.patches if patch.get_gid() == "gap"]
        assert gaps[0].get_x() == left
        assert gaps[-1].get_x() + gaps[-1].get_width() == pytest.approx(right)
        assert bars.get_title().split() == ["no", "gradient", "was", "compared"]
        assert entries(picture) == [
            "too few changes of the loss above its noise",
            "first step of an optimiser (for gradient descent: at most)",
        ]


def test_gradients_that_are_all_zero_have_signs_and_no_cosine() -> None:
    flat = tuple(replace(one, cosine=UNKNOWN) for one in CURVE)
    picture = check_figure(checked(flat))
    assert not lines(picture.axes[0], "cosine")
    assert "no cosine: all gradients, or all slopes, are 0" in entries(picture)
